"""How long a decoder may take; how large files may be is in tests/test_limits.py."""

from __future__ import annotations

import pytest

from kmn_jax.errors import InputError
from kmn_jax.io import _apart


def test_a_decoder_that_hangs_is_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    assert _apart._SECONDS == 300
    monkeypatch.setattr(_apart, "_SECONDS", 0.5)
    with pytest.raises(InputError, match=r"its decoding takes longer than 0\.5 s"):
        _apart.decoded_apart(b"", "import time\ntime.sleep(60)", "numpy")
