"""6D pose estimation of parts in a bin from a CAD model and a colourless point cloud, in JAX."""

__version__ = "0.1.0"
