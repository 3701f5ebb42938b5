"""What is left of a bin whose walls, and perhaps floor, are taken away: balls, and layers of flat parts."""

from __future__ import annotations

import numpy as np
import pytest
from jaxtyping import Float

from kmn_jax.detection import ForegroundOptions, foreground
from kmn_jax.detection._planes import Plane, dominant_plane
from kmn_jax.detection._walls import Ground, off_walls
from kmn_jax.io import Scan

DIAMETER, MARGIN, LONG = 60.0, 1.8, 90.0  # mm
LENGTH, WIDTH, HEIGHT = 400.0, 300.0, 120.0
AWAY = 700.0  # the floor from the sensor
RIM = 8.0


def rectangle(
    generator: np.random.Generator, low: tuple[float, float, float], high: tuple[float, float, float]
) -> Float[np.ndarray, "n 3"]:
    """Return points over a rectangle between two corners, one to 6 square millimetres."""
    sides = np.sort(np.subtract(high, low))
    count = int(sides[1] * sides[2] / 6)
    return generator.uniform(low, high, (count, 3)) + generator.normal(0, 0.2, (count, 3))


def bin_points(generator: np.random.Generator, floor: bool = True) -> Float[np.ndarray, "n 3"]:
    """Return an open box below the sensor, whose z axis points down; its walls end in rims."""
    x, y, top = LENGTH / 2, WIDTH / 2, AWAY - HEIGHT
    faces = [((side * x, -y, top), (side * x, y, AWAY)) for side in (-1, 1)]
    faces += [((-x, side * y, top), (x, side * y, AWAY)) for side in (-1, 1)]
    faces += [((side * x, -y, top), (side * (x + RIM), y, top)) for side in (-1, 1)]
    faces += [((-x, side * y, top), (x, side * (y + RIM), top)) for side in (-1, 1)]
    faces += [((-x, -y, AWAY), (x, y, AWAY))] if floor else []
    return np.concatenate(
        [rectangle(generator, tuple(np.minimum(a, b)), tuple(np.maximum(a, b))) for a, b in faces]
    ).astype(np.float32)


def balls(generator: np.random.Generator, height: float = 0.0) -> Float[np.ndarray, "n 3"]:
    """Return the upper halves of balls that lie in rows in the bin."""
    places = np.stack(np.meshgrid(np.arange(-150, 151, 65.0), np.arange(-100, 101, 65.0)), axis=-1).reshape(-1, 2)
    up = generator.normal(size=(len(places), 1500, 3))
    up /= np.linalg.norm(up, axis=2, keepdims=True)
    up[..., 2] = -np.abs(up[..., 2])
    centers = np.concatenate([places, np.full((len(places), 1), AWAY - DIAMETER / 2 - height)], axis=1)
    return (centers[:, None] + up * DIAMETER / 2).reshape(-1, 3).astype(np.float32)


def tilted(points: Float[np.ndarray, "n 3"], angle: float) -> Float[np.ndarray, "n 3"]:
    """Return points as a camera sees them that looks at the floor's middle from the side."""
    middle = np.array([0, 0, AWAY])
    turn = np.array([[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]])
    return ((points - middle) @ turn.T + middle).astype(np.float32)


@pytest.mark.parametrize("tilt", [0.0, 0.5])
def test_walls_are_taken_away_however_the_camera_looks(tilt: float) -> None:
    generator = np.random.default_rng(0)
    box, parts = bin_points(generator), balls(generator)
    points = tilted(np.concatenate([box, parts]), tilt)
    kept, warnings = foreground(Scan(points, None, None, None, "mm"), DIAMETER)
    assert warnings == ()
    assert kept[: len(box)].mean() < 0.01
    assert kept[len(box) :].mean() > 0.95
    everything, _ = foreground(Scan(points, None, None, None, "mm"), DIAMETER, ForegroundOptions(remove_plane="never"))
    assert everything.all()


def test_the_floor_of_a_full_bin_is_found_between_the_walls() -> None:
    generator = np.random.default_rng(1)
    box, floor = bin_points(generator, floor=False), rectangle(generator, (-190, 140, AWAY), (190, 148, AWAY))
    parts = balls(generator, height=5.0)
    points = np.concatenate([box, floor, parts]).astype(np.float32)
    kept = off_walls(points, None, False, MARGIN, LONG)
    outside = len(box) + len(floor)
    assert kept[: len(box)].mean() < 0.01
    assert kept[len(box) : outside].mean() < 0.05
    assert kept[outside:].mean() > 0.95
    np.testing.assert_array_equal(off_walls(points, None, False, MARGIN, LONG), kept)


