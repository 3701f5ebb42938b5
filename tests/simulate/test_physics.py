import itertools
import math
import os

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from kmn_jax.errors import InputError
from kmn_jax.simulate import BinConfig, collision_shape, settle

CONFIG = BinConfig()


def shape_of(*boxes, origin=(0.0, 0.0, 0.0), scale=1.0):
    """Return the collision shape of joined boxes, each given by its lowest and highest corner."""
    corners = np.array([list(itertools.product(*zip(low, high, strict=True))) for low, high in boxes], dtype=float)
    hulls = [ConvexHull(box).simplices + 8 * i for i, box in enumerate(corners)]
    vertices = scale * corners.reshape(-1, 3) + np.array(origin)
    return collision_shape(vertices, np.concatenate(hulls).astype(np.int32))


# the origins of their frames lie outside of them; units differ
BOX = shape_of(([0, 0, 0], [3, 2, 1]), origin=(50, -20, 30), scale=10.0)
L_SHAPE = shape_of(([0, 0, 0], [4, 1, 1]), ([0, 0, 0], [1, 1, 3]), origin=(0.1, 0.0, 0.2), scale=0.01)
ROD = shape_of(([0, 0, 0], [10, 0.5, 0.5]), origin=(3, 3, 3))
SHAPES = {"box": BOX, "l-shape": L_SHAPE, "rod": ROD}


def placed(shape, T_bin_object):
    """Return the corners of all parts of one copy, part by part, in the bin frame."""
    return [part @ T_bin_object[:3, :3].T + T_bin_object[:3, 3] for part in shape.parts]


def interpenetration(shape, T_bin_object):
    """Return how deep copies lie in each other, in diagonals, from samples of their parts (not from the simulator)."""
    rng = np.random.default_rng(0)
    samples = []
    for part in shape.parts:
        corners = part[ConvexHull(part).simplices]
        weights = rng.dirichlet([0.5, 0.5, 0.5], size=(200, len(corners)))
        samples.append(np.concatenate([part, np.einsum("stk,tki->sti", weights, corners).reshape(-1, 3)]))
    points = np.concatenate(samples)
    equations = [ConvexHull(part).equations for part in shape.parts]
    deepest = 0.0
    for i, j in itertools.permutations(range(len(T_bin_object)), 2):
        T = np.linalg.inv(T_bin_object[j]) @ T_bin_object[i]
        if np.linalg.norm(T[:3, :3] @ shape.center + T[:3, 3] - shape.center) > 2 * shape.diagonal:
            continue
        moved = points @ T[:3, :3].T + T[:3, 3]
        for plane in equations:
            deepest = max(deepest, -(moved @ plane[:, :3].T + plane[:, 3]).max(axis=1).min())
    return deepest / shape.diagonal


@pytest.mark.parametrize("copies", [1, 2, 20])
@pytest.mark.parametrize("name", SHAPES)
def test_copies_rest_in_the_bin_without_penetration(name, copies):
    shape = SHAPES[name]
    result = settle(shape, copies, CONFIG, (7, copies))
    assert result.accepted
    assert result.T_bin_object.shape == (copies, 4, 4)
    assert not result.capped
    assert 0 < result.floor_share <= 1
    assert result.attempts == 1 + len(result.rejected)

    R = result.T_bin_object[:, :3, :3]
    np.testing.assert_allclose(R @ R.transpose(0, 2, 1), np.tile(np.eye(3), (copies, 1, 1)), atol=1e-9)
    assert (np.linalg.det(R) > 0).all()
    assert (result.T_bin_object[:, 3] == [0, 0, 0, 1]).all()

    assert 0 <= result.penetration <= CONFIG.penetration
    assert interpenetration(shape, result.T_bin_object) <= CONFIG.penetration
    corners = np.concatenate([np.concatenate(placed(shape, pose)) for pose in result.T_bin_object])
    allowed = CONFIG.penetration * shape.diagonal
    half = np.array([result.bin.length, result.bin.width]) / 2
    assert (np.abs(corners[:, :2]) < half + allowed).all()
    assert abs(corners[:, 2].min()) < allowed  # the lowest one is on the floor
    lowest = [np.concatenate(placed(shape, pose))[:, 2].min() for pose in result.T_bin_object]
    assert max(lowest) < result.bin.height


def test_bins_are_drawn_from_the_config_in_the_units_of_the_object():
    bins = [settle(BOX, 1, CONFIG, seed).bin for seed in range(12)]
    lengths, heights = ([getattr(b, name) / BOX.diagonal for b in bins] for name in ("length", "height"))
    assert len(set(lengths)) == len(set(heights)) == 12
    assert CONFIG.length * CONFIG.scale[0] <= min(lengths) < max(lengths) <= CONFIG.length * CONFIG.scale[1]
    assert CONFIG.height[0] <= min(heights) < max(heights) <= CONFIG.height[1]
    for b in bins:
        assert b.width / b.length == pytest.approx(CONFIG.width / CONFIG.length)
        assert b.thickness == pytest.approx(CONFIG.thickness * BOX.diagonal)


