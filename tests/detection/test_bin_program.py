"""A bin in one call: the released network on a committed bin, no transfer on the way, and images of nothing."""

from __future__ import annotations

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import experiments
from kmn_jax.detection import (
    BinPoses,
    BinPosesConfig,
    CalibrationArrays,
    DepthImage,
    DevicePart,
    PoseEstimator,
    SearchConfig,
    bin_poses,
    device_calibration,
    device_part,
)
from kmn_jax.errors import InputError
from kmn_jax.objects import Part
from kmn_jax.pose import adi

ASSETS = Path(experiments.__file__).parent / "assets"
IMAGE = max((ASSETS / "small_test_set" / "test" / "000002" / "depth").glob("*.png"))
OnDevice = tuple[DevicePart, CalibrationArrays]
Seen = tuple[DepthImage, jax.Array, np.ndarray]
FLOOR_MARGIN = 3.0  # mm


@pytest.fixture(scope="module")
def estimator() -> PoseEstimator:
    return PoseEstimator.from_pretrained()


@pytest.fixture(scope="module")
def motor(estimator: PoseEstimator) -> Part:
    return estimator.prepare(ASSETS / "industrial" / "gear_motor.stl").in_unit("mm")


@pytest.fixture(scope="module")
def on_device(estimator: PoseEstimator, motor: Part) -> OnDevice:
    assert estimator.model.config.num_scene_points == 512
    return device_part(estimator.model, motor), device_calibration(estimator.probabilities.found)


@pytest.fixture(scope="module")
def seen(estimator: PoseEstimator, motor: Part) -> Seen:
    """The image, which of its pixels are above the floor, and the true poses."""
    scene = estimator.scene(IMAGE, motor)
    assert scene.truth is not None
    floor = np.median(scene.depth[scene.depth > 0])
    above = (scene.image.depth > 0) & (scene.image.depth < floor - FLOOR_MARGIN)
    return scene.image, above, np.array(scene.truth, dtype=np.float32)


def usual(estimator: PoseEstimator) -> BinPosesConfig:
    """Return what docs/detect.md calls the program with."""
    return BinPosesConfig(search=SearchConfig().of_network(estimator.model.config))


def solve(
    estimator: PoseEstimator,
    part: OnDevice,
    image: DepthImage,
    foreground: jax.Array,
    key: jax.Array | None = None,
) -> BinPoses:
    key = jax.random.key(0) if key is None else key
    return bin_poses(*estimator.model, *part, image, foreground, key, config=usual(estimator))


def test_copies_are_found_from_the_likeliest_on(
    estimator: PoseEstimator,
    on_device: OnDevice,
    motor: Part,
    seen: Seen,
) -> None:
    image, above, truth = seen
    found = jax.device_get(solve(estimator, on_device, image, above))
    likely = found.mask & (found.probability >= 0.5)
    points = motor.points[:500]
    errors = np.array([[float(adi(pose, one, points)) for one in truth] for pose in found.T_camera_object[likely]])
    right = errors.min(axis=1) < 0.1 * motor.diameter
    assert right.sum() >= 3
    assert right.mean() >= 0.7
    copies = errors[right].argmin(axis=1)
    assert len(set(copies.tolist())) == len(copies), "one pose for each copy"
    assert (np.diff(found.probability) <= 0).all()
    assert not found.mask[found.mask.sum() :].any(), "what there is comes first"
    np.testing.assert_array_equal(found.T_camera_object[~found.mask], np.eye(4)[None].repeat((~found.mask).sum(), 0))
    assert found.overflow == (np.count_nonzero(np.asarray(image.depth)) > usual(estimator).max_points)


def test_nothing_goes_through_the_host_and_bits_are_the_same(
    estimator: PoseEstimator,
    on_device: OnDevice,
    seen: Seen,
) -> None:
    image, above, _ = seen
    key = jax.random.key(1)
    first = solve(estimator, on_device, image, above, key)
    with jax.transfer_guard("disallow"):
        again = jax.block_until_ready(solve(estimator, on_device, image, above, key))
    jax.tree.map(np.testing.assert_array_equal, first, again)


@pytest.mark.parametrize("empty", ["depth", "foreground"])
def test_an_image_of_nothing_has_no_poses(
    estimator: PoseEstimator,
    on_device: OnDevice,
    seen: Seen,
    empty: str,
) -> None:
    image, above, _ = seen
    if empty == "depth":
        image = image._replace(depth=jnp.zeros_like(image.depth))
    else:
        above = jnp.zeros_like(above)
    found = solve(estimator, on_device, image, above)
    assert not found.mask.any()
    assert not found.probability.any()
    np.testing.assert_array_equal(found.T_camera_object, np.eye(4)[None].repeat(usual(estimator).num_seeds, 0))
    assert found.overflow == (
        empty != "depth" and np.count_nonzero(np.asarray(image.depth)) > usual(estimator).max_points
    )


@pytest.mark.parametrize("values", [{"num_seeds": 0}, {"num_seeds": 64, "max_points": 32}])
def test_settings_without_meaning_are_refused(values: dict[str, int]) -> None:
    with pytest.raises(InputError, match="num_seeds"):
        BinPosesConfig(**values)  # type: ignore[arg-type]
