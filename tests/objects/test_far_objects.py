"""Objects whose files place them far from the origin are those near to it, moved."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest

from kmn_jax.bop import write_models
from kmn_jax.errors import InputError
from kmn_jax.models import create_model
from kmn_jax.objects import ObjectConfig, load_part, make_part, object_from_cloud, object_from_mesh, save_part
from tests.reference.meshes import box, surface_points
from tests.reference.networks import TINY

CONFIG = ObjectConfig(num_points=128)
VERTICES, TRIANGLES = box(60, 40, 20)
UTM = np.array([5e5, 5.4e6, 300.0])


@pytest.mark.parametrize("offset", [np.array([1e6, 0, 0]), np.array([-1e9, 1e9, 1e9])])
def test_a_moved_mesh_is_the_same_object(offset: np.ndarray) -> None:
    near = object_from_mesh("box", VERTICES, TRIANGLES, "mm", CONFIG)
    far = object_from_mesh("box", VERTICES + offset, TRIANGLES, "mm", CONFIG)
    assert near.points.dtype == np.float32
    assert not near.origin.any()
    np.testing.assert_allclose(far.points - offset, near.points, atol=1e-5)
    np.testing.assert_allclose(far.centred().points + far.origin - offset, near.points, atol=1e-5)
    np.testing.assert_array_equal(far.normals, near.normals)
    np.testing.assert_allclose(far.minimum - offset, near.minimum, atol=1e-5)
    np.testing.assert_allclose(far.symmetries.center - offset, near.symmetries.center, atol=1e-4)
    assert len(far.symmetries.rotations) == len(near.symmetries.rotations) == 4
    assert far.diameter == pytest.approx(near.diameter, abs=1e-5)
    np.testing.assert_allclose(far.in_unit("m").points * 1000 - offset, near.points, atol=1e-5)
    with pytest.raises(InputError, match="too far for float32"):
        far.near()


def test_a_cloud_of_a_map_needs_no_normals() -> None:
    points, _ = surface_points(box(0.6, 0.4, 0.2), 300)
    near, far = (object_from_cloud("box", points + offset, None, "m", CONFIG) for offset in (0 * UTM, UTM))
    np.testing.assert_allclose(far.points - UTM, near.points, atol=1e-6)
    np.testing.assert_allclose(far.normals, near.normals, atol=1e-4)
    assert far.diameter == pytest.approx(near.diameter)


@pytest.mark.parametrize("offset", [1e12, 1e300])
def test_what_floats_cannot_hold_is_one_sentence(offset: float) -> None:
    for make in (
        lambda: object_from_mesh("box", VERTICES + offset, TRIANGLES, "mm", CONFIG),
        lambda: object_from_cloud("box", VERTICES + offset, None, "mm", CONFIG),
    ):
        with pytest.raises(InputError, match=r"not enough digits|beyond 1e\+18") as found:
            make()
        assert "\n" not in str(found.value)


def test_a_card_carries_a_far_object(tmp_path: Path) -> None:
    offset = np.array([0, 1e9, 0])
    model = create_model(replace(TINY, num_object_points=128, num_keypoints=8), jax.random.key(0))
    near, far = (
        make_part(object_from_mesh("box", VERTICES + place, TRIANGLES, "mm", CONFIG), model)
        for place in (0 * offset, offset)
    )
    np.testing.assert_allclose(far.features, near.features, atol=1e-4)
    save_part(far, tmp_path / "far.kmn")
    save_part(near, tmp_path / "near.kmn")
    back = load_part(tmp_path / "far.kmn")
    np.testing.assert_array_equal(back.points, far.points)
    np.testing.assert_allclose(back.centred().points, near.points, atol=1e-5)
    np.testing.assert_allclose(back.in_unit("m").centred().points * 1000, near.points, atol=1e-4)
    assert load_part(tmp_path / "near.kmn").points.dtype == np.float32


def test_formats_of_float32_refuse_far_objects(tmp_path: Path) -> None:
    far = object_from_mesh("box", VERTICES + 1e6, TRIANGLES, "mm", CONFIG)
    with pytest.raises(InputError, match="too far for float32"):
        write_models(tmp_path, {1: far})
    assert not (tmp_path / "models").exists()
