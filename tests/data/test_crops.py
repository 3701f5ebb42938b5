"""Crops against plain NumPy: which points, their labels, weights, noise and normals; padding and empty scenes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kmn_jax.data import CropConfig, LabelledCrop, draw_crop
from kmn_jax.simulate import BIN, VisiblePoints
from tests.reference.meshes import pose, random_rotations

COPIES, M, B = 4, 500, 300
DIAMETER = 2.0
# Few configs and shapes, since each is compiled anew.
EXACT = CropConfig(num_points=128, max_noise=0.0, normals="surface")
WITHOUT_BIN = CropConfig(num_points=128, max_noise=0.0, normals="surface", radius=0.7, include_bin=False)
CLEAN = CropConfig(num_points=128, max_noise=0.0)
NOISY = CropConfig(num_points=128, max_noise=0.02)
draw = jax.jit(draw_crop, static_argnames="config")
KEYPOINTS = np.random.default_rng(9).uniform(-1, 1, size=(12, 3)).astype(np.float32)
POSES = np.stack(
    [pose(tuple(np.array([i % 2, i // 2, 8.0]) * [1.5, 1.5, 1]), R) for i, R in enumerate(random_rotations(COPIES, 1))]
).astype(np.float32)


def scene(seed: int = 0, share: float = 0.6, **changes: Any) -> VisiblePoints:
    """Return points around four copies and on a plane behind them, of which a share is visible."""
    rng = np.random.default_rng(seed)
    points = np.concatenate([t[:3, 3] + rng.normal(size=(M, 3)) * 0.5 for t in POSES])
    points = np.concatenate([points, rng.uniform(-2, 4, size=(B, 3)) * [1, 1, 0] + [0, 0, 9]])
    normals = rng.normal(size=points.shape)
    normals /= -np.sign((normals * points).sum(axis=1, keepdims=True)) * np.linalg.norm(normals, axis=1, keepdims=True)
    fields = {
        "points": points.astype(np.float32),
        "normals": normals.astype(np.float32),
        "picture_area": rng.uniform(0.1, 1, size=len(points)).astype(np.float32) ** 2,
        "instance": np.concatenate([np.repeat(np.arange(COPIES), M), np.full(B, BIN)]).astype(np.int32),
        "mask": rng.random(len(points)) < share,
        "visible_fraction": np.full(COPIES, share, dtype=np.float32),
    } | changes
    return VisiblePoints(**fields)


def crop_of(seed: int, visible: VisiblePoints, config: CropConfig) -> LabelledCrop:
    return draw(jax.random.key(seed), visible, KEYPOINTS, POSES, np.float32(DIAMETER), config)


def plain(crop: LabelledCrop) -> dict[str, np.ndarray]:
    return {name: np.asarray(value) for name, value in crop._asdict().items()}


def all_finite(crop: LabelledCrop) -> bool:
    return all(np.isfinite(part).all() for part in crop)


def rows_of(crop: dict[str, np.ndarray], visible: VisiblePoints) -> np.ndarray:
    """Return which rows of the scene the points of a noiseless crop are."""
    points = crop["points"][crop["mask"]] + crop["seed"]
    distances = np.linalg.norm(points[:, None] - np.asarray(visible.points)[None], axis=2)
    assert distances.min(axis=1).max() < 1e-5
    return distances.argmin(axis=1)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("config", [EXACT, WITHOUT_BIN], ids=["with bin", "without"])
def test_a_crop_holds_distinct_visible_points_within_the_radius_with_their_labels(
    seed: int, config: CropConfig
) -> None:
    visible = scene(seed)
    crop = plain(crop_of(seed, visible, config))
    rows = rows_of(crop, visible)
    assert crop["valid"]
    assert len(np.unique(rows)) == len(rows) == 128
    points, instance, mask = (np.asarray(part) for part in (visible.points, visible.instance, visible.mask))
    inside = mask & (np.linalg.norm(points - crop["seed"], axis=1) <= config.radius * DIAMETER)
    if not config.include_bin:
        inside &= instance != BIN
    assert inside[rows].all()
    assert crop["num_inside"] == inside.sum()
    assert (instance[rows] == BIN).any() == config.include_bin

    np.testing.assert_array_equal(crop["points"][0], 0)
    assert crop["instance"] == instance[rows[0]] != BIN
    np.testing.assert_array_equal(crop["is_object"], instance[rows] == crop["instance"])
    assert 0 < crop["is_object"].sum() < 128
    keypoints = KEYPOINTS @ POSES[crop["instance"], :3, :3].T + POSES[crop["instance"], :3, 3]
    nearest = np.linalg.norm(points[rows][:, None] - keypoints[None], axis=2).argmin(axis=1)
    np.testing.assert_array_equal(crop["keypoint"][crop["is_object"]], nearest[crop["is_object"]])
    np.testing.assert_allclose(crop["normals"], np.asarray(visible.normals)[rows], atol=1e-6)
    expected = POSES[crop["instance"]].astype(np.float64)
    expected[:3, 3] -= points[rows[0]]
    np.testing.assert_allclose(crop["T_crop_object"], expected, atol=1e-6)
    assert crop["noise"] == 0


def test_seeds_are_drawn_in_proportion_to_the_picture_area() -> None:
    visible = scene(0)
    weights = np.where(visible.mask, visible.picture_area, 0)[: COPIES * M]
    config = CropConfig(num_points=1, max_noise=0.0, normals="surface", min_points=1)
    keys = jax.random.split(jax.random.key(0), 4000)
    one = jax.jit(lambda key: draw(key, visible, KEYPOINTS, POSES, jnp.float32(DIAMETER), config).seed)
    seeds = np.asarray(jax.lax.map(one, keys))
    rows = np.linalg.norm(seeds[:, None] - np.asarray(visible.points)[None, : COPIES * M], axis=2).argmin(axis=1)
    groups = np.arange(COPIES * M) // 100  # of 100 rows, about 200 draws each
    expected = np.bincount(groups, weights) / weights.sum()
    found = np.bincount(groups[rows], minlength=len(expected)) / len(keys)
    np.testing.assert_allclose(found, expected, atol=4 * np.sqrt(expected.max() / len(keys)))
    assert (weights[rows] > 0).all()
    # And within them: the mean weight of what is drawn in proportion to it.
    np.testing.assert_allclose(weights[rows].mean(), (weights**2).sum() / weights.sum(), rtol=0.03)


def test_points_are_drawn_in_proportion_to_the_picture_area() -> None:
    # One copy; 16 points at one place have weight 1, 16 have 3. The first one drawn after the seed shows the ratio.
    total = 33
    visible = VisiblePoints(
        points=(np.arange(total)[:, None] * 1e-3 + [0, 0, 5]).astype("f4"),
        normals=np.tile(np.float32([0, 0, -1]), (total, 1)),
        picture_area=np.float32([1e6] + [1.0] * 16 + [3.0] * 16),
        instance=np.zeros(total, dtype=np.int32),
        mask=np.ones(total, dtype=bool),
        visible_fraction=np.ones(1, dtype=np.float32),
    )
    config = CropConfig(num_points=2, max_noise=0.0, normals="surface", min_points=1)
    one = jax.jit(lambda key: draw(key, visible, KEYPOINTS, POSES[:1], jnp.float32(DIAMETER), config).points[1, 0])
    offsets = np.asarray(jax.lax.map(one, jax.random.split(jax.random.key(1), 4000)))
    heavy = (offsets > 16.5e-3).mean()
    np.testing.assert_allclose(heavy, 0.75, atol=4 * np.sqrt(0.75 * 0.25 / 4000))


def test_crops_hold_rows_in_proportion_to_the_picture_area_though_most_rows_are_drawn_for_normals() -> None:
    # Heavy rows are all among the 600 for the normals; of the 60 of the crop they still are their share of the area.
    total, heavy = 1000, 100
    rng = np.random.default_rng(3)
    visible = VisiblePoints(
        points=(rng.normal(size=(total, 3)) * 0.1 + [0, 0, 5]).astype("f4"),
        normals=np.tile(np.float32([0, 0, -1]), (total, 1)),
        picture_area=np.where(np.arange(total) < heavy, 9, 1).astype("f4"),
        instance=np.where(np.arange(total) < heavy, 0, 1).astype("i4"),
        mask=np.ones(total, dtype=bool),
        visible_fraction=np.ones(2, dtype=np.float32),
    )
    config = CropConfig(num_points=60, max_noise=0.0, normal_points=600, min_points=1)
    # Seeds are on copy 0 in half of the draws, and then take one of its rows; the others say what share is of it.
    one = jax.jit(lambda key: draw(key, visible, KEYPOINTS, POSES[:2], jnp.float32(DIAMETER), config))
    crops = jax.lax.map(one, jax.random.split(jax.random.key(2), 300))
    on_heavy = np.where(np.asarray(crops.instance)[:, None] == 0, crops.is_object, ~np.asarray(crops.is_object))
    assert np.asarray(crops.mask).all()
    np.testing.assert_allclose(on_heavy[:, 1:].mean(), 0.5, atol=0.02)


@pytest.mark.parametrize("config", [EXACT, CLEAN], ids=["surface", "estimated"])
def test_fewer_points_than_asked_for_are_all_taken_and_padded(config: CropConfig) -> None:
    visible = scene(0, share=0.04, visible_fraction=np.ones(COPIES, dtype=np.float32))
    crop = plain(crop_of(3, visible, config))
    count = int(crop["mask"].sum())
    assert crop["valid"]
    assert crop["num_inside"] == count < 128
    assert len(np.unique(rows_of(crop, visible))) == count
    assert crop["mask"][:count].all()
    for name in ("points", "normals", "is_object"):
        assert not crop[name][count:].any()
    np.testing.assert_allclose(np.linalg.norm(crop["normals"][:count], axis=1), 1, atol=1e-5)


def test_more_points_asked_for_than_the_scene_has_rows() -> None:
    visible, config = scene(0), CropConfig(num_points=4000, radius=5.0, normals="surface")
    crop = crop_of(0, visible, config)
    assert crop.points.shape == crop.normals.shape == (4000, 3)
    assert np.asarray(crop.mask).sum() == visible.mask.sum() == int(crop.num_inside)
    assert all_finite(crop)


@pytest.mark.parametrize("config", [EXACT, NOISY], ids=["surface", "estimated"])
@pytest.mark.parametrize(
    "case", ["nothing visible", "only the bin", "too little of each copy", "facing away", "no pose"]
)
def test_without_a_seed_the_crop_is_not_valid_and_empty_but_finite(case: str, config: CropConfig) -> None:
    poses = POSES
    if case == "nothing visible":
        visible = scene(mask=np.zeros(COPIES * M + B, dtype=bool), visible_fraction=np.zeros(COPIES, dtype=np.float32))
    elif case == "only the bin":
        visible = scene(mask=np.arange(COPIES * M + B) >= COPIES * M)
    elif case == "too little of each copy":
        visible = scene(visible_fraction=np.full(COPIES, 0.05, dtype=np.float32))
    elif case == "facing away":
        visible = scene(picture_area=np.zeros(COPIES * M + B, dtype=np.float32))
    else:
        visible = scene(mask=np.zeros(COPIES * M + B, dtype=bool))
        poses = np.full_like(POSES, np.nan)
    crop = draw(jax.random.key(0), visible, KEYPOINTS, poses, jnp.float32(DIAMETER), config)
    assert all_finite(crop)
    assert not crop.valid
    assert not np.asarray(crop.mask).any()
    assert not np.asarray(crop.is_object).any()
    assert not np.asarray(crop.points).any()
    assert not np.asarray(crop.normals).any()
    np.testing.assert_array_equal(crop.T_crop_object, np.eye(4))


@pytest.mark.parametrize("config", [EXACT, NOISY], ids=["surface", "estimated"])
def test_one_visible_point_is_a_crop_of_one_but_below_min_points_not_valid(config: CropConfig) -> None:
    visible = scene(mask=np.arange(COPIES * M + B) == M + 7)
    crop = crop_of(0, visible, config)
    assert all_finite(crop)
    assert not crop.valid
    assert int(crop.num_inside) == np.asarray(crop.mask).sum() == 1
    assert int(crop.instance) == 1
    point, normal = np.asarray(crop.points)[0], np.asarray(crop.normals)[0]
    np.testing.assert_array_equal(point, 0)
    np.testing.assert_allclose(np.linalg.norm(normal), 1, atol=1e-6)
    if config.normals == "estimated":
        sight = -np.asarray(crop.seed) / np.linalg.norm(crop.seed)
        np.testing.assert_allclose(normal, sight, atol=1e-6)


def test_seeds_lie_only_on_copies_of_which_enough_is_visible() -> None:
    visible = scene(visible_fraction=np.array([0.05, 0.3, 0.09, 0.1], dtype=np.float32))
    instances = {int(crop_of(seed, visible, EXACT).instance) for seed in range(40)}
    assert instances == {1, 3}


def test_the_share_of_seeds_by_instance_is_drawn_from_each_copy_alike() -> None:
    visible = scene(2)
    # The first copy covers a hundred times as much of the picture; the last one is too hidden to be drawn from.
    area = np.where(visible.instance == 0, 100 * visible.picture_area, visible.picture_area)
    visible = visible._replace(picture_area=area, visible_fraction=np.float32([1] * (COPIES - 1) + [0.05]))
    keys = jax.random.split(jax.random.key(0), 400)

    def shares(instance_seeds: float) -> np.ndarray:
        config = replace(EXACT, instance_seeds=instance_seeds)
        one = jax.jit(lambda key: draw(key, visible, KEYPOINTS, POSES, jnp.float32(DIAMETER), config).instance)
        return np.bincount(np.asarray(jax.lax.map(one, keys)), minlength=COPIES) / len(keys)

    assert shares(0.0)[0] > 0.95
    alike = np.where(np.arange(COPIES) < COPIES - 1, 1 / (COPIES - 1), 0)
    np.testing.assert_allclose(shares(1.0), alike, atol=0.08)
    np.testing.assert_allclose(shares(0.5)[1:], alike[1:] / 2, atol=0.06)


def test_noise_is_gaussian_of_the_said_deviation_clipped_at_three_sigma() -> None:
    visible = scene(0)
    sigmas, offsets = [], []
    for seed in range(60):
        clean, noisy = (plain(crop_of(seed, visible, config)) for config in (CLEAN, NOISY))
        for name in ("mask", "is_object", "keypoint", "instance", "num_inside"):
            np.testing.assert_array_equal(noisy[name], clean[name])
        # The pose follows the noisy seed: it still maps the object onto the points without noise.
        np.testing.assert_allclose(
            noisy["T_crop_object"][:3, 3] + noisy["seed"], clean["T_crop_object"][:3, 3] + clean["seed"], atol=1e-5
        )
        np.testing.assert_array_equal(noisy["points"][0], 0)
        offset = (noisy["points"] + noisy["seed"]) - (clean["points"] + clean["seed"])
        sigmas.append(float(noisy["noise"]))
        offsets.append(offset.ravel() / sigmas[-1])
        assert np.abs(offsets[-1]).max() < 3.001 + 1e-5 / sigmas[-1]
    scaled = np.concatenate([offset for offset, sigma in zip(offsets, sigmas, strict=True) if sigma > 1e-3])
    np.testing.assert_allclose(scaled.mean(), 0, atol=0.02)
    np.testing.assert_allclose(scaled.std(), 0.9933, atol=0.02)  # that of a normal clipped at 3
    assert 0 <= min(sigmas) < 0.15 * 0.02 * DIAMETER
    assert 0.85 * 0.02 * DIAMETER < max(sigmas) <= 0.02 * DIAMETER


def test_estimated_normals_are_those_of_the_noisy_points_and_look_at_the_camera() -> None:
    tilt = random_rotations(1, 4)[0][:, 2]
    normal = np.array([0.3, -0.2, -1]) / np.linalg.norm([0.3, -0.2, -1])
    across = np.linalg.svd(normal[None])[2][1:]
    total = COPIES * M + B
    place = np.random.default_rng(0).uniform(-1.5, 1.5, size=(total, 2)) @ across + [0.5, -0.3, 9]
    # The sign of the surface's own normals plays no part.
    visible = scene(points=place.astype(np.float32), normals=np.tile(np.float32(tilt), (total, 1)))
    errors = {}
    for config in (CLEAN, NOISY):
        crop = plain(crop_of(2, visible, config))
        assert crop["mask"].all()
        assert (-(crop["points"] + crop["seed"]) * crop["normals"]).sum(axis=1).min() > 0
        np.testing.assert_allclose(np.linalg.norm(crop["normals"], axis=1), 1, atol=1e-5)
        errors[config] = np.degrees(np.arccos(np.clip(crop["normals"] @ normal, -1, 1)))
    assert np.quantile(errors[CLEAN], 0.98) < 0.3
    assert 1 < np.median(errors[NOISY]) < 25


@pytest.mark.parametrize("config", [EXACT, NOISY], ids=["surface", "estimated"])
def test_a_key_gives_the_same_crop_each_time_and_another_key_another(config: CropConfig) -> None:
    visible = scene(0)
    first, again, other = (plain(crop_of(seed, visible, config)) for seed in (5, 5, 6))
    for name, value in first.items():
        np.testing.assert_array_equal(value, again[name])
    assert (first["seed"] != other["seed"]).any()


@pytest.mark.parametrize("config", [EXACT, NOISY], ids=["surface", "estimated"])
def test_vmap_equals_single_crops(config: CropConfig) -> None:
    scenes = [scene(seed) for seed in range(3)]
    stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *scenes)
    keys = jnp.stack([jax.random.key(seed) for seed in range(3)])
    batched = jax.jit(
        jax.vmap(lambda key, visible: draw(key, visible, KEYPOINTS, POSES, jnp.float32(DIAMETER), config))
    )(keys, stacked)
    for i in range(3):
        alone = crop_of(i, scenes[i], config)
        for name, part, expected in zip(LabelledCrop._fields, batched, alone, strict=True):
            # A neighbour at the very boundary may count or not, which turns a normal.
            share = 0.01 if name == "normals" and config is NOISY else 0.0
            close = np.isclose(np.asarray(part)[i], np.asarray(expected), atol=2e-3 if share else 1e-5)
            assert (~close).mean() <= share, name


@pytest.mark.parametrize(
    "wrong",
    [
        {"min_points": 0},
        {"min_points": 3000},
        {"radius": 0.0},
        {"max_noise": -0.1},
        {"normal_radius": 0.0},
        {"normal_points": 2},
        {"instance_seeds": 1.5},
    ],
)
def test_a_config_that_makes_no_sense_is_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        CropConfig(**wrong)


def test_a_scene_without_rows_is_refused() -> None:
    empty = jax.tree.map(lambda part: part[:0], scene(0))
    with pytest.raises(ValueError, match="no points"):
        draw(jax.random.key(0), empty, KEYPOINTS, POSES, np.float32(1))
