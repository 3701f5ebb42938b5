"""Array types that annotations share: shape and dtype here, units and frames in each docstring."""

from __future__ import annotations

from typing import Any, TypeAlias

from jaxtyping import Array, Bool, Float, Key, UInt32

Points = Float[Array, "n 3"]
Normals = Float[Array, "n 3"]
Mask = Bool[Array, " n"]
Pose = Float[Array, "4 4"]
Rotation = Float[Array, "3 3"]
Quaternion = Float[Array, "4"]
Scalar = Float[Array, ""]
PRNGKey = Key[Array, ""] | UInt32[Array, "2"]

# What a public function accepts as an array: JAX, NumPy, nested lists. kmn_jax.errors judges it, with its own errors.
ArrayInput: TypeAlias = Any
