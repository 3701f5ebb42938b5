"""Sizes and switches of the network, as they are saved with its parameters."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, Literal, get_args

from kmn_jax.errors import InputError, require, shown
from kmn_jax.models._attention import HEADS
from kmn_jax.models._invariants import Inputs
from kmn_jax.models._layers import Compute
from kmn_jax.models._pair_head import PairDropout

Graph = Literal["dynamic", "static"]
Normalization = Literal["metric", "released"]
ObjectBranch = Literal["cad", "learned"]
AttentionKind = Literal["none", "scene", "both"]

_CHOICES = {
    "normalization": get_args(Normalization),
    "inputs": get_args(Inputs),
    "object_branch": get_args(ObjectBranch),
    "graph": get_args(Graph),
    "compute": get_args(Compute),
    "pair_dropout": get_args(PairDropout),
    "attention": get_args(AttentionKind),
}
_ADDED_LATER = ("num_coarse_points", "attention")  # fields that networks of before do not have


@dataclass(frozen=True, repr=False)
class KeyMatchNetConfig:
    """Sizes and switches of the network; the defaults are the published ones, but for the input scaling.

    Attributes:
        num_scene_points, num_object_points, num_keypoints: N, M and K, the sizes that data is made for. The
            network itself takes any.
        normalization: "metric" divides both clouds by one length, "released" is what the authors' weights need.
        inputs: "raw" coordinates and normals as published, rotation "invariant" point pair features, or "chiral"
            ones, which also tell a shape from its mirror image, in the second block, too.
        graph: "dynamic" finds neighbours anew in feature space, "static" keeps those of the coordinates.
        object_branch: where keypoint features come from: the "cad" cloud, or "learned", for one object that the
            network is trained for, and its K fixed keypoints.
        object_digest: SHA-256 of that object's CAD file; empty for networks of any object.
        compute: arithmetic of the layers; statistics, distances and logits are float32 in all.
        pair_dropout: one dropout mask for all keypoints of a point ("shared"), or "per_pair" as published.
        num_coarse_points: scene points that also look farther, and tell all others what they see; none if it is 0.
        attention: "scene" for attention among the coarse points, in place of their second graph block, "both" for
            attention of all scene points to the keypoints as well.
    """

    num_scene_points: int = 2048
    num_object_points: int = 2048
    num_keypoints: int = 20
    num_neighbors: int = 20
    edge_width: int = 64
    embedding_width: int = 1024
    scene_width: int = 512
    object_width: int = 128
    pair_width: int = 256
    groups: int = 32
    dropout: float = 0.4
    pair_dropout: PairDropout = "shared"
    normalization: Normalization = "metric"
    inputs: Inputs = "raw"
    graph: Graph = "dynamic"
    object_branch: ObjectBranch = "cad"
    object_digest: str = ""
    compute: Compute = "float32"
    num_coarse_points: int = 0
    attention: AttentionKind = "none"

    def __post_init__(self) -> None:
        for name, choices in _CHOICES.items():
            if getattr(self, name) not in choices:
                raise InputError(
                    f"{name} is {shown(repr(getattr(self, name)))}, but must be one of {', '.join(choices)}"
                )
        sizes = ("num_scene_points", "num_object_points", "num_keypoints", "num_neighbors", "groups")
        widths = ("edge_width", "embedding_width", "scene_width", "object_width", "pair_width")
        for name in (*sizes, *widths):
            size = getattr(self, name)
            if not isinstance(size, int) or size < 1:
                raise InputError(f"{name} is {shown(repr(size))}, but must be a whole number, at least 1")
            if name in widths and size % self.groups:
                raise InputError(f"{name} is {size}, but must be a multiple of groups = {self.groups}")
        require(
            isinstance(self.num_coarse_points, int) and self.num_coarse_points >= 0,
            f"num_coarse_points is {shown(repr(self.num_coarse_points))}, but must be a whole number, at least 0",
        )
        if self.attention != "none":
            require(self.num_coarse_points > 0, f'attention "{self.attention}" needs num_coarse_points above 0')
            require(
                self.edge_width % HEADS == 0 and (self.attention == "scene" or self.object_width % HEADS == 0),
                f"attention needs edge_width = {self.edge_width}, and to the object also object_width ="
                f" {self.object_width}, to be multiples of its {HEADS} heads",
            )
        require(0 <= self.dropout < 1, f"dropout is {self.dropout}, but must be in [0, 1)")
        if self.inputs != "raw" and self.normalization == "released":
            raise InputError(
                f'inputs "{self.inputs}" need normalization "metric": "released" scales the axes of space unevenly'
            )
        if self.object_digest and self.object_branch == "cad":
            raise InputError("object_digest names the object of a network with learned features, which this is not")
        require(
            self.num_keypoints <= self.num_object_points,
            f"{self.num_keypoints} keypoints cannot be drawn from {self.num_object_points} object points",
        )
        fewest = min(self.num_scene_points, self.num_object_points)
        require(
            self.num_neighbors <= fewest,
            f"num_neighbors is {self.num_neighbors}, but clouds have only {fewest} points",
        )

    def told(self) -> dict[str, Any]:
        """Return all fields but those that networks of before do not have, where this one goes without, too.

        So these networks' files and digests stay what they were.
        """
        return {
            field.name: getattr(self, field.name)
            for field in fields(self)
            if field.name not in _ADDED_LATER or getattr(self, field.name) != field.default
        }

    def __repr__(self) -> str:
        return f"{type(self).__name__}({', '.join(f'{name}={value!r}' for name, value in self.told().items())})"
