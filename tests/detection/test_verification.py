"""What a verifier sees of a pose, and who is shown to it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kmn_jax.detection import (
    EVIDENCE,
    PREDICTED_CHANNELS,
    VERIFIED,
    VERIFIER_SIDE,
    CropSearchConfig,
    DepthImage,
    DevicePart,
    Scene,
    SearchConfig,
    candidates_of,
    picture_agreement,
    refined_candidates,
    verified,
    verifier_cells,
)
from kmn_jax.detection import _choice as choosing
from kmn_jax.detection import _verification as module
from kmn_jax.detection._picture_cells import measured, predicted
from kmn_jax.detection._search import no_poses
from kmn_jax.geometry import intrinsics
from kmn_jax.models import VERIFIER_CHANNELS, create_verifier, load_verifier, verify
from kmn_jax.objects import PartArrays
from kmn_jax.simulate import Surfels
from tests.detection.box_sample import CAMERA, POSES, box_part, box_view
from tests.reference.meshes import pose

PART, VIEW = box_part(), box_view()
SURFELS = Surfels(jnp.asarray(PART.points), jnp.asarray(PART.normals), jnp.float32(PART.area))
MASK, THERE, GAP, OWN, OTHER, COSINE, HAS_NORMAL, AWAY, NOISE, TOWARD, IN_IMAGE = range(VERIFIER_CHANNELS)
see = jax.jit(verifier_cells)
find_agreement = jax.jit(picture_agreement)


def cells_of(T: np.ndarray, depth: np.ndarray | None = None, diameter: float = PART.diameter) -> np.ndarray:
    image = DepthImage(jnp.asarray(VIEW.depth if depth is None else depth), intrinsics(CAMERA))
    cells = np.asarray(see(T.astype(np.float32), SURFELS, image, np.float32(diameter)))
    assert np.isfinite(cells).all()
    assert np.abs(np.delete(cells, TOWARD, axis=-1)).max() <= 1
    return cells


def test_at_the_right_pose_the_cells_agree() -> None:
    cells = cells_of(POSES[0])
    mask = cells[..., MASK] > 0
    assert mask.shape == (VERIFIER_SIDE, VERIFIER_SIDE)
    assert 0.05 < mask.mean() < 0.5
    taken = np.argwhere(mask)
    assert (taken.min(axis=0) == 8).all()  # so many cells are beyond the outline
    assert taken.max() < VERIFIER_SIDE - 8
    inside = mask & (cells[..., COSINE] > 0)
    assert np.abs(cells[..., GAP][inside]).mean() < 0.1  # in 6% of the diameter
    np.testing.assert_allclose(cells[..., OWN][mask].mean(), 0, atol=1e-5)
    assert np.abs(cells[..., OWN] - cells[..., OTHER])[inside].mean() < 0.01
    assert (cells[..., COSINE][inside] > 0.9).mean() > 0.8
    assert (cells[..., (GAP, OWN, AWAY)][~mask] == 0).all()
    beyond = (cells[..., THERE] > 0) & ~mask
    assert (np.isin(cells[..., OTHER][beyond], 0.5) | (np.abs(cells[..., OTHER][beyond]) < 0.1)).mean() > 0.95
    agreement = find_agreement(POSES[0].astype(np.float32), SURFELS, _image(), np.float32(PART.diameter))
    near = (cells[..., AWAY] < 0.02 / 0.06) & (cells[..., THERE] > 0)
    assert (near & mask).sum() / mask.sum() == pytest.approx(float(agreement.near))


def test_what_is_beyond_the_outline_is_seen_up_to_the_edge_of_the_image() -> None:
    """A camera looks down onto a floor of which the left half of the image is not there."""
    T = pose((0.0, 0.0, 3.0))
    depth = np.full(VIEW.depth.shape, 3.0 * PART.diameter, dtype=np.float32)
    whole = cells_of(T, depth)
    assert (whole[..., IN_IMAGE] == whole[..., THERE]).all()
    seen = whole[..., HAS_NORMAL] == 1
    assert seen.mean() > 0.5
    np.testing.assert_allclose(whole[..., TOWARD][seen], 1, atol=1e-3)  # the floor faces the camera
    depth[:, : int(CAMERA.cx)] = 0
    half = cells_of(T, depth)
    assert (half[..., IN_IMAGE] == whole[..., IN_IMAGE]).all()
    np.testing.assert_array_equal(half[..., PREDICTED_CHANNELS], whole[..., PREDICTED_CHANNELS])
    assert 0.3 < half[..., THERE].sum() / whole[..., THERE].sum() < 0.7
    assert (half[..., TOWARD][half[..., THERE] == 0] == 0).all()
    aside = cells_of(pose((-1.4, 0.0, 3.0)), np.full_like(depth, 3.0 * PART.diameter))  # of half a width at the left
    beyond = aside[..., IN_IMAGE] == 0
    assert 0.05 < beyond.mean() < 0.9
    assert beyond[:, 0].all()
    assert not beyond[8, 24:].any()
    assert (aside[..., THERE] == 1 - beyond).all()


def test_farther_and_nearer_are_told_apart() -> None:
    shift = 0.02 * PART.diameter
    for way in (-1, 1):
        cells = cells_of(POSES[0] @ pose((0.0, 0.0, way * shift)))
        gaps = cells[..., GAP][(cells[..., MASK] > 0) & (cells[..., COSINE] > 0.9)]
        assert np.median(gaps) == pytest.approx(-way / 3, abs=0.05)


def test_they_do_not_depend_on_the_unit_of_length() -> None:
    T = POSES[0].copy()
    T[:3, 3] *= 1000
    surfels = Surfels(1000 * PART.points, PART.normals, np.float32(1e6 * PART.area))
    image = DepthImage(1000 * VIEW.depth, intrinsics(CAMERA))
    large = see(T.astype(np.float32), surfels, image, np.float32(1000 * PART.diameter))
    different = np.abs(np.asarray(large) - cells_of(POSES[0])) > 1e-2
    assert different.mean() < 0.002  # where cells are as near to one pixel as to another


@pytest.mark.parametrize("T", [pose((0.0, 0.0, -3.0)), pose((9.0, 0.0, 3.0))])
def test_of_a_pose_that_cannot_be_seen_nothing_is_said(T: np.ndarray) -> None:
    cells = cells_of(T)
    assert (cells[..., (GAP, AWAY, COSINE)] == 0).all()


def test_poses_are_verified_as_their_cells_are(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = jax.jit(lambda key: create_verifier(key).parameters)(jax.random.key(0))
    verifier = load_verifier()._replace(parameters=drawn)
    monkeypatch.setattr(module, "_shipped", lambda: verifier)
    poses = np.stack([POSES[0], POSES[1], pose((0.3, 0.1, 3.2))]).astype(np.float32)
    part = _on_device()
    found = verified(poses, part, VIEW)
    said = jax.jit(lambda cells: verify(*verifier, cells))
    wanted = [float(said(cells_of(T))) for T in poses]
    np.testing.assert_allclose(found, wanted, atol=1e-4)
    assert np.ptp(found) > 0.01
    many = module._verify_many(poses, *verifier, part.surfels, VIEW.image, part.arrays.diameter)
    np.testing.assert_allclose(many, wanted, atol=1e-4)
    assert verified(poses[:0], part, VIEW).shape == (0,)


def test_refined_poses_alone_are_shown_to_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three candidates of two crops are refined, in two forms each, of which one is missing."""
    shown: list[np.ndarray] = []
    found_by_rows: list[Any] = []

    def refined(poses: np.ndarray, *given: object) -> tuple[np.ndarray, np.ndarray]:
        forms = np.stack([poses, poses], axis=1)
        forms[:, 1, 0, 3] += 100
        return forms, np.array([[True, True], [True, False], [True, True]])

    def said(poses: np.ndarray, part: DevicePart, scene: Scene) -> np.ndarray:
        shown.append(poses)
        return poses[:, 0, 3]

    def rows(one: object, many: Callable[..., Any], *items: Any) -> Any:
        found_by_rows.append(many(*items))
        return found_by_rows[-1]

    monkeypatch.setattr(choosing, "call_rows", rows)
    monkeypatch.setattr(choosing, "refine_many", refined)
    monkeypatch.setattr(choosing, "polish", lambda poses, part, image: poses)
    monkeypatch.setattr(choosing, "verified", said)
    config = SearchConfig(CropSearchConfig(num_points=64, num_draws=1))
    none = no_poses(config.crops, 8)
    crops = jax.tree.map(lambda leaf: np.stack([np.asarray(leaf)] * 2), none)
    count = config.crops.num_poses
    poses = np.tile(np.eye(4, dtype=np.float32), (2 * count, 1, 1))
    poses[:, 0, 3] = np.arange(2 * count)
    evidence = np.zeros((2, count, len(EVIDENCE)), dtype=np.float32)
    found = candidates_of(crops, evidence, np.array([3, 7]))._replace(T_camera_object=poses)
    chosen = np.array([0, 1, count])
    fine = refined_candidates(_on_device(), VIEW, found, chosen, 0, config)
    np.testing.assert_array_equal(fine.T_camera_object[:, 0, 3], [*chosen, *(chosen + 100)])
    np.testing.assert_array_equal(fine.usable, [True, True, True, True, False, True])
    column = fine.evidence[:, EVIDENCE.index(VERIFIED)]
    np.testing.assert_array_equal(column, np.where(fine.usable, fine.T_camera_object[:, 0, 3], 0))
    assert [len(part) for part in shown] == [5]
    before = np.asarray(found_by_rows[-1])  # the evidence of all poses, which the verifier has not been shown yet
    assert (before[..., EVIDENCE.index(VERIFIED)] == 0).all()


