"""Searches and refinements of poses as accelerators make them, beside the form for CPUs, both on a CPU."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.synthetic import synthetic_matches
from kmn_jax.pose import IcpConfig, Matches, PoseResult, RansacConfig, icp, ransac_modes
from kmn_jax.pose._icp import _icp
from kmn_jax.pose._ransac import _ransac
from tests.reference.clouds import box_cloud
from tests.reference.devices import accelerator_forms
from tests.reference.poses import some_poses

_DIAMETER = 50.0


@jax.jit
def _draw(seed: int) -> Matches:
    return synthetic_matches(jax.random.key(seed), num_matches=300, inlier_share=0.3)[0]


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

    # Right matches, none that is usable, and all of one keypoint, which determine no pose.
    given = [_draw(0), _draw(1), _draw(2), _draw(2)._replace(mask=np.zeros(300, dtype=bool))]
    given.append(_draw(3)._replace(object_points=np.ones((300, 3), np.float32)))
    matches: Matches = jax.tree.map(lambda *leaves: np.stack(leaves), *given)
    keys = jax.random.split(jax.random.key(0), len(given))
    expected = jax.vmap(lambda key, one: ransac_modes(key, one, 3, config))(keys, matches)
    with accelerator_forms() as asked:
        found = jax.jit(jax.vmap(lambda key, one: _ransac.__wrapped__(key, one, config, 3)))(keys, matches)
    assert any("_at_once" in repr(form) for form in asked)
    assert np.asarray(expected.converged)[:, 0].tolist() == [True, True, True, False, False]
    assert_same(found, expected, _DIAMETER)


def test_rounds_that_change_nothing_are_harmless() -> None:
    model, surface = jnp.asarray(box_cloud(0, 400)[:, :3]), box_cloud(1, 200)
    truth = some_poses(1, 5)[0]
    scene = jnp.asarray(surface[:, :3] @ truth[:3, :3].T + truth[:3, 3], jnp.float32)
    scene_normals = jnp.asarray(surface[:, 3:] @ truth[:3, :3].T, jnp.float32)
    # Near ones end before the last round, one is far from all points.
    starts = np.tile(truth.astype(np.float32), (3, 1, 1))
    starts[:, :3, 3] += np.float32([[0.01 * _DIAMETER], [1e-3], [3 * _DIAMETER]])
    config = IcpConfig(iterations=20)
    masks = jnp.ones(400, dtype=bool), jnp.asarray(np.arange(200) % 7 > 0)
    expected = jax.vmap(lambda start: icp(model, scene, start, _DIAMETER, scene_normals, *masks, config))(starts)

    def refine(start: jax.Array) -> PoseResult:
        return _icp.__wrapped__(model, scene, start, jnp.float32(_DIAMETER), scene_normals, *masks, None, config)

    with accelerator_forms() as asked:
        found = jax.jit(jax.vmap(refine))(starts)
    assert any("without_asking" in repr(form) for form in asked)
    assert np.asarray(expected.converged).tolist() == [True, True, False]
    assert_same(found, expected, _DIAMETER)
