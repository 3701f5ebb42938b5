"""A network of the smallest widths: for what is not about accuracy."""

from kmn_jax.models import KeyMatchNetConfig

TINY = KeyMatchNetConfig(
    num_scene_points=64,
    num_object_points=64,
    num_keypoints=4,
    num_neighbors=4,
    edge_width=8,
    embedding_width=16,
    scene_width=16,
    object_width=8,
    pair_width=8,
    groups=4,
    inputs="invariant",
    graph="static",
)
