"""Settings of the search beside each other: what they change, and how what they find is counted."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from experiments import detect_worlds, search_curve
from experiments.detect_bins import Tally
from experiments.search_curve import PLAIN, SETTINGS, Options, run
from kmn_jax.detection import FAST, THOROUGH, DetectConfig, Detections, Timing
from kmn_jax.errors import InputError
from kmn_jax.pose import RIGHT, THRESHOLDS


def test_settings_differ_in_what_their_names_say() -> None:
    assert SETTINGS[PLAIN] == DetectConfig()
    numbers = {"four": 4, "eight": 8}
    for name, config in SETTINGS.items():
        crops = config.search.crops
        base = next((known for word, known in (("thorough", THOROUGH), ("fast", FAST)) if word in name), DetectConfig())
        draws = [number for word, number in numbers.items() if f"{word} draw" in name] or [base.search.crops.num_draws]
        points = [int(number.replace(",", "")) for number in re.findall(r"([\d,]+) points", name)]
        points = points or [base.search.crops.num_points]
        assert (crops.num_draws, crops.num_points) == (draws[0], points[0])
        rounds = [int(number) for number in re.findall(r"patience (\d+)", name)] or [base.patience]
        patience = None if "all finely" in name else rounds[0]
        promising = [float(number) for number in re.findall(r"goes on from ([\d.]+)", name)] or [base.promising]
        expected = replace(base, patience=patience, promising=promising[0])
        if name == "best alone":
            expected = replace(expected, next_best=0, sure=0.0)
        assert replace(config, search=base.search) == expected


def test_a_setting_is_what_is_searched_with(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[DetectConfig] = []

    def fake(*given: Any) -> Detections:
        asked.append(given[-1])
        return Detections("part", "mm", (), Timing({"search": 1.0}, 0.0), "nothing was found")

    monkeypatch.setattr(detect_worlds, "make_scene", lambda *_: object())
    monkeypatch.setattr(detect_worlds, "detect", fake)
    part, scan = SimpleNamespace(diameter=1.0, name="part"), SimpleNamespace(unit="mm")
    image: Any = SimpleNamespace(part=part, scan=scan, visible=np.zeros(0), truth=np.zeros((0, 4, 4)))
    for name in SETTINGS:
        assert search_curve._searched(None, None, image, name).seconds == [1.0]  # type: ignore[arg-type]
    assert asked == [*SETTINGS.values()]


def right_poses(probability: list[float], seconds: float) -> Tally:
    """Return what is counted of an image all of whose copies have a right pose."""
    count = len(probability)
    right, states = [True] * count, [(RIGHT,) * len(THRESHOLDS)] * count
    return Tally(probability, right, right, count, [seconds], [(0.0, 0.0, 0.0)] * count, states)


def test_copies_and_times_stand_beside_those_of_the_search_as_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of two copies in each of four images a setting finds one in half of the time, and one pose of its is doubtful."""
    searched: list[str] = []

    def fake(model: Any, probabilities: Any, image: Any, name: str) -> Tally:
        searched.append(name)
        if name == PLAIN:
            return right_poses([0.9, 0.9], seconds=2.0)
        return right_poses([0.9, 0.5], seconds=1.0)

    monkeypatch.setattr(search_curve, "world_images", lambda *_: [object()] * 4)
    monkeypatch.setattr(search_curve, "load_pretrained", lambda: None)
    monkeypatch.setattr(search_curve, "_searched", fake)
    options = Options(settings=("four draws", PLAIN), json=tmp_path / "curve.json", picture=tmp_path / "curve.png")
    one, plain = run(options)
    assert searched.count(PLAIN) == searched.count("four draws") == 5  # the first of each compiles, and is not counted
    assert (one["recall"], plain["recall"]) == (0.5, 1.0)
    assert (one["copies"], one["images"], one["median s"], one["times as long"]) == (8, 4, 1.0, 0.5)
    wide = [row["difference of recall, 95%"] for row in (one, plain)]
    assert wide == ["-0.500 to -0.500", "+0.000 to +0.000"]
    assert json.loads((tmp_path / "curve.json").read_text())["settings"] == [one, plain]
    assert (tmp_path / "curve.png").read_bytes().startswith(b"\x89PNG")


def test_what_was_searched_before_an_interruption_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    left = [*SETTINGS] * 3  # the first image twice, another one once

    def fake(*given: Any) -> Tally:
        if not left:
            raise KeyboardInterrupt
        left.pop()
        return right_poses([0.9], seconds=1.0)

    monkeypatch.setattr(search_curve, "world_images", lambda *_: [object()] * 9)
    monkeypatch.setattr(search_curve, "load_pretrained", lambda: None)
    monkeypatch.setattr(search_curve, "_searched", fake)
    assert [row["images"] for row in run(Options())] == [2] * len(SETTINGS)


def test_bad_input_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match="no settings are called 'none': choose among fast"):
        run(Options(settings=("none", PLAIN)))
    with pytest.raises(InputError, match="'as it is', which others are compared with, is missing"):
        run(Options(settings=("four draws",)))
    monkeypatch.setattr(search_curve, "world_images", lambda *_: [])
    with pytest.raises(InputError, match=r"no image of .* was searched"):
        run(Options(settings=(PLAIN,)))
