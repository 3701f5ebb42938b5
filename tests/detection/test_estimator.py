"""The estimator as a program uses it: committed bins by the released model, single crops, several parts, bad input."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
import trimesh

from kmn_jax.bop import bop_scan
from kmn_jax.detection import (
    EVIDENCE,
    DetectConfig,
    Detections,
    ForegroundOptions,
    PoseEstimator,
    as_json,
    canonical_pose,
    device_part,
    export_estimator,
    search_at,
    seeds_over,
    symmetry_transforms,
    table,
)
from kmn_jax.detection._sources import object_of
from kmn_jax.errors import InputError
from kmn_jax.io import Scan, read_mesh
from kmn_jax.objects import ObjectConfig, Part, save_part
from kmn_jax.pose import adi, mssd
from kmn_jax.released import RELEASED
from tests.reference.meshes import Mesh, box, random_rotations
from tests.reference.meshes import pose as placed
from tests.reference.solids import revolution

ASSETS = Path(__file__).parent.parent.parent / "experiments" / "assets"
BINS = ASSETS / "small_test_set" / "test" / "000002" / "depth"
FULL, IMAGE = BINS / "000003.png", BINS / "000000.png"  # of 18 copies, and of three: soon searched
STEP = Path(__file__).parent.parent / "io" / "files" / "box.step"
MOTOR = ASSETS / "industrial" / "gear_motor.stl"
Bin = tuple[Scan, np.ndarray]  # and the poses of its parts


@pytest.fixture(scope="module")
def estimator() -> PoseEstimator:
    return PoseEstimator.from_pretrained()


@pytest.fixture(scope="module")
def motor(estimator: PoseEstimator) -> Part:
    return estimator.prepare(MOTOR)


def bin_of(image: Path) -> Bin:
    scan, instances = bop_scan(image)
    assert instances is not None
    return scan, np.array([one.T_camera_object for one in instances], dtype=np.float32)


@pytest.fixture(scope="module")
def seen() -> Bin:
    return bin_of(IMAGE)


@pytest.fixture(scope="module")
def whole(estimator: PoseEstimator, motor: Part) -> tuple[Bin, Detections]:
    """The full bin, and what is found in it."""
    full = bin_of(FULL)
    return full, estimator.detect(motor, full[0])


def errors(pose: np.ndarray, truth: np.ndarray, part: Part) -> np.ndarray:
    points = part.points[:500]
    return np.array([float(adi(pose.astype(np.float32), one, points)) for one in truth]) / part.diameter


def test_a_bin_is_found_and_the_same_inputs_give_the_same_bits(
    estimator: PoseEstimator, motor: Part, whole: tuple[Bin, Detections]
) -> None:
    (scan, truth), found = whole
    assert len(found.poses) > 1
    likely = [pose for pose in found.poses if pose.probability >= 0.5]
    right = [errors(pose.T_scene_object, truth, motor).min() < 0.1 for pose in likely]
    print(f"copies {len(truth)}, found {len(likely)}, right {sum(right)}, {found.timing}")
    assert len(likely) >= 3
    assert np.mean(right) >= 0.9
    nearest = [int(errors(pose.T_scene_object, truth, motor).argmin()) for pose in likely]
    assert len(set(nearest)) == len(nearest), "a copy is found once"
    order = [pose.probability * pose.visible_fraction for pose in found.poses]
    assert order == sorted(order, reverse=True)
    for pose in found.poses:
        assert sum((pose.explained, pose.violated, pose.occluded, pose.unknown)) == pytest.approx(1, abs=1e-3)
        np.testing.assert_allclose(pose.T_scene_object[:3, :3] @ pose.T_scene_object[:3, :3].T, np.eye(3), atol=1e-12)
        assert len(pose.prediction.points) == len(pose.prediction.on_object) == len(pose.prediction.keypoint)
    again = estimator.detect(motor, scan, top=len(found.poses) - 1)
    for one, other in zip(found.poses[:-1], again.poses, strict=True):
        np.testing.assert_array_equal(one.T_scene_object, other.T_scene_object)
        assert one.probability == other.probability
    assert "found" in table(found, 0.5)
    written = as_json(found, "motor.stl", "bin.png", {"seed": 0})
    assert written["version"] == 1
    assert written["unexplained"] == found.unexplained
    assert found.unexplained is not None
    assert 0 < found.unexplained < 0.9
    assert len(written["poses"]) == len(found.poses)
    assert written["timing"]["total_s"] == pytest.approx(found.timing.total)


def test_units_frames_and_sensors_do_not_matter(estimator: PoseEstimator, motor: Part, seen: Bin) -> None:
    scan, truth = seen
    in_metres = estimator.detect(motor, scan.in_unit("m"))
    assert in_metres.unit == "m"
    best = max(in_metres.poses, key=lambda pose: pose.probability)
    shown = best.T_scene_object.copy()
    shown[:3, 3] *= 1000
    assert errors(shown, truth, motor).min() < 0.1
    # The same points in a frame whose origin is not the sensor.
    T_world_camera = np.array([[0, -1, 0, 300.0], [-1, 0, 0, 50.0], [0, 0, -1, 900.0], [0, 0, 0, 1]])
    points = (scan.points @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]).astype(np.float32)
    found = estimator.detect(motor, points, unit="mm", sensor=T_world_camera[:3, 3])
    best = max(found.poses, key=lambda pose: pose.probability)
    assert errors(np.linalg.inv(T_world_camera) @ best.T_scene_object, truth, motor).min() < 0.1


def test_places_and_crops_give_the_pose_there(
    estimator: PoseEstimator, motor: Part, whole: tuple[Bin, Detections]
) -> None:
    (scan, truth), found = whole
    seed = max(found.poses, key=lambda pose: pose.probability).seed
    other = scan.points[np.linalg.norm(scan.points - seed, axis=1).argmax()]
    scene = estimator.scene(scan, motor, at=np.stack([seed, other]))
    there = estimator.detect(motor, scene, at=seed, top=1, T_base_camera=placed((0.3, 0, 1.2), np.eye(3)))  # metres
    assert any("1.24 mm from the robot's base: is T_base_camera in metres?" in text for text in there.warnings)
    assert errors(there.poses[0].T_scene_object, truth, motor).min() < 0.1
    both = estimator.detect(motor, scene, at=np.stack([seed, other]))
    assert (len(both.poses) <= 2, both.unexplained) == (True, None)
    poses = np.stack([pose.T_scene_object for pose in both.poses])
    assert (poses == there.poses[0].T_scene_object).all(axis=(1, 2)).any(), "whatever else is asked for"


def test_several_parts_share_a_scene(estimator: PoseEstimator, motor: Part, seen: Bin) -> None:
    scan, _ = seen
    scene = estimator.scene(scan, motor)
    twin = replace(motor, name="twin")
    first, second = estimator.detect([motor, twin], scene)
    assert (first.part, second.part) == ("gear_motor", "twin")
    assert first.poses
    assert second.poses == (), "of equally probable poses in one place, that of the first part stays"
    assert second.reason is not None
    assert "other parts are there" in second.reason
    assert estimator.detect([], scene) == ()


def test_a_driver_s_array_and_the_robot_s_frame(estimator: PoseEstimator, motor: Part, seen: Bin) -> None:
    scan, truth = seen
    assert scan.depth is not None
    assert scan.camera is not None
    top = truth[truth[:, 2, 3].argmin(), :3, 3]
    seed = scan.points[np.linalg.norm(scan.points - top, axis=1).argmin()]
    known = {"at": seed / 1000, "T_base_camera": placed((0.3, 0, 1.2), random_rotations(1, 4)[0])}
    given = estimator.detect(motor, (scan.depth / 1000).astype(np.float32), K=scan.camera.matrix, **known)
    assert given.unit == "m"
    assert given.best is not None
    assert given.best.T_base_object is not None
    shown = given.best.T_scene_object.copy()
    shown[:3, 3] *= 1000
    assert errors(shown, truth, motor).min() < 0.1
    np.testing.assert_allclose(given.best.T_base_object, known["T_base_camera"] @ given.best.T_scene_object)
    # The points in another frame, whose camera is given by its pose.
    frame = placed((0.5, -0.1, 2.0), random_rotations(1, 7)[0])
    points = (scan.points / 1000 @ frame[:3, :3].T + frame[:3, 3]).astype(np.float32)
    place = frame[:3, :3] @ seed / 1000 + frame[:3, 3]
    turned = estimator.detect(motor, points, unit="m", T_scene_camera=frame, **(known | {"at": place}))
    assert turned.best is not None
    assert turned.best.T_base_object is not None
    shown = np.linalg.inv(known["T_base_camera"]) @ turned.best.T_base_object
    shown[:3, 3] *= 1000
    assert errors(shown, truth, motor).min() < 0.1
    values = turned.to_dict()
    assert values["scene"] is None
    assert (values["seed"], values["weights"], values["model"]) == (0, RELEASED, motor.model_digest)
    facts = {"seed": 0, "weights": RELEASED, "model": motor.model_digest}
    assert list(as_json(turned, "motor.stl", "scan.ply", facts)) == list(values)


def test_candidates_have_evidence_and_some_are_right(estimator: PoseEstimator, motor: Part, seen: Bin) -> None:
    scan, truth = seen
    scene = estimator.scene(scan, motor)
    config = DetectConfig().search_of(estimator.model.config)  # what whole bins are searched with is compiled
    rows = seeds_over(scene, scene.foreground, motor)[:16]
    found = search_at(estimator.model, device_part(estimator.model, motor), scene, rows, 0, config)
    assert found.evidence.shape == (16 * config.crops.num_poses, len(EVIDENCE))
    assert np.isfinite(found.evidence).all()
    assert found.is_first.sum() == 16
    first = found.usable & found.is_first
    right = [errors(pose, truth, motor).min() < 0.1 for pose in found.T_camera_object[first]]
    assert np.mean(right) > 0.5


@pytest.mark.parametrize("mesh", [box(40, 20, 10), revolution([(0, 0), (8, 0), (8, 30), (0, 30)])])
def test_a_symmetric_part_has_one_canonical_pose(estimator: PoseEstimator, mesh: Mesh) -> None:
    part = estimator.prepare(mesh)
    assert part.is_symmetric
    base = placed((10, 20, 500), random_rotations(1, 3)[0])
    chosen = canonical_pose(base, part.symmetries)
    transforms = symmetry_transforms(part.symmetries).astype(float)
    for transform in transforms[:: max(1, len(transforms) // 6)]:
        np.testing.assert_allclose(canonical_pose(base @ transform, part.symmetries), chosen, atol=1e-3)
    off = float(mssd(chosen.astype("f4"), base.astype("f4"), part.points[:300], transforms.astype("f4")))
    assert off < 0.06 * part.diameter
    assert np.linalg.det(chosen[:3, :3]) == pytest.approx(1)
    assert np.trace(chosen[:3, :3]) >= np.trace(base[:3, :3]) - 1e-9


def test_what_cannot_be_is_one_sentence(estimator: PoseEstimator, motor: Part, seen: Bin, tmp_path: Path) -> None:
    scan, _ = seen
    with pytest.raises(InputError, match=r'probably millimetres: say unit="mm"$'):
        estimator.detect(motor, scan.points, unit="m")
    with pytest.raises(InputError, match="region of interest"):
        estimator.detect(motor, scan, background=ForegroundOptions(roi=(1e6, 1e6, 1e6, 2e6, 2e6, 2e6)))
    with pytest.raises(InputError, match="prepared with other weights"):
        estimator.detect(replace(motor, model_digest="0"), scan)
    with pytest.raises(InputError, match="none of the scan's 5 points was measured"):
        estimator.detect(motor, np.full((5, 3), np.nan, np.float32))
    with pytest.raises(InputError, match="cannot be made of a dict"):
        estimator.prepare({})
    with pytest.raises(InputError, match="must be \\(n, 3\\)"):
        estimator.prepare(np.zeros((5, 2)))
    with pytest.raises(InputError, match="random_seed is -1, but must be a whole number between 0"):
        estimator.detect(motor, scan, random_seed=-1)
    with pytest.raises(InputError, match="top is 0, but must be a whole number of 1 or more"):
        estimator.detect(motor, scan, top=0)
    with pytest.raises(InputError, match=r"place 2 to search at is .* mm away from the nearest measured point"):
        estimator.detect(motor, scan, at=np.stack([scan.points[0], [9000.0, 0, 0]]))
    with pytest.raises(InputError, match="leave the sensor's place out"):
        estimator.detect(motor, scan, sensor=np.zeros(3))
    with pytest.raises(InputError, match="were settled when the scene was made"):
        estimator.detect(motor, estimator.scene(scan, motor), unit="mm")
    with pytest.raises(InputError, match="no object is given"):
        estimator.scene(scan, [])
    save_part(replace(motor, features=motor.features[:4]), tmp_path / "few.kmn")
    with pytest.raises(InputError, match=r"few\.kmn has 4 keypoints, not 64"):
        estimator.prepare(tmp_path / "few.kmn")
    save_part(motor, tmp_path / "motor.kmn")
    assert estimator.prepare(tmp_path / "motor.kmn", "mm").unit == "mm"
    in_metres = estimator.prepare(tmp_path / "motor.kmn", "m")  # a card states its unit: it is converted
    assert in_metres.unit == "m"
    assert in_metres.diameter == pytest.approx(motor.diameter / 1000)
    with pytest.raises(InputError, match="there is no released model"):
        PoseEstimator.from_pretrained("none")


def test_cad_files_that_state_their_unit_keep_it_and_are_converted(tmp_path: Path) -> None:
    config = ObjectConfig(num_points=256)
    (tmp_path / "box.glb").write_bytes(trimesh.creation.box((0.04, 0.02, 0.01)).export(file_type="glb"))
    for source, unit, found in (
        (STEP, None, "mm"),
        (tmp_path / "box.glb", None, "m"),
        (tmp_path / "box.glb", "mm", "mm"),
    ):
        model = object_of(source, unit, None, config)
        assert model.unit == found
        size = 40.0 if source is not STEP else 20.0
        assert model.extents.max() == pytest.approx(size / (1000 if found == "m" else 1), rel=1e-5)


def test_a_scan_without_the_part_is_an_empty_or_doubtful_result(estimator: PoseEstimator, motor: Part) -> None:
    rng = np.random.default_rng(0)
    wavy = rng.uniform(-150, 150, (30_000, 3))
    wavy[:, 2] = 600 + 15 * np.sin(wavy[:, 0] / 40) * np.cos(wavy[:, 1] / 30)
    found = estimator.detect(motor, wavy.astype(np.float32), unit="mm")
    assert all(pose.probability < 0.5 for pose in found.poses)
    assert (found.reason is None) == bool(found.poses)
    assert found.unexplained == 1
    assert any("--background" in warning for warning in found.warnings)
    few = estimator.detect(
        motor, wavy[:30].astype(np.float32), unit="mm", background=ForegroundOptions(remove_plane="never")
    )
    assert not any(pose.probability >= 0.5 for pose in few.poses)
    assert few.poses or few.reason == "only 30 points of the scan may show gear_motor, too few to tell"
    scene = replace(estimator.scene(wavy.astype(np.float32), motor, unit="mm"), doubt="say --units cm")
    strict = replace(estimator, config=DetectConfig(reported=0.99, accepted=0.99))
    reason = strict.detect(motor, scene, at=wavy[:2]).reason
    assert reason is not None
    assert reason.endswith("; say --units cm")


def test_an_object_whose_unit_was_assumed_is_doubted_where_nothing_is_found(
    estimator: PoseEstimator, seen: Bin, tmp_path: Path
) -> None:
    mesh, (scan, _) = read_mesh(MOTOR), seen
    inches = (mesh.vertices / 25.4, mesh.triangles)
    assumed, stated = estimator.prepare(inches, name="motor"), estimator.prepare(inches, "mm", "motor")
    assert (assumed.is_unit_assumed, stated.is_unit_assumed) == (True, False)
    assert not estimator.prepare(STEP).is_unit_assumed
    save_part(assumed, tmp_path / "motor.kmn")
    strict = replace(estimator, config=DetectConfig(reported=0.99, accepted=0.99))
    doubt = (
        "; the object's unit was taken to be mm, so that its diameter is 3.17 mm: if its numbers are inches or"
        " centimetres, say --object-units in or cm (in Python unit=, for a card kmn prepare --units)"
    )
    place = scan.points[:1]
    for part in (assumed, estimator.prepare(tmp_path / "motor.kmn", "m"), stated):
        assert str(strict.detect(part, scan, at=place).reason).endswith(doubt) == part.is_unit_assumed
    follows = strict.detect(assumed, scan.points, at=place)  # points state no unit
    assert str(follows.reason).endswith(f"{doubt}, and --units mm for the scan")


def test_the_doubt_about_an_object_is_a_note_if_all_poses_are_doubtful(
    estimator: PoseEstimator, motor: Part, seen: Bin
) -> None:
    scan, truth = seen
    place = scan.points[np.linalg.norm(scan.points - truth[0][:3, 3], axis=1).argmin()][None]
    scene = estimator.scene(scan, motor)
    assert motor.is_unit_assumed
    assert scene.size is not None
    usual_for_inches = replace(scene.size, extent=150 * motor.diameter, distance=200 * motor.diameter)
    for accepted, noted in ((1.0, True), (0.1, False)):
        config = DetectConfig(reported=0.0, accepted=accepted)
        found = replace(estimator, config=config).detect(motor, replace(scene, size=usual_for_inches), at=place)
        assert len(found.poses) == 1
        assert any("unit was taken to be mm" in warning for warning in found.warnings) == noted


def test_parts_and_scans_may_lie_far_from_the_origin(estimator: PoseEstimator, motor: Part, seen: Bin) -> None:
    scan, truth = seen
    near = scan.points[np.linalg.norm(scan.points - truth[0][:3, 3], axis=1) < motor.diameter].astype(np.float64)
    mesh = read_mesh(MOTOR)
    offset = np.array([1e9, 0, -1e9])
    far = estimator.prepare((mesh.vertices + offset, mesh.triangles))
    assert far.points.dtype == np.float64
    whole = ForegroundOptions(remove_plane="never")
    pose = estimator.detect(far, near, unit="mm", background=whole).poses[0]
    shown = pose.T_scene_object.copy()
    shown[:3, 3] += shown[:3, :3] @ offset
    assert errors(shown, truth, motor).min() < 0.1
    # A scan of a map: seen from a place that is given in its frame, and so is all that comes back.
    place = np.array([5e5, 5.4e6, 300.0])
    points = near / 1000 + place
    roi = tuple(float(x) for x in (*points.min(axis=0), *points.max(axis=0)))
    given = ForegroundOptions(Scan(points + np.array([0, 0, 1]), None, None, None, "m"), roi)
    found = estimator.detect(motor, points, unit="m", sensor=place, background=given)
    best = found.poses[0].T_scene_object.copy()
    best[:3, 3] = (best[:3, 3] - place) * 1000
    assert errors(best, truth, motor).min() < 0.1
    assert np.linalg.norm(points - found.poses[0].seed, axis=1).min() < 1e-6
    assert np.abs(found.poses[0].prediction.points - place).max() < 2
    assert found.unexplained_points is not None
    assert np.abs(found.unexplained_points - place).max(initial=0) < 2
    there = estimator.detect(motor, points, unit="m", sensor=place, at=found.poses[0].seed)
    np.testing.assert_array_equal(there.poses[0].seed, found.poses[0].seed)
    with pytest.raises(InputError, match=r"from its sensor, .* say where"):
        estimator.detect(motor, points, unit="m")
    for wrong in ({"sensor": place * 1e300}, {"sensor": place, "at": place * 1e300}):
        with pytest.raises(InputError, match="beyond float32") as told:
            estimator.detect(motor, points, unit="m", **wrong)
        assert "\n" not in str(told.value)


def test_an_exported_estimator_finds_the_same_without_this_package(
    estimator: PoseEstimator, motor: Part, seen: Bin, tmp_path: Path
) -> None:
    import subprocess
    import sys

    scan, truth = seen
    scene = estimator.scene(scan, motor)
    path = tmp_path / "motor.jaxexport"
    size = export_estimator(estimator, motor, path, 8192)
    assert size == path.stat().st_size < 8e6
    points = np.zeros((8192, 3), dtype=np.float32)
    front = scene.points[scene.foreground]
    chosen = np.sort(np.random.default_rng(0).permutation(len(front))[:8192])
    points[: len(chosen)] = front[chosen]
    np.savez(tmp_path / "scan.npz", points=points, mask=np.arange(8192) < len(chosen))
    code = f"""
import sys
sys.modules["kmn_jax"] = None
import jax, numpy as np
program = jax.export.deserialize(bytearray(open({str(path)!r}, "rb").read()))
scan = np.load({str(tmp_path / "scan.npz")!r})
found = program.call(scan["points"], scan["mask"], np.zeros(2, np.uint32))
np.savez({str(tmp_path / "found.npz")!r}, **found)
assert not any(name.startswith("kmn_jax.") for name in sys.modules)
"""
    subprocess.run([sys.executable, "-c", code], check=True, cwd=tmp_path, timeout=200)
    with np.load(tmp_path / "found.npz") as found:
        best = int(found["probability"].argmax())
        assert found["keep"][best]
        assert errors(found["T_scene_object"][best], truth, motor).min() < 0.1
        assert np.isfinite(found["probability"]).all()
    with pytest.raises(InputError, match="points is 5"):
        export_estimator(estimator, motor, path, 5)
    assert jax.device_count() >= 1
