"""The two ways to see a scene, exact bits and splatting, on settled bins of the pack that the repository carries."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float, Int

from kmn_jax.data import CropConfig, DevicePack, Pack, PackConfig, draw_crop, stack_pack, take_scene, visible_points
from kmn_jax.data._pack import quantised
from kmn_jax.data._recipe import pack_object
from kmn_jax.objects import ObjectConfig, load_object
from kmn_jax.simulate import RayMesh, SplatConfig, pack_bits, visible_surfels

ASSETS = Path(__file__).parents[2] / "experiments" / "assets"


@jax.jit
def compare(arrays: DevicePack, row: Int[Array, ""], drop: Int[Array, ""]) -> Int[Array, " 4"]:
    """Return how many surfels splatting sees wrongly, sees, misses, and how many are visible."""
    scene = take_scene(arrays, row, drop)
    count = scene.copies.shape[0] * scene.surfels.points.shape[0]
    exact, splatted = visible_points(scene).mask[:count], visible_points(scene, SplatConfig()).mask[:count]
    return jnp.stack([(splatted & ~exact).sum(), splatted.sum(), (exact & ~splatted).sum(), exact.sum()])


def test_splatting_agrees_with_ray_casting_on_60_scenes(record_property: pytest.RecordProperty) -> None:
    stacked = stack_pack(Pack(ASSETS / "small_pack"), Pack(ASSETS / "small_pack").names())
    arrays = jax.device_put(stacked.arrays)
    rows = [
        compare(arrays, jnp.int32(row), jnp.int32(drop))
        for row in range(len(stacked.names))
        for drop in range(int(stacked.arrays.num_drops[row]))
    ]
    assert len(rows) == 60
    false, splatted, missed, exact = np.sum(np.array(rows), axis=0)
    record_property("false among the visible", f"{false / splatted:.2%}")
    record_property("visible but missed", f"{missed / exact:.2%}")
    assert false / splatted < 0.03
    assert missed / exact < 0.10


def test_bits_of_a_pack_are_those_of_rays_to_what_is_read_back() -> None:
    """An industrial part goes the whole way, and its bits equal rays cast to the surfels and poses as stored."""
    path = ASSETS / "industrial" / "belt_pulley.stl"
    config = PackConfig(surfels=256, bin_surfels=64, drops=2, copies=(3, 8))
    item, facts = pack_object(path, "belt_pulley", "test", config)
    assert max(facts["penetrations"]) < 0.003
    stored = quantised(item)
    model = load_object(path, config=ObjectConfig(num_points=256)).in_unit("m")
    rays = RayMesh(model.vertices, model.triangles)
    for drop, exact in zip(item.drops, stored.drops, strict=True):
        seen = visible_surfels(rays, exact.scene, stored.points, stored.normals)
        assert 0.1 < seen.mean() < 0.6
        np.testing.assert_array_equal(pack_bits(seen), drop.bits)


@partial(jax.jit, static_argnames="config")
def shares(
    arrays: DevicePack, row: Int[Array, ""], drop: Int[Array, ""], key: jax.Array, config: CropConfig
) -> Float[Array, " 2"]:
    """Return the seed's copy's share of the picture within the crop's radius, and of the crop's points."""
    scene = take_scene(arrays, row, drop)
    visible = visible_points(scene)
    keypoints = scene.surfels.points[:20]
    crop = draw_crop(key, visible, keypoints, scene.T_camera_object, scene.diameter, config)
    near = ((visible.points - crop.seed[None]) ** 2).sum(axis=1) <= scene.diameter**2
    area = jnp.where(visible.mask & near, visible.picture_area, 0)
    copy = jnp.where(visible.instance == crop.instance, area, 0)
    return jnp.stack([copy.sum() / area.sum(), crop.is_object.sum() / crop.mask.sum()])


def test_background_is_as_dense_in_a_crop_as_in_a_picture() -> None:
    """Even with two copies in a bin, whose floor then fills most of a crop of 2048 points."""
    pack = Pack(ASSETS / "small_pack")
    arrays = jax.device_put(stack_pack(pack, "train").arrays)
    config = CropConfig(num_points=2048, max_noise=0.0, normals="surface")
    found = [
        shares(arrays, jnp.int32(row), jnp.int32(0), jax.random.key(key), config)
        for row in range(4)
        for key in range(4)
    ]
    in_picture, in_crop = np.mean(np.array(found), axis=0)
    assert 0.1 < in_picture < 0.3
    np.testing.assert_allclose(in_crop, in_picture, rtol=0.2)
