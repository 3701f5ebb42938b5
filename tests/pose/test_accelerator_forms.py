"""Searches and refinements of poses as accelerators make them, beside the form for CPUs, both on a CPU."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.synthetic import box_surface, synthetic_matches
from kmn_jax.geometry import random_pose, rotate_vectors, transform_points
from kmn_jax.pose import IcpConfig, Matches, PoseResult, RansacConfig, icp, ransac_modes
from kmn_jax.pose._icp import _icp
from kmn_jax.pose._ransac import _ransac
from tests.reference.devices import accelerator_forms

_DIAMETER = 50.0


def assert_same(found: PoseResult, expected: PoseResult, unit: float) -> None:
    np.testing.assert_array_equal(found.status, expected.status)
    np.testing.assert_array_equal(found.inlier_mask, expected.inlier_mask)
    scale = np.ones(found.T_scene_object.shape)
    scale[..., :3, 3] = unit
    poses = (np.asarray(result.T_scene_object) / scale for result in (found, expected))
    np.testing.assert_allclose(*poses, atol=2e-5)


@pytest.mark.parametrize("use_normals", [True, False])
def test_all_hypotheses_refitted_at_once_end_where_one_mode_after_the_other_does(use_normals: bool) -> None:
    config = RansacConfig(num_hypotheses=200, num_candidates=2000, num_refinements=2, use_normals=use_normals)

    def draw(seed: int) -> Matches:
        return synthetic_matches(jax.random.key(seed), num_matches=300, inlier_share=0.3)[0]

    # Right matches, none that is usable, and all of one keypoint, which determine no pose.
    given = [draw(0), draw(1), draw(2), draw(2)._replace(mask=jnp.zeros(300, dtype=bool))]
    given.append(draw(3)._replace(object_points=jnp.ones((300, 3))))
    matches: Matches = jax.tree.map(lambda *leaves: jnp.stack(leaves), *given)
    keys = jax.random.split(jax.random.key(0), len(given))
    expected = jax.vmap(lambda key, one: ransac_modes(key, one, 3, config))(keys, matches)
    with accelerator_forms() as asked:
        found = jax.jit(jax.vmap(lambda key, one: _ransac.__wrapped__(key, one, config, 3)))(keys, matches)
    assert any("_at_once" in repr(form) for form in asked)
    assert np.asarray(expected.converged[:, 0]).tolist() == [True, True, True, False, False]
    assert_same(found, expected, _DIAMETER)


def test_rounds_that_change_nothing_are_harmless() -> None:
    keys = jax.random.split(jax.random.key(5), 4)
    (model, _), (points, normals) = box_surface(keys[0], 400, _DIAMETER), box_surface(keys[1], 200, _DIAMETER)
    truth = random_pose(keys[2], _DIAMETER)
    scene, scene_normals = transform_points(truth, points), rotate_vectors(truth, normals)
    # Near ones end before the last round, one is far from all points.
    starts = jnp.stack([truth.at[:3, 3].add(shift) for shift in (0.01 * _DIAMETER, 1e-3, 3 * _DIAMETER)])
    config = IcpConfig(iterations=20)
    masks = jnp.ones(400, dtype=bool), jnp.arange(200) % 7 > 0
    expected = jax.vmap(lambda start: icp(model, scene, start, _DIAMETER, scene_normals, *masks, config))(starts)

    def refine(start: jax.Array) -> PoseResult:
        return _icp.__wrapped__(model, scene, start, jnp.float32(_DIAMETER), scene_normals, *masks, None, config)

    with accelerator_forms() as asked:
        found = jax.jit(jax.vmap(refine))(starts)
    assert any("without_asking" in repr(form) for form in asked)
    assert np.asarray(expected.converged).tolist() == [True, True, False]
    assert_same(found, expected, _DIAMETER)
