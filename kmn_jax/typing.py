"""Array types that annotations share: shape and dtype here, units and frames in each docstring."""

from __future__ import annotations

from jaxtyping import Array, Bool, Float, Int, Key

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
PRNGKey = Key[Array, ""] | Int[Array, "2"]
