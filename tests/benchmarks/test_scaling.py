from __future__ import annotations

import pytest

from benchmarks.scaling import Growth, fitted, plan_rows


def test_fits_find_what_times_are_made_of() -> None:
    truth = Growth(constant=3.0, linear=0.01, square=2e-5)
    sizes = (128, 256, 512, 1024, 2048)
    found = fitted(sizes, [truth.at(size) for size in sizes])
    assert found == pytest.approx(truth, rel=1e-6)
    assert found.at(4096) == pytest.approx(truth.at(4096), rel=1e-6)


def test_nothing_grows_below_zero() -> None:
    assert fitted((1, 2, 4), (4.0, 4.0, 3.9)).linear == 0


def test_the_bend_is_where_the_square_takes_over() -> None:
    growth = Growth(constant=5.0, linear=0.02, square=1e-5)
    bend = growth.bend
    assert bend is not None
    assert growth.square * bend**2 == pytest.approx(growth.constant + growth.linear * bend)
    assert Growth(1.0, 1.0, 0.0).bend is None


def test_a_plan_counts_machines_and_bytes() -> None:
    needed = [
        row["needed"] for row in plan_rows(Growth(10, 5, 0), {"card kB": 100, "on the device kB": 20, "encode ms": 6})
    ]
    assert needed == pytest.approx([90, 100, 9, 1, 200, 1])
