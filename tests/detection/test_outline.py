"""Outlines of boxes before a wall, in it and half hidden."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kmn_jax.detection import DepthAgreementConfig, DepthImage, OutlineAgreement, outline_agreement
from kmn_jax.geometry import intrinsics
from kmn_jax.simulate import Surfels
from tests.detection.box_sample import CAMERA, POSES, SIZES, WALL, box_part, box_view
from tests.reference.meshes import pose

PART = box_part()
SURFELS = Surfels(jnp.asarray(PART.points), jnp.asarray(PART.normals), jnp.float32(PART.area))
compare = jax.jit(outline_agreement, static_argnames="config")


@pytest.fixture(scope="module")
def depth() -> jax.Array:
    image = box_view().depth
    assert image is not None
    return jnp.asarray(image)


def of(T: np.ndarray, depth: jax.Array) -> OutlineAgreement:
    found: OutlineAgreement = compare(
        jnp.asarray(T, dtype=jnp.float32),
        SURFELS,
        DepthImage(depth, intrinsics(CAMERA)),
        jnp.float32(PART.diameter),
        config=DepthAgreementConfig(),
    )
    assert 0 <= found.open <= found.open + found.level <= 1 + 1e-6
    return found


def test_beyond_a_box_before_a_wall_is_the_wall(depth: jax.Array) -> None:
    for T in POSES:
        assert of(T, depth).open > 0.95


def test_a_wall_goes_on_beyond_a_box_sunk_into_it(depth: jax.Array) -> None:
    found = of(pose((0.0, 0.0, WALL + SIZES[2] / 2)), jnp.full_like(depth, WALL))
    assert found.level > 0.95
    assert found.open == 0


def test_a_pose_half_on_a_box_is_open_there_only(depth: jax.Array) -> None:
    # Moved by half its length along y: one of its sides lies on the box.
    found = of(POSES[0] @ pose((0.0, SIZES[1] / 2, 0.0)), depth)
    on_box = SIZES[0] / (2 * SIZES[0] + 2 * SIZES[1])
    assert abs(found.level - on_box) < 0.06
    assert abs(found.open - (1 - on_box)) < 0.06


def test_what_is_hidden_counts_for_neither_and_what_was_not_measured_is_open(depth: jax.Array) -> None:
    assert of(POSES[0], jnp.full_like(depth, 1.0)) == (0, 0)
    assert of(POSES[0], jnp.zeros_like(depth)) == (1, 0)
    left = np.arange(depth.shape[1]) < CAMERA.cx + CAMERA.fx * POSES[0][0, 3] / (POSES[0][2, 3] - SIZES[2] / 2)
    assert abs(of(POSES[0], jnp.where(jnp.asarray(left)[None], depth, 1.0)).open - 0.5) < 0.06
    assert of(POSES[0], jnp.where(jnp.asarray(left)[None], depth, 0)).open > 0.95


def test_a_pose_behind_the_sensor_or_outside_of_the_image_has_no_outline(depth: jax.Array) -> None:
    assert of(pose((0.0, 0.0, -3.0)), depth) == (0, 0)
    assert of(pose((9.0, 0.0, 3.0)), depth) == (0, 0)
    tiny = of(pose((0.0, 0.0, 200.0)), jnp.full_like(depth, 300.0))  # the box is less than a pixel large
    assert tiny == (1, 0)


def test_a_sparse_image_of_a_wall_is_still_level(depth: jax.Array) -> None:
    holes = jnp.asarray(np.random.default_rng(0).random(depth.shape) < 0.4)
    found = of(pose((0.0, 0.0, WALL + SIZES[2] / 2)), jnp.where(holes, 0, WALL))
    assert found.level > 0.95


def test_holes_have_an_outline(depth: jax.Array) -> None:
    plate = np.stack(np.meshgrid(np.linspace(-0.5, 0.5, 60), np.linspace(-0.5, 0.5, 60)), axis=-1).reshape(-1, 2)
    ring = plate[np.linalg.norm(plate, axis=1) > 0.3]
    points = np.concatenate([ring, np.zeros((len(ring), 1))], axis=1).astype(np.float32)
    surfels = Surfels(jnp.asarray(points), jnp.broadcast_to(jnp.array([0.0, 0, -1]), points.shape), jnp.float32(0.7))
    wall = jnp.full_like(depth, 3.0)
    through = jnp.where(depth >= 0, wall, 0)
    rows, columns = np.mgrid[: CAMERA.height, : CAMERA.width]
    away = np.hypot(columns - CAMERA.cx, rows - CAMERA.cy) / CAMERA.fx * 3
    hole = jnp.where(jnp.asarray(away) < 0.3, 4.0, through)
    camera, diameter = intrinsics(CAMERA), jnp.float32(2**0.5)
    T = jnp.asarray(pose((0.0, 0.0, 3.0)), dtype=jnp.float32)
    closed, opened = (
        compare(T, surfels, DepthImage(image, camera), diameter, config=DepthAgreementConfig())
        for image in (through, hole)
    )
    assert closed.open == 0
    assert 0.2 < opened.open < 0.5  # two pi 0.3 of it and 4