def _image() -> DepthImage:
    return DepthImage(VIEW.depth, intrinsics(CAMERA))


def _on_device() -> DevicePart:
    arrays = PartArrays(SURFELS.points, SURFELS.normals, jnp.zeros((len(PART.points), 1)), jnp.float32(PART.diameter))
    return DevicePart(arrays, SURFELS, jnp.eye(4)[None], jnp.float32(0.1), jnp.eye(4)[None], jnp.zeros(1, bool))


def test_normals_at_the_edge_of_the_picture_are_those_of_the_surface() -> None:
    """All that is seen is a large ball, whose opposite sides are as far away: no slope may reach across the picture."""
    radius, away = 4.0, 10.0
    rows, columns = np.mgrid[: CAMERA.height, : CAMERA.width]
    rays = np.stack([(columns - CAMERA.cx) / CAMERA.fx, (rows - CAMERA.cy) / CAMERA.fy, np.ones(rows.shape)], axis=-1)
    squared = (rays**2).sum(axis=-1)
    inside = away**2 - squared * (away**2 - radius**2)
    depth = np.where(inside > 0, (away - np.sqrt(np.maximum(inside, 0))) / squared, 0).astype(np.float32)
    image = DepthImage(depth, intrinsics(CAMERA))
    T, diameter = pose((0.0, 0.0, away - radius)).astype(np.float32), np.float32(PART.diameter)
    measure = jax.jit(lambda T, image, diameter: measured(predicted(T, SURFELS, image), image, diameter))
    found = measure(T, image, diameter)
    outward = np.asarray(found.points) - (0, 0, away)
    cosines = (outward / radius * np.asarray(found.normals)).sum(axis=-1)
    assert np.asarray(found.has_normal).all()
    assert cosines.min() > 0.99  # 0.966 where they do
