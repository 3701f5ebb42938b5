from __future__ import annotations

import pytest

from experiments.demo import DemoConfig, main


def test_demo_finds_the_pose(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(DemoConfig()) == 0
    printed = capsys.readouterr().out
    assert "T_scene_object, estimated" in printed
    assert printed.strip().endswith("right")


def test_demo_says_when_there_is_none(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(DemoConfig(wrong_share=1.0)) == 1
    printed = capsys.readouterr().out
    assert "no pose: " in printed or printed.strip().endswith("wrong")
