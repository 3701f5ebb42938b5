"""The released network that is taken unless another one is named."""

from __future__ import annotations

RELEASED = "wide"
