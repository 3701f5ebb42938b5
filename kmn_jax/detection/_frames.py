"""Points on the host under a pose, from its source frame to its target frame and back."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

MOST_BEHIND = 0.01  # share of a scan's points: with more behind a camera, it was not there


def placed(T: Float[np.ndarray, "4 4"], points: Float[np.ndarray, "*s 3"]) -> Float[np.ndarray, "*s 3"]:
    """Return points of a pose's source frame in its target frame."""
    return points @ T[:3, :3].T + T[:3, 3]


def into(T: Float[np.ndarray, "4 4"], points: Float[np.ndarray, "*s 3"]) -> Float[np.ndarray, "*s 3"]:
    """Return points of a pose's target frame in its source frame."""
    return (points - T[:3, 3]) @ T[:3, :3]
