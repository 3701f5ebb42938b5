"""Limits that hold by default: how long a decoder may take, how many points a scan may have."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from kmn_jax.errors import InputError
from kmn_jax.io import _apart, _scans, read_scan


def test_a_decoder_that_hangs_is_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    assert _apart._SECONDS == 300
    monkeypatch.setattr(_apart, "_SECONDS", 0.5)
    with pytest.raises(InputError, match=r"its decoding takes longer than 0\.5 s"):
        _apart.decoded_apart(b"", "import time\ntime.sleep(60)", "numpy")


def test_a_scan_of_too_many_points_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert _scans._MOST_POINTS == 50_000_000
    np.save(tmp_path / "a.npy", np.ones((11, 3), dtype=np.float32))
    monkeypatch.setattr(_scans, "_MOST_POINTS", 10)
    with pytest.raises(InputError, match="has 11 points, more than 10: thin it out"):
        read_scan(tmp_path / "a.npy", "mm")
