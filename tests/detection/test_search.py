"""Seeds, and the search as a function of scene, seeds and random seed: spread, determinism; nothing is ever NaN."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kmn_jax.detection import (
    EVIDENCE,
    PICTURE_EVIDENCE,
    Candidates,
    CropPoses,
    CropSearchConfig,
    DetectConfig,
    DevicePart,
    Scene,
    SearchConfig,
    config_of,
    gather_evidence,
    make_scene,
    picture_evidence,
    search_at,
    spread_seeds,
)
from kmn_jax.detection._search import _columns_of, no_poses
from kmn_jax.errors import InputError
from kmn_jax.geometry import PaddedCloud, spread_rows
from kmn_jax.io import Scan
from kmn_jax.models import Model, create_model, encode_object
from kmn_jax.objects import PartArrays
from kmn_jax.pose import RansacConfig
from kmn_jax.simulate import Surfels
from tests.reference.clouds import box_cloud
from tests.reference.networks import TINY

NETWORK = replace(TINY, num_keypoints=6)
CROPS = CropSearchConfig(
    num_points=64, num_draws=2, crop_points=256, ransac=RansacConfig(num_hypotheses=50, num_candidates=200)
)
CONFIG = SearchConfig(CROPS)
seeds_of = jax.jit(spread_seeds, static_argnums=2)
_NO_SHARES = {"log_inliers", "straight", "surface", "log_cells", "log_area", "offset", "relief_alike", "log_pixel"}
_NO_SHARES |= {"relief_odds", "relief_slope", "relief_slope_error"}


@pytest.fixture(scope="module")
def model() -> Model:
    return create_model(NETWORK, jax.random.key(0))


@pytest.fixture(scope="module")
def part(model: Model) -> DevicePart:
    cloud = box_cloud(0, 128).astype(np.float32)
    features = encode_object(model, cloud[:64], np.arange(6), np.float32(2)).features
    points, normals = jnp.asarray(cloud[:64, :3]), jnp.asarray(cloud[:64, 3:])
    arrays = PartArrays(points, normals, features, jnp.float32(2))
    return DevicePart(
        arrays,
        Surfels(points, normals, jnp.float32(10)),
        jnp.eye(4)[None],
        jnp.float32(0.2),
        jnp.eye(4)[None],
        jnp.zeros(1, bool),
    )


@pytest.fixture(scope="module")
def scene() -> Scene:
    rng = np.random.default_rng(0)
    points = (rng.uniform(-2, 2, (700, 3)) * [1, 1, 0.2] + [0, 0, 6]).astype(np.float32)
    return scene_of(points)


def scene_of(points: np.ndarray) -> Scene:
    return make_scene(Scan(points, None, None, None, "m"), 2.0, inside=np.ones(len(points), dtype=bool))


def run(model: Model, part: DevicePart, scene: Scene, rows: list[int], random_seed: int = 0) -> Candidates:
    return search_at(model, part, scene, np.array(rows), random_seed, CONFIG)


def test_seeds_are_candidates_far_from_each_other(scene: Scene) -> None:
    cloud = scene.cloud
    where, mask = np.asarray(cloud.points), np.asarray(cloud.mask)
    candidates = where[:, 0] > 0
    seeds, real = jax.device_get(seeds_of(cloud, candidates, 12))
    assert real.all()
    assert candidates[seeds].all()
    assert mask[seeds].all()
    points = where[seeds]
    apart = np.linalg.norm(points[:, None] - points[None], axis=2)[~np.eye(12, dtype=bool)]
    chosen = where[candidates & mask]
    holes = np.linalg.norm(chosen[:, None] - points[None], axis=2).min(axis=1).max()
    assert apart.min() >= 0.9 * holes


def test_few_candidates_come_again_and_are_told(scene: Scene) -> None:
    capacity = len(scene.cloud.mask)
    candidates = np.isin(np.arange(capacity), [3, 500])
    seeds, real = jax.device_get(seeds_of(scene.cloud, candidates, 12))
    assert set(seeds.tolist()) == {3, 500}
    assert set(seeds[real].tolist()) == {3, 500}
    assert real.sum() == 2
    assert not np.asarray(seeds_of(scene.cloud, np.zeros(capacity, dtype=bool), 12)[1]).any()


def test_candidates_are_finite_and_those_of_their_seed(model: Model, part: DevicePart, scene: Scene) -> None:
    found, again = (run(model, part, scene, [0, 10, 200]) for _ in range(2))
    jax.tree.map(np.testing.assert_array_equal, found, again)
    alone = run(model, part, scene, [10])
    own = found.crop == 1
    np.testing.assert_array_equal(found.T_camera_object[own], alone.T_camera_object)
    np.testing.assert_array_equal(found.evidence[own], alone.evidence)
    assert len(found.usable) == 3 * CROPS.num_poses
    for leaf in (found.T_camera_object, found.evidence, *found.found.prediction):
        assert np.isfinite(leaf).all()
    np.testing.assert_allclose(np.linalg.det(found.T_camera_object[:, :3, :3]), 1, atol=1e-4)
    np.testing.assert_array_equal(
        found.T_camera_object[~found.usable], np.eye(4)[None].repeat((~found.usable).sum(), 0)
    )
    evidence = dict(zip(EVIDENCE, found.evidence.T, strict=True))
    total = sum(evidence[name] for name in ("explained", "violated", "occluded", "unknown"))
    assert ((np.abs(total - 1) < 1e-3) | (total == 0)).all()  # nothing of a pose behind the sensor is visible
    for name in set(EVIDENCE) - _NO_SHARES:
        assert (evidence[name] >= 0).all(), name
        assert (evidence[name] <= 1.001).all(), name
    assert (np.abs(evidence["surface"]) <= 3).all()
    scores = np.where(np.isfinite(found.found.scores), found.found.scores, -9)
    assert (np.diff(scores, axis=1) <= 0).all(), "the best pose of a crop comes first"


def test_no_poses_are_compiled_for_as_some_are(model: Model, part: DevicePart, scene: Scene) -> None:
    def kinds(poses: CropPoses) -> list[tuple[tuple[int, ...], np.dtype]]:
        return [(leaf.shape, leaf.dtype) for leaf in jax.tree.leaves(poses)]

    found = run(model, part, scene, [0]).found
    none = no_poses(CROPS, NETWORK.num_keypoints)
    assert kinds(none) == kinds(jax.tree.map(lambda leaf: leaf[0], found))
    assert jax.tree.structure(none) == jax.tree.structure(found)
    given = part.arrays, part.surfels, scene.image, CONFIG.agreement
    np.testing.assert_array_equal(gather_evidence(none, *given), 0)


def test_a_seed_among_nothing_gives_no_pose(model: Model, part: DevicePart) -> None:
    lonely = np.random.default_rng(0).uniform([-1, -1, 59], [1, 1, 61], (51, 3))
    lonely[0] = [50, 0, 60]
    found = run(model, part, scene_of(lonely.astype(np.float32)), [0])
    assert not found.usable.any()
    assert np.isfinite(found.T_camera_object).all()
    np.testing.assert_array_equal(found.evidence, np.zeros_like(found.evidence))


def test_padding_changes_nothing(model: Model, part: DevicePart, scene: Scene) -> None:
    cloud = scene.cloud
    points = np.where(np.asarray(cloud.mask)[:, None], cloud.points, np.float32(6))
    rubbish = PaddedCloud(jnp.asarray(points), cloud.mask)
    one, other = (run(model, part, replace(scene, cloud=points), [5, 9]) for points in (cloud, rubbish))
    jax.tree.map(np.testing.assert_array_equal, one, other)


@pytest.mark.parametrize(("total", "count"), [(5, 8), (700, 512), (307_200, 32_768), (1_900_000, 40_000)])
def test_rows_are_spread_over_large_masks_too(total: int, count: int) -> None:
    """Products of places and totals are beyond 32 bits."""
    mask = np.ones(total + 7, dtype=bool)
    mask[3:10] = False
    rows, real = jax.device_get(jax.jit(spread_rows, static_argnums=1)(mask, count))
    order = np.flatnonzero(mask)
    assert real.sum() == min(total, count)
    places = np.arange(count, dtype=np.int64) * total // count if total > count else np.arange(total)
    np.testing.assert_array_equal(rows[real], order[places])


def test_the_picture_shows_the_same_of_poses_that_were_kept(part: DevicePart, scene: Scene) -> None:
    poses = np.tile(np.eye(4, dtype=np.float32), (3, 1, 1))
    poses[:, 2, 3] = [13, 14, 30]  # the box begins 7.5 nearer, what was measured lies at 6
    seen = picture_evidence(poses, part, scene, CONFIG.agreement)
    none = no_poses(CROPS, NETWORK.num_keypoints)
    there, columns = np.ones(CROPS.num_poses, dtype=bool), [EVIDENCE.index(name) for name in PICTURE_EVIDENCE]
    for pose, row in zip(poses, seen, strict=True):
        found = none._replace(
            poses=none.poses._replace(T_scene_object=np.tile(pose, (len(there), 1, 1)), converged=there)
        )
        wanted = np.asarray(gather_evidence(found, part.arrays, part.surfels, scene.image, CONFIG.agreement))[0]
        np.testing.assert_allclose(row, wanted[columns], atol=1e-5)
    assert np.ptp(seen, axis=0).max() > 0.1
    assert picture_evidence(poses[:0], part, scene, CONFIG.agreement).shape == (0, len(columns))
    np.testing.assert_allclose(_columns_of(poses, part.surfels, scene.image, 2.0, CONFIG.agreement), seen, atol=1e-5)


@pytest.mark.parametrize(("trained", "many"), [(512, 1024), (2048, 2048)])
def test_all_over_a_scene_draws_are_fewer_and_of_as_many_points_as_the_network_was_trained_with(
    trained: int, many: int
) -> None:
    network = replace(NETWORK, num_scene_points=trained)
    efforts = (
        ("fast", (1, trained), (1, many)),
        ("usual", (2, trained), (4, many)),
        ("thorough", (4, many), (4, many)),
    )
    for effort, everywhere, at_places in efforts:
        for given, wanted in ((False, everywhere), (True, at_places)):
            crops = config_of(effort).search_of(network, at_places=given).crops
            assert (crops.num_draws, crops.points_of_draw) == wanted
    given = DetectConfig(search=SearchConfig(crops=replace(CROPS, num_points=300)), many_points=True)
    assert {given.search_of(network, at_places=places).crops.points_of_draw for places in (False, True)} == {300}
    more = DetectConfig(search=SearchConfig(crops=CropSearchConfig(num_draws=7)))
    assert {more.search_of(network, at_places=places).crops.most_draws for places in (False, True)} == {7}
    with pytest.raises(InputError, match="num_draws is not given"):
        _ = CropSearchConfig().most_draws
