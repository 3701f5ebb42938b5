"""What is left of scans from formulas: balls on a tilted floor, with the floor, an empty bin or a box taken away."""

from __future__ import annotations

import numpy as np
import pytest
from jaxtyping import Bool, Float

from kmn_jax.detection import ForegroundOptions, foreground
from kmn_jax.detection._planes import dominant_plane
from kmn_jax.errors import InputError
from kmn_jax.geometry import Camera
from kmn_jax.io import DepthCamera, Scan, depth_scan
from tests.bop.bop_sample import sphere_depth

CAMERA = Camera(300.0, 300.0, 159.5, 119.5, 320, 240)
DIAMETER = 60.0  # mm
NORMAL = np.array([0.2, -0.1, 1.0]) / np.linalg.norm([0.2, -0.1, 1.0])
AWAY = 700.0  # the floor from the sensor
BALLS = [(0.0, 0.0), (90.0, 60.0), (-110.0, 40.0), (30.0, -90.0)]


def floor_depth(away: float) -> Float[np.ndarray, "h w"]:
    x = (np.arange(CAMERA.width)[None, :] - CAMERA.cx) / CAMERA.fx
    y = (np.arange(CAMERA.height)[:, None] - CAMERA.cy) / CAMERA.fy
    return away / (x * NORMAL[0] + y * NORMAL[1] + NORMAL[2])


def as_scan(depth: Float[np.ndarray, "h w"], seed: int = 0, noise: float = 0.2, unit: str = "mm") -> Scan:
    noisy = np.where(np.isfinite(depth), depth + noise * np.random.default_rng(seed).normal(size=depth.shape), 0)
    intrinsics = DepthCamera(CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy, 1.0, None)
    return depth_scan(noisy, intrinsics, unit)


