"""Pictures of a scan whose pixels are known: they are whole, show what was found, and code it against the truth."""

from __future__ import annotations

import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from kmn_jax.detection import CropPrediction, Detection, Detections, Scene, warnings_once
from kmn_jax.errors import InputError
from kmn_jax.objects import Part, Symmetries
from kmn_jax.viz import TRUTH_COLORS, distinct_colors, save_picture, truth_codes
from kmn_jax.viz._legend import UNEXPLAINED, fitting
from kmn_jax.viz._raster import Canvas
from kmn_jax.viz._truth import BACKGROUND, FALSE_PART, MISSED, RIGHT, WRONG_KEYPOINT, surface_distances
from tests.detection.box_sample import CAMERA, POSES, SIZES, both_boxes, box_part, box_view
from tests.reference.meshes import pose, random_rotations

POSES_PANEL = -1
CROPS, KEYPOINTS = 1, 2  # the small panels, from above; the first is the scan


@pytest.fixture(scope="module")
def part() -> Part:
    return box_part()


@pytest.fixture(scope="module")
def view() -> Scene:
    return box_view()


@pytest.fixture(scope="module")
def found(part: Part, view: Scene) -> Detections:
    return both_boxes(part, view)


def drawn(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        assert image.format == "PNG"
        return np.asarray(image.convert("RGB"))


def places(image: np.ndarray, color: np.ndarray | tuple[float, ...]) -> np.ndarray:
    """Return row and column of the pixels of a colour in [0, 1], of those that are not in the legend below."""
    wanted = np.round(255 * np.asarray(color)).astype(int)
    rows, columns = np.nonzero((np.abs(image.astype(int) - wanted) <= 1).all(axis=2))
    return np.stack([rows, columns], axis=1)[rows < 0.93 * len(image)]


def in_panel(image: np.ndarray, points: np.ndarray, panel: int) -> np.ndarray:
    """Return those pixels that are in a panel: POSES_PANEL, on the left, or one of the small ones beside it."""
    height, width = image.shape[:2]
    beside = points[:, 1] > 0.567 * width
    if panel == POSES_PANEL:
        return points[~beside]
    return points[beside & (points[:, 1] < 0.77 * width) & (3 * points[:, 0] // (0.95 * height) == panel)]


def with_faults(detection: Detection) -> Detection:
    """Return the left box with faults: the left third missed, above right wrong, some of the wall taken for it."""
    prediction = detection.prediction
    points, on, keypoint = prediction.points, prediction.on_object.copy(), prediction.keypoint.copy()
    x, y = points[:, 0] - detection.seed[0], points[:, 1] - detection.seed[1]
    wrong = on & (x > -SIZES[0] / 6) & (y < 0)
    keypoint[wrong] = (keypoint[wrong] + 1) % 8
    wall = ~on
    on[on & (x < -SIZES[0] / 6)] = False
    on[wall & (x < -SIZES[0] / 2)] = True
    return replace(detection, prediction=CropPrediction(points, on, keypoint))


def test_the_picture_shows_every_pose_in_its_colour(part: Part, view: Scene, found: Detections, tmp_path: Path) -> None:
    path = tmp_path / "result.png"
    save_picture(path, view, part, found)
    assert [file.name for file in tmp_path.iterdir()] == ["result.png"]
    before = path.read_bytes()
    save_picture(path, view, part, found)
    assert path.read_bytes() == before
    image = drawn(path)
    assert min(image.shape[:2]) > 600
    # The poses are drawn larger than all else.
    large, small = (
        np.ptp(in_panel(image, places(image, shade), panel)[:, 1])
        for shade, panel in ((distinct_colors(2)[0] * 0.75, POSES_PANEL), (distinct_colors(2)[0], CROPS))
    )
    assert large > 2 * small
    left, right = distinct_colors(2)
    one, other = (in_panel(image, places(image, color), CROPS) for color in (left, right))
    assert len(one) > 2000  # the points taken for either box
    assert len(other) > 2000
    assert one[:, 1].max() < other[:, 1].min()
    # Likely poses are drawn in full, within their outline; of unlikely ones there is a dashed one only.
    one, other = (in_panel(image, places(image, 0.75 * color), POSES_PANEL) for color in (left, right))
    assert len(one) > 300
    assert 50 < len(other) < 0.5 * len(one)
    assert one[:, 1].max() < other[:, 1].min()


def test_what_several_poses_are_warned_of_is_told_once(found: Detections) -> None:
    poses = tuple(replace(found.poses[0], warnings=("is symmetric",) if rank != 4 else ()) for rank in range(1, 8))
    assert warnings_once(replace(found, poses=poses)) == (["poses 1 to 3, 5 to 7: is symmetric"], [[]] * 7)


def test_what_is_on_no_pose_is_dotted(part: Part, view: Scene, found: Detections, tmp_path: Path) -> None:
    left = view.points[(view.points[:, 1] > 0.6) & (view.points[:, 0] < 0)]
    save_picture(tmp_path / "result.png", view, part, replace(found, unexplained=0.2, unexplained_points=left))
    dots = places(drawn(tmp_path / "result.png"), UNEXPLAINED)
    assert len(in_panel(drawn(tmp_path / "result.png"), dots, POSES_PANEL)) == len(dots) > 300


def test_keypoints_have_the_same_colours_on_the_scan_and_on_the_part(
    part: Part, view: Scene, found: Detections, tmp_path: Path
) -> None:
    save_picture(tmp_path / "result.png", view, part, found)
    image = drawn(tmp_path / "result.png")
    front = np.unique(found.poses[0].prediction.keypoint[found.poses[0].prediction.on_object])
    assert len(front) >= 2
    for index, color in enumerate(distinct_colors(part.num_keypoints)):
        shown = len(in_panel(image, places(image, color), KEYPOINTS))
        assert (shown > 50) == (index in front), f"keypoint {index}: {shown} pixels"


def test_truth_is_coded_where_it_must_be(part: Part, view: Scene, found: Detections, tmp_path: Path) -> None:
    faulty = replace(found, poses=(with_faults(found.poses[0]),))
    save_picture(tmp_path / "result.png", view, part, faulty, truth=POSES)
    image = drawn(tmp_path / "result.png")
    colors = list(TRUTH_COLORS.values())
    white, red, yellow, blue, green = (
        in_panel(image, places(image, colors[code]), CROPS)
        for code in (BACKGROUND, FALSE_PART, MISSED, WRONG_KEYPOINT, RIGHT)
    )
    for pixels in (white, red, yellow, blue, green):
        assert len(pixels) > 500
    low, high = np.percentile(yellow[:, 0], [20, 80])
    beside = red[(red[:, 0] > low) & (red[:, 0] < high)]
    assert beside[:, 1].max() <= yellow[:, 1].min() + 3
    assert white[:, 1].max() > green[:, 1].max()
    assert blue[:, 0].max() < green[:, 0].min()
    np.testing.assert_allclose([blue[:, 1].min(), blue[:, 1].max()], [green[:, 1].min(), green[:, 1].max()], atol=3)
    assert yellow[:, 1].max() < blue[:, 1].min()


def test_codes_of_a_turned_scene_and_of_copies_that_look_the_same(part: Part, view: Scene, found: Detections) -> None:
    T = pose((5.0, -2.0, 1.0), random_rotations(1, 3)[0])

    def moved(points: np.ndarray) -> np.ndarray:
        return points @ T[:3, :3].T + T[:3, 3]

    faulty = with_faults(found.poses[0])
    before = truth_codes(part, faulty, POSES)
    prediction = replace(faulty.prediction, points=moved(faulty.prediction.points).astype(np.float32))
    turned = replace(faulty, seed=moved(faulty.seed), prediction=prediction)
    np.testing.assert_array_equal(truth_codes(part, turned, [T @ pose for pose in POSES]), before)
    assert set(np.unique(before)) == {BACKGROUND, FALSE_PART, MISSED, WRONG_KEYPOINT, RIGHT}

    half_turn = np.diag([-1.0, -1.0, 1.0])
    true = [POSES[0] @ pose((0.0, 0.0, 0.0), half_turn), POSES[1]]
    right = (truth_codes(part, found.poses[0], true) == RIGHT).mean()
    symmetric = replace(
        part, symmetries=Symmetries(np.stack([np.eye(3), half_turn]), np.zeros((0, 3)), np.zeros(3), 0.02)
    )
    assert right < 0.1
    assert (truth_codes(symmetric, found.poses[0], true) == RIGHT).sum() == found.poses[0].prediction.on_object.sum()


def test_a_crop_that_is_on_no_copy_is_background(part: Part, found: Detections) -> None:
    codes = truth_codes(part, found.poses[0], POSES[1:])
    np.testing.assert_array_equal(codes, np.where(found.poses[0].prediction.on_object, FALSE_PART, BACKGROUND))
    np.testing.assert_array_equal(truth_codes(part, found.poses[0], ()), codes)


def test_no_pose_makes_a_picture_too(part: Part, view: Scene, found: Detections, tmp_path: Path) -> None:
    empty = replace(found, poses=(), reason="nothing in the scan looks like the $part")
    save_picture(tmp_path / "empty.png", view, part, empty)
    save_picture(tmp_path / "other.png", view, part, replace(empty, reason="the scan has too few points"))
    save_picture(tmp_path / "coded.png", view, part, empty, truth=POSES)
    image, other = drawn(tmp_path / "empty.png"), drawn(tmp_path / "other.png")
    differ = (image != other).any(axis=2)
    assert differ.any()  # the reason is in the picture, and nothing else differs
    height, width = differ.shape
    assert not differ[int(0.1 * height) : int(0.2 * height), : int(0.3 * width)].any()
    assert drawn(tmp_path / "coded.png").shape[1] == width


def test_poses_may_be_outside_of_the_image_and_crops_empty(
    part: Part, view: Scene, found: Detections, tmp_path: Path
) -> None:
    nothing = CropPrediction(np.zeros((0, 3), np.float32), np.zeros(0, bool), np.zeros(0, int))
    outside = [
        replace(found.poses[0], T_scene_object=pose(place), prediction=nothing)
        for place in ((0.0, 0.0, -3.0), (90.0, 0.0, 3.0), (0.0, 0.0, 0.0))
    ]
    one = CropPrediction(*(array[:1] for array in vars(found.poses[0].prediction).values()))
    outside.append(replace(outside[0], prediction=one))
    for poses, truth in ((outside[:3], None), (outside, POSES)):
        save_picture(tmp_path / "outside.png", view, part, replace(found, poses=tuple(poses)), truth)
        assert drawn(tmp_path / "outside.png").std() > 10


def test_many_poses_take_little_time(part: Part, view: Scene, found: Detections, tmp_path: Path) -> None:
    many = replace(found, poses=found.poses * 10, warnings=("the scan has holes",))
    start = time.process_time()
    save_picture(tmp_path / "one.png", view, part, many)
    assert time.process_time() - start < 6  # about 1.5 on an idle machine
    assert drawn(tmp_path / "one.png").std() > 10


def test_notes_are_shown_whole_as_many_as_fit() -> None:
    notes = ["one line", "two\nlines", "three\nlines\nall"]
    assert fitting(notes, 30.0) == notes
    assert fitting([], 0.0) == []
    assert fitting(notes, 5.0) == [*notes[:2], "and 1 more note"]
    assert fitting(notes, 3.0) == [notes[0], "and 2 more notes"]


def test_the_list_of_poses_keeps_its_notes_inside(part: Part, view: Scene, found: Detections, tmp_path: Path) -> None:
    long = tuple(f"note {row} of the scan: " + "what is wrong with it takes many words to say " * 5 for row in range(9))
    for poses, warnings in ((found.poses[:1], long[:1]), (found.poses * 8, long)):
        save_picture(tmp_path / "notes.png", view, part, replace(found, poses=poses, warnings=warnings))
        rows, columns = np.nonzero((np.abs(drawn(tmp_path / "notes.png").astype(int) - (160, 64, 0)) < 8).all(axis=2))
        height, width = drawn(tmp_path / "notes.png").shape[:2]
        assert len(rows) > 100
        assert rows.max() < 0.99 * height
        assert columns.max() < 0.995 * width


def test_what_cannot_be_written_is_refused(part: Part, view: Scene, found: Detections, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="pictures are PNG files"):
        save_picture(tmp_path / "result.jpg", view, part, found)
    with pytest.raises(InputError, match="cannot write"):
        save_picture(tmp_path / "missing" / "result.png", view, part, found)
    assert list(tmp_path.iterdir()) == []


def test_without_matplotlib_a_command_that_installs_it_is_named(
    part: Part, view: Scene, found: Detections, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(InputError, match=r"need packages that are not installed: pip install (?!.*viser).*matplotlib"):
        save_picture(tmp_path / "result.png", view, part, found)


def test_distances_from_the_surface_are_those_of_the_box(part: Part) -> None:
    rng = np.random.default_rng(0)
    on = part.points[rng.integers(0, len(part.points), 500)].astype(np.float64)
    inner = on * (1 - rng.uniform(0, 0.1, (500, 1)))
    outer = on * (1 + rng.uniform(0, 0.4, (500, 1)))
    points = np.concatenate([inner, outer, rng.uniform(-0.6, 0.6, (500, 3))])
    beyond = np.abs(points) - np.array(SIZES) / 2
    exact = np.where((beyond < 0).all(axis=1), -beyond.max(axis=1), np.linalg.norm(np.maximum(beyond, 0), axis=1))
    found = surface_distances(part, points)
    near = exact < 0.05 * part.diameter  # further away it need only be far
    np.testing.assert_allclose(found[near], exact[near], atol=0.01 * part.diameter)
    assert found[~near].min() > 0.04 * part.diameter


def test_units_of_part_and_scene_may_differ(part: Part, view: Scene, found: Detections, tmp_path: Path) -> None:
    save_picture(tmp_path / "one.png", view, part, found, truth=POSES)
    save_picture(tmp_path / "other.png", view, part.in_unit("mm"), found, truth=POSES)
    one, other = drawn(tmp_path / "one.png"), drawn(tmp_path / "other.png")
    assert (one != other).any(axis=2).mean() < 1e-3  # but for rounding


def test_hexagons_are_seen_where_rays_meet_them() -> None:
    canvas = Canvas(CAMERA, -0.5, -0.5, 4.0, 4 * CAMERA.width, 4 * CAMERA.height)
    tilted = np.array([0.0, -0.6, -0.8])
    normals = np.stack([tilted, [0.0, 0.0, -1.0], [0.0, 0.0, 1.0]])  # the last one faces away
    centers, radii = np.array([[0.0, 0.0, 2.0], [0.1, 0.0, 3.0], [0.0, 0.0, 1.0]]), np.array([0.2, 0.7, 0.7])
    turns = np.radians(np.arange(0, 360, 60))[:, None]
    across = np.cross(normals, [1.0, 0.0, 0.0])[:, None]
    rims = np.cos(turns) * [1.0, 0.0, 0.0] + np.sin(turns) * across
    index = canvas.seen(normals, centers[:, None] + radii[:, None, None] * rims)
    rows, columns = np.nonzero(index == 0)
    x, y = (columns + 0.5) / 4 - 0.5 - CAMERA.cx, (rows + 0.5) / 4 - 0.5 - CAMERA.cy
    rays = np.stack([x / CAMERA.fx, y / CAMERA.fy, np.ones(len(rows))], axis=1)
    points = rays * (centers[0] @ tilted / (rays @ tilted))[:, None]
    assert np.linalg.norm(points - centers[0], axis=1).max() < 0.2 + 2 * 2 / (4 * CAMERA.fx)  # but for two pixels
    area = 1.5 * np.sqrt(3) * np.array([0.2, 0.7]) ** 2 * (4 * CAMERA.fx / np.array([2, 3])) ** 2
    np.testing.assert_allclose(len(rows), 0.8 * area[0], rtol=0.05)
    np.testing.assert_allclose((index >= 0).sum(), area[1], rtol=0.05)
    assert set(np.unique(index)) == {-1, 0, 1}


def test_colours_are_distinct_and_do_not_depend_on_their_number() -> None:
    colors = distinct_colors(40)
    np.testing.assert_array_equal(distinct_colors(7), colors[:7])
    apart = np.linalg.norm(colors[:, None] - colors, axis=2) + np.eye(40)
    assert apart.min() > 0.1
    assert np.ptp(colors, axis=1).min() > 0.15  # none is grey


def test_nothing_that_draws_is_imported_before_it_is_needed() -> None:
    program = (
        "import sys, kmn_jax.viz._picture, kmn_jax.viz._viewer;"
        "print([name for name in ('matplotlib', 'viser', 'scipy.spatial', 'PIL') if name in sys.modules])"
    )
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert (result.returncode, result.stdout.strip()) == (0, "[]"), result.stderr
