"""The crowd of connections counts what it opens, and somebody else is answered meanwhile."""

from __future__ import annotations

from pathlib import Path

import pytest

from kmn_jax.serve import ServeConfig
from tests.attack import crowd
from tests.serve.serve_sample import running


def test_a_crowd_is_held_within_the_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(crowd, "_EVERY", 20)
    monkeypatch.setattr(crowd, "_most_files", lambda: crowd._SPARE + 30)
    with running(tmp_path, ServeConfig(port=0, most_connections=8)) as server:
        found = crowd.crowded(server, 50)
    assert (found.connections, found.asked, found.refused) == (50, 3, 0)
    assert found.held_at_once == 30
    assert 8 <= found.most_at_server <= 9