def balls_on_floor(unseen: bool = True) -> tuple[Scan, Bool[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return a scan, which of its points are of balls, and each point's height above the floor."""
    floor, depth = floor_depth(AWAY), floor_depth(AWAY)
    for x, y in BALLS:
        center = np.array([x, y, 0.0])
        center[2] = (AWAY - DIAMETER / 2 - center @ NORMAL) / NORMAL[2]  # resting on the floor
        depth = np.minimum(depth, sphere_depth(CAMERA, center, DIAMETER / 2))
    is_ball = depth < floor
    if unseen:
        depth[:10, :20] = np.inf
    scan = as_scan(depth)
    assert scan.depth is not None
    return scan, is_ball[scan.depth > 0], AWAY - scan.points @ NORMAL


def cloud(scan: Scan) -> Scan:
    return Scan(scan.points, None, None, None, scan.unit)


def check_balls(kept: np.ndarray, is_ball: np.ndarray, height: np.ndarray, margin: float) -> None:
    """Of balls, what is higher than the margin is kept, to the noise; nothing else is."""
    assert not kept[~is_ball].any()
    assert kept[is_ball & (height > 1.5 * margin)].mean() > 0.999
    assert kept[is_ball].mean() > 0.85


def test_a_floor_is_taken_away() -> None:
    scan, is_ball, height = balls_on_floor()
    kept, warnings = foreground(scan, DIAMETER)
    assert warnings == ()
    assert kept.shape == (len(scan.points),)
    check_balls(kept, is_ball, height, 0.03 * DIAMETER)
    again, _ = foreground(cloud(scan), DIAMETER)
    np.testing.assert_array_equal(again, kept)
    everything, warnings = foreground(scan, DIAMETER, ForegroundOptions(remove_plane="never"))
    assert everything.all()
    assert warnings == ()


def test_lengths_may_be_in_any_unit() -> None:
    scan, _, _ = balls_on_floor()
    kept, _ = foreground(scan, DIAMETER)
    metres, _ = foreground(scan.in_unit("m"), DIAMETER / 1000)
    assert (metres != kept).mean() < 1e-3  # rounding may move points over the margin


def test_what_lies_behind_the_floor_goes_with_it() -> None:
    """Reflections show deeper than the floor is."""
    scan, is_ball, height = balls_on_floor()
    deeper = np.flatnonzero(~is_ball)[::20]
    points = scan.points.copy()
    points[deeper] *= 1.2
    kept, _ = foreground(Scan(points, None, None, None, "mm"), DIAMETER)
    check_balls(kept, is_ball, height, 0.03 * DIAMETER)


def test_the_empty_bin_is_taken_away() -> None:
    scan, is_ball, height = balls_on_floor(unseen=False)
    empty = as_scan(floor_depth(AWAY), seed=1)
    for one, other in ((scan, empty), (cloud(scan), empty), (cloud(scan), cloud(empty).in_unit("m"))):
        kept, warnings = foreground(one, DIAMETER, ForegroundOptions(background=other))
        assert warnings == ()
        assert not kept[~is_ball].any()
        assert kept[is_ball & (height > 0.1 * DIAMETER)].mean() > 0.99
    with pytest.raises(InputError, match="points are those of the empty bin, or too near to it: is it really empty"):
        foreground(scan, DIAMETER, ForegroundOptions(background=scan))


def test_a_depth_image_shows_background_along_its_rays() -> None:
    """A pixel in front of the empty bin counts, even if its point is near to a wall beside it: the image tells both."""
    scan, _, _ = balls_on_floor()
    moved = as_scan(floor_depth(AWAY) + 100)
    kept, warnings = foreground(scan, DIAMETER, ForegroundOptions(background=moved))
    assert kept.all()
    (warning,) = warnings
    assert warning.startswith("the scan of the empty bin takes only 0.0% of the points away: if parts do not hide")


def test_a_box_limits_what_is_looked_at() -> None:
    scan, is_ball, height = balls_on_floor()
    roi = (-50.0, -50.0, 0.0, 50.0, 50.0, 800.0)
    inside = (np.abs(scan.points[:, :2]) <= 50).all(axis=1)
    kept, _ = foreground(scan, DIAMETER, ForegroundOptions(roi=roi, remove_plane="never"))
    np.testing.assert_array_equal(kept, inside)
    kept, _ = foreground(scan, DIAMETER, ForegroundOptions(roi=roi))
    np.testing.assert_array_equal(kept & ~inside, False)
    check_balls(kept[inside], is_ball[inside], height[inside], 0.03 * DIAMETER)
    with pytest.raises(InputError, match=r"region of interest holds none of the .* points: the scan has x from -"):
        foreground(scan, DIAMETER, ForegroundOptions(roi=(0.0, 0.0, 0.0, 1.0, 1.0, 1.0)))


def plates(gaps: int) -> tuple[Scan, Bool[np.ndarray, "h w"]]:
    """Return a layer of plates on the floor, whose tops are the largest plane, and where they are."""
    is_plate = (np.arange(320)[None, :] % 32 >= gaps) & (np.arange(240)[:, None] % 32 >= gaps)
    return as_scan(np.where(is_plate, floor_depth(AWAY - 20), floor_depth(AWAY))), is_plate


def test_tops_of_parts_are_no_floor() -> None:
    scan, is_plate = plates(6)
    assert 0.6 < is_plate.mean() < 0.7
    kept, (warning,) = foreground(scan, DIAMETER)
    np.testing.assert_array_equal(kept, is_plate.ravel())
    assert "a plane with 65% of the points was kept, in front of the one that was taken away: if" in warning
    with pytest.raises(InputError, match="lie in one plane or behind it"):
        foreground(scan, DIAMETER, ForegroundOptions(remove_plane="always"))


def test_tops_that_hide_most_of_the_floor_are_kept() -> None:
    scan, _ = plates(3)
    kept, (warning,) = foreground(scan, DIAMETER)
    assert kept.all()
    assert "was kept, as many lie behind it: if it is the floor, give a region of interest (--roi)" in warning


def test_a_single_plane_is_not_thrown_away_unasked() -> None:
    scan = as_scan(floor_depth(AWAY))
    kept, (warning,) = foreground(scan, DIAMETER)
    assert kept.all()
    assert warning.endswith("if it is the floor, say --plane always")
    assert "of the points was kept, as only 0.0% lie in front of it" in warning
    with pytest.raises(InputError, match="lie in one plane or behind it: if they show objects, keep the plane"):
        foreground(scan, DIAMETER, ForegroundOptions(remove_plane="always"))


def test_faces_of_a_part_are_no_floor() -> None:
    """A view of one part only: its face is the largest plane, but not larger than the part."""
    scan, _, _ = balls_on_floor()
    near = np.linalg.norm(scan.points - scan.points[len(scan.points) // 2], axis=1) < DIAMETER / 2
    crop = Scan(scan.points[near], None, None, None, "mm")
    kept, warnings = foreground(crop, DIAMETER)
    assert kept.all()
    assert warnings == ()


def test_balls_without_a_floor_are_kept() -> None:
    scan, is_ball, _ = balls_on_floor()
    balls = Scan(scan.points[is_ball], None, None, None, "mm")
    kept, warnings = foreground(balls, DIAMETER)
    assert kept.all()
    assert warnings == ()
    _, (warning,) = foreground(balls, DIAMETER, ForegroundOptions(remove_plane="always", least_share=0.5))
    assert "the largest plane was taken away as asked, though it holds only" in warning


def test_the_plane_is_that_of_most_points() -> None:
    scan, _, _ = balls_on_floor()
    plane = dominant_plane(scan.points, 1.8)
    assert plane is not None
    np.testing.assert_allclose(plane.normal, NORMAL, atol=1e-3)
    assert plane.offset == pytest.approx(AWAY, abs=0.1)
    np.testing.assert_allclose(plane.height(np.zeros((1, 3))), -plane.offset)
    again = dominant_plane(scan.points, 1.8)
    assert again is not None
    np.testing.assert_array_equal(again.normal, plane.normal)
    for few in (np.ones((2, 3)), np.ones((9, 3))):
        assert dominant_plane(few, 1.0) is None
    kept, (warning,) = foreground(
        Scan(np.ones((2, 3), np.float32), None, None, None, "mm"), DIAMETER, ForegroundOptions(remove_plane="always")
    )
    assert kept.all()
    assert "none was found" in warning


def test_bad_options_are_named() -> None:
    scan, _, _ = balls_on_floor()
    with pytest.raises(InputError, match="each min below its max"):
        ForegroundOptions(roi=(0.0, 0.0, 0.0, 1.0, 0.0, 1.0))
    with pytest.raises(InputError, match=r"roi \(xmin ymin zmin xmax ymax zmax\) must be 6 finite numbers"):
        ForegroundOptions(roi=(0.0, 0.0, 0.0, 1.0, 1.0, float("nan")))
    with pytest.raises(InputError, match="plane_margin is 0"):
        ForegroundOptions(plane_margin=0.0)
    with pytest.raises(InputError, match="least_share is 1"):
        ForegroundOptions(least_share=1.0)
    with pytest.raises(InputError, match="diameter is -1"):
        foreground(scan, -1.0)
