"""Worlds made inside of a step: parts are in the container and apart, labels and visibility are what they say."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kmn_jax.errors import InputError
from kmn_jax.objects._surface import outer_surface
from kmn_jax.simulate import (
    BIN,
    FOREIGN,
    Container,
    FaultConfig,
    Surfels,
    World,
    WorldConfig,
    container_surfels,
    displaced,
    draw_faults,
    hidden_by_container,
    make_world,
    measured,
)
from kmn_jax.simulate._worlds import _lying
from tests.reference.meshes import box

SIZE = np.array([0.08, 0.05, 0.033])  # metres
DIAMETER = float(np.linalg.norm(SIZE))
# Each config is a program of its own, which takes seconds to compile: tests share these.
CONFIG = WorldConfig(background_points=4096, resolution=256, foreign=0.6, removed=0.0, half_removed=0.0)
COPIES_ON_A_TABLE = replace(CONFIG, foreign=0.0, tables=1.0, trays=0.0, rows=0.0, removed=1.0)
MIXED_WITHOUT_BIN = replace(CONFIG, foreign=1.0, removed=1.0)
make = jax.jit(make_world, static_argnames="config")
lying = jax.jit(_lying)
surfels_of = jax.jit(container_surfels, static_argnums=(2, 3))
is_hidden = jax.jit(hidden_by_container)
faults_of = jax.jit(draw_faults, static_argnums=1)
move, is_measured = jax.jit(displaced), jax.jit(measured)


@cache
def box_surfels(*size: float) -> Surfels:
    found = outer_surface(*box(*size), 2048)
    return Surfels(jnp.asarray(found.points), jnp.asarray(found.normals), jnp.float32(found.area))


def world(seed: int, config: WorldConfig = CONFIG) -> World:
    parts = box_surfels(*SIZE.tolist()), box_surfels(*(SIZE[::-1] * 2).tolist())
    return jax.device_get(make(jax.random.key(seed), *parts, np.float32(DIAMETER), config))


def a_bin(**changes: float) -> Container:
    numbers = {"height": 1.0, "slope": 0.0, "rim": 0.2, "lift": 0.1, "divider_width": 0.1, "gap": np.inf} | changes
    fields = {name: jnp.float32(value) for name, value in numbers.items()}
    none = jnp.zeros(2)
    return Container(half=jnp.array([1.0, 0.8]), divider=none, divider_height=none, **fields)


def test_worlds_are_finite_and_the_same_for_the_same_key() -> None:
    for seed in range(8):
        found, again = world(seed), world(seed)
        for leaf, other in zip(jax.tree.leaves(found), jax.tree.leaves(again), strict=True):
            np.testing.assert_array_equal(leaf, other)
            assert np.isfinite(np.asarray(leaf, dtype=np.float64)).all()


def test_visible_points_of_copies_lie_on_them_and_face_the_camera() -> None:
    for seed in range(8):
        found = world(seed)
        points, mask, instance = found.visible.points, found.visible.mask, found.visible.instance
        facing = (points * found.visible.normals).sum(axis=1) < 0
        assert facing[mask].all()
        assert (points[mask, 2] > 0).all()
        for copy, pose in enumerate(found.T_camera_object.astype(np.float64)):
            own = points[mask & (instance == copy)]
            local = (own - pose[:3, 3]) @ pose[:3, :3]
            assert (np.abs(local) < SIZE / 2 + 1e-4).all()


def test_copies_do_not_go_through_one_another_nor_the_floor() -> None:
    # The map of heights knows cells, not surfaces: corners may sink in by about the width of one.
    allowed = 0.08 * DIAMETER
    for seed in range(12):
        found = world(seed, COPIES_ON_A_TABLE)
        poses = found.T_camera_object.astype(np.float64)
        grid = np.stack(np.meshgrid(*[np.linspace(-0.5, 0.5, 7)] * 3), axis=-1).reshape(-1, 3) * SIZE
        seen = np.bincount(np.maximum(found.visible.instance[found.visible.mask], 0), minlength=len(poses)) > 0
        for first in np.flatnonzero(seen):
            inside = grid @ poses[first, :3, :3].T + poses[first, :3, 3]
            for second in np.flatnonzero(seen):
                if first != second:
                    local = (inside - poses[second, :3, 3]) @ poses[second, :3, :3]
                    assert (SIZE / 2 - np.abs(local)).min(axis=1).max() < allowed


def test_scenes_have_what_their_shares_say() -> None:
    for seed in range(6):
        assert not (world(seed, COPIES_ON_A_TABLE).visible.instance == FOREIGN).any()
    bare, kept = (
        [one.instance[one.mask] for one in (world(seed, config).visible for seed in range(6))]
        for config in (MIXED_WITHOUT_BIN, CONFIG)
    )
    assert not any((instances == BIN).any() for instances in bare)
    assert all((instances == BIN).any() for instances in kept)
    for seen in (bare, kept):
        assert any((instances == FOREIGN).any() for instances in seen)


def test_a_flat_part_lies_on_a_large_side() -> None:
    normals = box_surfels(1.0, 1.0, 0.05).normals
    flat = 0
    for seed in range(20):
        rotation = np.asarray(lying(jax.random.key(seed), normals))
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-5)
        assert np.linalg.det(rotation) == pytest.approx(1, abs=1e-5)
        flat += abs(rotation[2, 2]) > 0.99
    assert flat == 20  # a large side is among the sides asked for


def test_surfels_of_a_bin_cover_floor_walls_and_rims_evenly() -> None:
    points, normals, real, area = jax.device_get(surfels_of(a_bin(), np.zeros(3, np.float32), 10.0, 1 << 15))
    points = points[real]
    x, y, z = np.abs(points[:, 0]), np.abs(points[:, 1]), points[:, 2]
    floor = (np.abs(z) < 1e-4) & (x < 0.999) & (y < 0.799)
    wall = (np.abs(x - 1) < 1e-4) & (z > 1e-3) & (z < 0.999) & (y < 0.8)
    rim = np.abs(z - 1) < 1e-4
    for chosen, expected in ((floor, 2 * 1.6), (wall, 2 * 1.6), (rim, 2.4 * 2.0 - 2 * 1.6)):
        assert chosen.sum() * float(area) == pytest.approx(expected, rel=0.05)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-5)


def test_walls_hide_what_is_behind_them() -> None:
    eye, x, y = np.float32([4, 0, 4]), np.float32([0.9, -0.9, 3, -1.6]), np.zeros(4, np.float32)
    z = np.float32([0.1, 0.1, 0, -0.05])
    hidden = np.asarray(is_hidden(a_bin(), eye, x, y, z))
    # Under the near wall; at the far one; on the table in front; on the table behind the bin.
    np.testing.assert_array_equal(hidden, [True, False, False, True])
    assert not np.asarray(is_hidden(a_bin(height=0.0), eye, x, y, z)).any()


@pytest.mark.parametrize("family", ["structured_light", "stereo", "time_of_flight"])
def test_sensors_move_points_along_their_rays_and_lose_what_is_slanted(family: str) -> None:
    shares = dict.fromkeys(("structured_light", "stereo", "time_of_flight"), 0.0) | {family: 1.0}
    rng = np.random.default_rng(0)
    points = rng.uniform([-0.5, -0.5, 5.5], [0.5, 0.5, 6.5], (500, 3)).astype(np.float32)
    normals, sideways = (np.tile(np.float32(normal), (500, 1)) for normal in ([0, 0, -1], [1, 0, 0]))
    mask, seed_place, unit = np.ones(500, dtype=bool), np.float32([0, 0, 6]), np.float32(1)
    errors = []
    for seed in range(10):
        key = jax.random.key(seed)
        faults = faults_of(key, FaultConfig(**shares))
        found = np.asarray(move(key, faults, points, normals, unit))
        assert np.isfinite(found).all()
        np.testing.assert_allclose(np.cross(found, points), 0, atol=1e-3)
        errors.append(np.median(np.linalg.norm(found - points, axis=1)))
        assert np.mean(is_measured(key, faults, points, normals, mask, unit, seed_place)) > 0.3
        assert np.mean(is_measured(key, faults, points, sideways, mask, unit, seed_place)) < 0.5
    assert 1e-4 < np.median(errors) < 0.06


def test_a_perfect_sensor_changes_nothing() -> None:
    faults = faults_of(jax.random.key(0), FaultConfig(0.0, 0.0, 0.0))
    points = np.random.default_rng(0).uniform(1, 2, (500, 3)).astype(np.float32)
    np.testing.assert_allclose(move(jax.random.key(1), faults, points, -points, np.float32(1)), points, rtol=1e-5)


@pytest.mark.parametrize(
    "fields", [{"slots": 0}, {"removed": 0.7, "half_removed": 0.4}, {"foreign": -0.1}, {"distance": (5.0, 4.0)}]
)
def test_refuses_worlds_that_cannot_be(fields: dict) -> None:
    with pytest.raises(InputError):
        WorldConfig(**fields)
    with pytest.raises(InputError, match="shares of sensors"):
        FaultConfig(stereo=0.9)