@pytest.mark.parametrize("seed", range(5))
def test_a_lone_box_lies_on_a_face(seed):
    pose = settle(BOX, 1, CONFIG, seed).T_bin_object[0]
    up = np.abs(pose[2, :3])
    assert up.max() > 0.9999
    side = 10 * np.array([3, 2, 1])[up.argmax()]
    assert (pose[:3, :3] @ BOX.center + pose[:3, 3])[2] == pytest.approx(side / 2, abs=1e-3 * BOX.diagonal)


def test_small_bins_pile_higher():
    wide, narrow = (BinConfig(scale=(scale, scale), packing=1.0) for scale in (1.05, 0.65))
    floor = [np.mean([settle(L_SHAPE, 16, c, seed).floor_share for seed in range(3)]) for c in (wide, narrow)]
    assert floor[1] < floor[0] - 0.1


def test_same_seed_same_bits():
    first, again, other = (settle(L_SHAPE, 6, CONFIG, seed) for seed in ((3, 1), (3, 1), (3, 2)))
    np.testing.assert_array_equal(first.T_bin_object, again.T_bin_object)
    assert first.bin == again.bin
    assert (first.penetration, first.floor_share, first.rejected) == (
        again.penetration,
        again.floor_share,
        again.rejected,
    )
    assert not np.allclose(first.T_bin_object, other.T_bin_object, atol=1e-3)


def test_poses_differ_between_copies_and_drops():
    poses = np.concatenate([settle(BOX, 8, CONFIG, seed).T_bin_object for seed in range(3)])
    angles = np.arccos(np.clip((np.einsum("aij,bij->ab", poses[:, :3, :3], poses[:, :3, :3]) - 1) / 2, -1, 1))
    assert angles[np.triu_indices(len(poses), 1)].min() > 1e-2


def test_a_scene_that_is_not_at_rest_when_time_is_over_says_so():
    config = BinConfig(rest_speed=1e-12, rest_rotation=1e-12, time_cap=0.8)
    result = settle(BOX, 2, config, 0)
    assert result.capped
    assert result.accepted


@pytest.mark.parametrize(
    ("config", "copies", "reason", "poses"),
    [
        (BinConfig(scale=(0.1, 0.1)), 1, "too small", 0),
        (BinConfig(scale=(0.4, 0.4), height=(0.3, 0.3)), 20, "too small", 0),
        (BinConfig(scale=(0.6, 0.6), height=(0.5, 0.5)), 12, "above the rim", 12),
        (BinConfig(penetration=1e-9), 5, "penetrate", 5),
        (BinConfig(check_every=0.01, time_cap=0.01), 1, "touches nothing", 1),
        (BinConfig(step=1e6, check_every=1e6, time_cap=1e8), 1, "broke down", 1),
    ],
)
def test_failure_is_a_result_with_a_reason(config, copies, reason, poses, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    result = settle(BOX, copies, config, 0)
    assert not result.accepted
    assert result.attempts == len(result.rejected) == config.attempts
    assert all(reason in rejection for rejection in result.rejected)
    assert result.T_bin_object.shape == (poses, 4, 4)
    assert np.isfinite(result.T_bin_object).all()
    assert math.isfinite(result.penetration)
    assert os.listdir() == []  # no log file of the simulator
    assert capfd.readouterr() == ("", "")


def test_a_fuller_bin_is_tried_again_with_a_larger_one():
    config = BinConfig(packing=1.0, scale=(0.55, 1.05), height=(0.6, 0.6), attempts=12)
    results = [settle(BOX, 12, config, seed) for seed in range(4)]
    assert all(result.accepted for result in results)
    assert any("above the rim" in rejection for result in results for rejection in result.rejected)


def test_thin_plates_settle():
    vertices = np.array(list(itertools.product([0, 1], [0, 0.7], [0, 0.02])), dtype=float)
    shape = collision_shape(vertices, ConvexHull(vertices).simplices.astype(np.int32))
    result = settle(shape, 10, CONFIG, 1)
    assert result.accepted
    assert interpenetration(shape, result.T_bin_object) <= CONFIG.penetration


def test_parts_of_one_copy_do_not_push_each_other():
    """The parts of an L overlap by nothing, but touch: it must come to rest as one body."""
    assert len(L_SHAPE.parts) > 1
    assert settle(L_SHAPE, 1, CONFIG, 0).penetration < CONFIG.penetration


@pytest.mark.parametrize(
    ("copies", "seed", "message"), [(0, 0, "copies is 0"), (-3, 0, "copies"), (1, (4, -1), "seed")]
)
def test_wrong_arguments_are_refused(copies, seed, message):
    with pytest.raises(InputError, match=message):
        settle(BOX, copies, CONFIG, seed)


@pytest.mark.parametrize(
    "wrong",
    [
        {"length": 0.0},
        {"step": -1.0},
        {"friction": 0.0},
        {"time_cap": math.nan},
        {"penetration": math.inf},
        {"scale": (1.0, 0.5)},
        {"height": (0.0, 1.0)},
        {"damping": (-1.0, 0.5)},
        {"packing": 0.0},
        {"packing": 1.5},
        {"attempts": 0},
        {"rest_checks": 0},
        {"check_every": 0.001},
    ],
)
def test_wrong_configs_are_refused(wrong):
    with pytest.raises(InputError, match=next(iter(wrong))):
        BinConfig(**wrong)
