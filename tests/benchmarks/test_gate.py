from __future__ import annotations

import json

import jax
import numpy as np
import pytest

from benchmarks import gate
from benchmarks.network_cases import make_case
from kmn_jax.errors import InputError


def test_a_ratio_that_has_fallen_too_far_is_named() -> None:
    baseline = {"a": 10.0, "b": 10.0, "c": 10.0}
    rows, slower = gate.compared({"a": 10.1, "b": 10 * gate.LEAST + 0.01, "c": 10 * gate.LEAST - 0.01}, baseline)
    assert slower == ["c"]
    assert [row["pair"] for row in rows] == ["a", "b", "c"]
    assert all(row["least"] == pytest.approx(10 * gate.LEAST) for row in rows)


def test_what_has_fallen_is_measured_again_and_only_that() -> None:
    baseline, calls = {"steady": 10.0, "disturbed": 10.0, "slower": 10.0}, list[str]()

    def measure(name: str) -> float:
        calls.append(name)
        return {"disturbed": 9.0, "slower": 5.0}[name]

    ratios = gate.looked_at_again({"steady": 10.0, "disturbed": 4.0, "slower": 4.0}, baseline, measure)
    assert ratios == {"steady": 10.0, "disturbed": 9.0, "slower": 5.0}
    assert calls == ["disturbed", "slower", "slower"]
    assert gate.compared(ratios, baseline)[1] == ["slower"]


def test_a_processor_is_compared_with_itself_or_with_the_lowest() -> None:
    found = {"one": {"a": 3.0, "b": 1.5}, "other": {"a": 2.0, "b": 2.5}}
    assert gate.baseline_for("one", found) == (found["one"], "one")
    lowest, of = gate.baseline_for("third", found)
    assert lowest == {"a": 2.0, "b": 1.5}
    assert of == "other processors (one, other), the lowest of each, as third has none"


def test_a_baseline_of_other_pairs_is_refused() -> None:
    with pytest.raises(InputError, match="'b', 'c'"):
        gate.compared({"a": 1.0, "b": 1.0}, {"a": 1.0, "c": 1.0})


def test_committed_baselines_say_where_they_are_from() -> None:
    files = [json.loads(path.read_text(encoding="utf-8")) for path in gate.BASELINES.glob("*.json")]
    assert {file["environment"]["platform"] for file in files} == {"cpu"}
    found = gate.read_baselines(gate.BASELINES)
    assert len(found) == len(files) > 1
    assert len({frozenset(ratios) for ratios in found.values()}) == 1
    assert all(ratio > 1 for ratios in found.values() for ratio in ratios.values())


@jax.numpy_rank_promotion("allow")  # the dense reference is written plainly
def test_both_sides_of_a_pair_compute_the_same() -> None:
    whole = make_case(1)
    case = whole._replace(
        crops=whole.crops[:, :512], clouds=whole.clouds[:, :512], keypoint_indices=whole.keypoint_indices % 512
    )
    for pair in (gate.network_pair(case), gate.head_pair(case)):
        for ours, plain in zip(pair.ours(), pair.plain(), strict=True):
            plain = np.asarray(plain).reshape(np.shape(ours))
            # All but what hangs on a neighbour that is no nearer than another one, to float32.
            assert (np.abs(np.asarray(ours) - plain) < 1e-4 * np.ptp(plain)).mean() > 0.999
    pair = gate.gradient_pair(case)
    ours, plain = (jax.tree.leaves(side()) for side in pair)
    largest = max(float(np.abs(leaf).max()) for leaf in plain)
    assert len(ours) == len(plain)
    assert sum(leaf.size for leaf in ours) == sum(leaf.size for leaf in plain)
    assert sum(float(np.square(leaf).sum()) for leaf in map(np.asarray, ours)) == pytest.approx(
        sum(float(np.square(leaf).sum()) for leaf in map(np.asarray, plain)), rel=1e-2
    )
    assert largest > 0
