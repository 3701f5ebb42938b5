"""6D pose estimation of parts in a bin from a CAD model and a colourless point cloud, in JAX.

The names below are what most users need. They are imported when they are first used: `import kmn_jax` alone loads
neither JAX nor what reads files.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from kmn_jax.detection import Detection, Detections, ForegroundOptions, PoseEstimator, Scene
    from kmn_jax.errors import InputError
    from kmn_jax.io import Scan, read_scan
    from kmn_jax.models import KeyMatchNet, encode_object, encode_scene, load_pretrained, load_released, match
    from kmn_jax.objects import Part
    from kmn_jax.pose import PoseResult, adi, find_matches, icp, kabsch, mssd, ransac

_ROOMS = {
    "detection": ("Detection", "Detections", "ForegroundOptions", "PoseEstimator", "Scene"),
    "errors": ("InputError",),
    "io": ("Scan", "read_scan"),
    "models": ("KeyMatchNet", "encode_object", "encode_scene", "load_pretrained", "load_released", "match"),
    "objects": ("Part",),
    "pose": ("PoseResult", "adi", "find_matches", "icp", "kabsch", "mssd", "ransac"),
}
_ROOM_OF = {name: room for room, names in _ROOMS.items() for name in names}

__all__ = [
    "Detection",
    "Detections",
    "ForegroundOptions",
    "InputError",
    "KeyMatchNet",
    "Part",
    "PoseEstimator",
    "PoseResult",
    "Scan",
    "Scene",
    "adi",
    "encode_object",
    "encode_scene",
    "find_matches",
    "icp",
    "kabsch",
    "load_pretrained",
    "load_released",
    "match",
    "mssd",
    "ransac",
    "read_scan",
]


def __getattr__(name: str) -> Any:
    if name not in _ROOM_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_ROOM_OF[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
