"""From CAD files to labelled scenes: object models, bins under physics, renderings, packs, BOP datasets.

Import the submodules: open3d, trimesh, mujoco and grain are loaded by the functions that need them, not before.
"""
