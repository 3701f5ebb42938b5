"""Training: examples made of packs inside the step, the step itself, sharding, checkpoints and the loop.

Import the submodules: grain and orbax are loaded by the functions that need them, not before.
"""
