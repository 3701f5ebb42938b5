"""Array types that annotations share: shape and dtype here, units and frames in each docstring."""

from __future__ import annotations

from typing import Any, TypeAlias

from jaxtyping import Array, Bool, Float, Int, Key, UInt32

Points = Float[Array, "n 3"]
Normals = Float[Array, "n 3"]
PointNormals = Float[Array, "n 6"]
Features = Float[Array, "n c"]
Mask = Bool[Array, " n"]
Indices = Int[Array, " n"]
NeighborIndices = Int[Array, "n k"]
Pose = Float[Array, "4 4"]
Rotation = Float[Array, "3 3"]
Quaternion = Float[Array, "4"]
Scalar = Float[Array, ""]
PRNGKey = Key[Array, ""] | UInt32[Array, "2"]

# What a public function accepts as an array: JAX, NumPy, nested lists. kmn_jax.checks judges it, with its own errors.
ArrayInput: TypeAlias = Any