def test_a_layer_of_flat_parts_is_no_wall() -> None:
    generator = np.random.default_rng(2)
    tops = [
        rectangle(generator, (x, y, AWAY - 10), (x + 50, y + 40, AWAY - 10))
        for x in range(-180, 131, 55)
        for y in range(-140, 101, 45)
    ]
    parts = np.concatenate(tops).astype(np.float32)
    floor = Ground(Plane(np.array([0.0, 0.0, 1.0]), AWAY), np.zeros((0, 3), dtype=np.float32))
    assert off_walls(parts, floor, True, MARGIN, LONG).all()
    assert off_walls(parts, None, False, MARGIN, LONG).all()
    points = np.concatenate([bin_points(generator, floor=False), parts]).astype(np.float32)
    kept = off_walls(points, floor, True, MARGIN, LONG)
    assert kept[-len(parts) :].all()
    assert kept[: -len(parts)].mean() < 0.01


def table(generator: np.random.Generator) -> Float[np.ndarray, "n 3"]:
    return rectangle(generator, (-400, -400, AWAY), (400, 400, AWAY))


@pytest.mark.parametrize("tilt", [0.0, 0.9, 1.1])
def test_flat_parts_on_a_table_stay_however_the_camera_looks(tilt: float) -> None:
    generator = np.random.default_rng(6)
    floor = table(generator)
    parts = np.concatenate(
        [
            rectangle(generator, (x, y, AWAY - 15), (x + 50, y + 40, AWAY - 15))
            for x in range(-180, 131, 55)
            for y in range(-140, 101, 45)
        ]
    )
    points = tilted(np.concatenate([floor, parts]), tilt)
    kept, _ = foreground(Scan(points, None, None, None, "mm"), DIAMETER)
    assert kept[len(floor) :].mean() > 0.98


@pytest.mark.parametrize("tilt", [0.1, 0.6])
@pytest.mark.parametrize("apart", [80, 200])
def test_rows_of_standing_plates_are_no_walls(tilt: float, apart: int) -> None:
    """Their faces lie in planes that are long and upright, and the outermost have all on one side."""
    generator = np.random.default_rng(7)
    floor = table(generator)
    plates = np.concatenate(
        [
            rectangle(generator, (x, y, AWAY - 70), (x + 60, y, AWAY))
            for x in range(-180, 101, 70)
            for y in range(-200, 201, apart)
        ]
    )
    points = tilted(np.concatenate([floor, plates]), tilt)
    kept, _ = foreground(Scan(points, None, None, None, "mm"), 92.0)
    assert kept[len(floor) :].mean() > 0.9


def test_of_rows_in_a_bin_no_more_goes_than_a_side() -> None:
    generator = np.random.default_rng(8)
    rows = [rectangle(generator, (-180, y, AWAY - 70), (180, y, AWAY)) for y in range(-120, 121, 40)]
    points = np.concatenate(rows).astype(np.float32)
    kept = off_walls(points, None, False, MARGIN, LONG)
    assert kept.mean() > 0.6  # without walls and floor the outer rows are taken for walls, but not those behind them


def test_without_walls_all_stays() -> None:
    generator = np.random.default_rng(3)
    for points in (balls(generator), generator.normal(size=(2, 3)).astype(np.float32), np.zeros((5, 3), np.float32)):
        assert off_walls(points, None, False, MARGIN, LONG).all()


def test_one_wall_alone_is_not_taken_away() -> None:
    wall = rectangle(np.random.default_rng(4), (-200, 150, AWAY - 100), (200, 150, AWAY)).astype(np.float32)
    assert off_walls(wall, None, False, MARGIN, LONG).all()


@pytest.mark.parametrize("local", [False, True])
def test_the_plane_of_most_points_is_that_of_an_exact_count(local: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Single precision only says which planes are counted exactly; if all of them are, it is the same one."""
    for seed in range(3):
        generator = np.random.default_rng(seed)
        points = np.concatenate([bin_points(generator), balls(generator)])
        found = dominant_plane(points, MARGIN, seed, local)
        with monkeypatch.context() as patch:
            patch.setattr("kmn_jax.detection._planes._ROUNDED", len(points))
            exact = dominant_plane(points, MARGIN, seed, local)
        assert found is not None
        assert exact is not None
        np.testing.assert_array_equal(found.normal, exact.normal)
        assert found.offset == exact.offset


def test_local_triples_find_small_planes() -> None:
    generator = np.random.default_rng(5)
    small = rectangle(generator, (-30, -30, AWAY), (30, 30, AWAY))
    rest = generator.uniform(-300, 300, (20 * len(small), 3)) + np.array([0, 0, AWAY])
    turn, _ = np.linalg.qr(generator.normal(size=(3, 3)))
    points = (np.concatenate([small, rest]) @ turn.T).astype(np.float32)
    plane = dominant_plane(points, 1.0, local=True)
    assert plane is not None
    assert np.abs(plane.height(points[: len(small)])).mean() < 0.5
