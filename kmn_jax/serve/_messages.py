"""What goes over the wire, as types: the OpenAPI document is made of them."""

# Pydantic reads the annotations when a class is made: here they are no strings.

from pydantic import BaseModel, ConfigDict, Field

_Matrix = list[list[float]]


class _Exact(BaseModel):
    model_config = ConfigDict(extra="forbid")


class _Open(BaseModel):
    """Fields may be added in later versions."""

    model_config = ConfigDict(extra="allow")


class PartInfo(_Exact):
    """A part that the server knows."""

    name: str = Field(description="what requests call it")
    label: str = Field(description="the name that its file or card gives it")
    unit: str = Field(description="of its lengths")
    diameter: float
    size: list[float] = Field(description="of the axis-aligned box around it", min_length=3, max_length=3)
    is_symmetric: bool = Field(description="whether another pose looks the same")
    source_digest: str = Field(description="SHA-256 of the file that it was made of")
    question: str | None = Field(None, description="asked of an unlikely size: the unit may be another")


class PartList(_Exact):
    """All parts with names."""

    parts: list[PartInfo]


class PoseInfo(_Open):
    """One found copy; docs/detect.md says what the numbers mean."""

    T_scene_object: _Matrix = Field(description="4 x 4, object to scene, lengths in the result's unit")
    probability: float = Field(ge=0, le=1)
    num_inliers: int = Field(description="matches that agree on the pose")
    inliers: int = Field(description="the same as `num_inliers`")
    visible_fraction: float
    runner_up_gap: float
    explained: float
    violated: float
    occluded: float
    unknown: float
    seed: list[float] = Field(description="the point of the scan that was searched around", min_length=3, max_length=3)
    warnings: list[str]
    T_base_object: _Matrix | None = Field(description="null: the server knows no robot")
    grasps: list[object] | None = Field(description="null, likewise")


class TimingInfo(_Open):
    """Seconds; further fields `STAGE_s` are those of the stages."""

    __pydantic_extra__: dict[str, float] = Field(init=False)
    total_s: float
    compile_s: float


class DetectionResult(_Open):
    """Poses in pick order: what `kmn detect --json` writes."""

    version: int
    unit: str = Field(description="of all lengths")
    object: str = Field(description="the part's name, or that of the file that was sent")
    scene: str = Field(description="name of the scan's file")
    poses: list[PoseInfo]
    timing: TimingInfo
    reason: str | None = Field(description="why there are no poses")
    unexplained: float | None = Field(description="share of the foreground on no likely pose; null with `at`")
    warnings: list[str]
    seed: int = Field(description="the number that all randomness started from")
    weights: str
    model: str = Field(description="digest of the weights")


class Health(_Exact):
    """Whether the server answers searches."""

    status: str = Field(description="ready, or warming up")
    version: str
    weights: str
    parts: int
    queued: int = Field(description="requests that wait or run")


class Problem(_Exact):
    """Why a request was not done, in one sentence."""

    error: str
