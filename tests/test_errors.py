from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kmn_jax.errors import InputError, float_array, index_array, mask_array, positive_scalar, rigid_pose, shown


@pytest.mark.parametrize("value", [[[1.0, 2.0]], np.ones((1, 2)), np.ones((1, 2), np.float16), jnp.ones((1, 2))])
def test_what_is_an_array_is_taken(value: object) -> None:
    assert float_array(value, "x", (None, 2)).shape == (1, 2)


@pytest.mark.parametrize("kind", [list, np.int64, np.uint8, jnp.int16])
def test_whole_numbers_are_taken_for_fractions(kind: Any) -> None:
    value = [[1, 200]] if kind is list else np.array([[1, 100]]).astype(kind)
    array = float_array(value, "x", (None, 2))
    assert array.dtype == jnp.float32
    np.testing.assert_array_equal(array, value)
    assert jax.jit(lambda: float_array(value, "x", (None, 2)))().dtype == jnp.float32


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ([[True, False]], "floating point"),
        (np.ones((1, 2), complex), "floating point"),
        ([[1.0, 2.0], [3.0]], "not an array"),
        ("text", "not an array of numbers"),
        (None, "x "),
        (np.ones((1, 3)), r"shape \(1, 3\), but must have shape \(any, 2\)"),
        ([[np.inf, 1.0]], r"1 values .* \(0, 0\)"),
        (np.array([[1e300, 1.0]]), "beyond float32"),
    ],
)
def test_what_is_not_is_refused_in_a_sentence(value: object, message: str) -> None:
    with pytest.raises(InputError, match=message):
        float_array(value, "x", (None, 2))


def test_what_is_quoted_is_one_short_line() -> None:
    assert shown(ValueError("a\n b")) == "a b"
    assert shown("a" * 120) == "a" * 120
    assert shown("a" * 121, 10) == "aaaaaaa..."
    assert shown(InputError("a" * 1000)) == "a" * 1000  # our own sentence


def test_padding_may_hold_anything() -> None:
    rows = np.array([[1.0, 2.0], [np.nan, np.inf]], np.float32)
    assert float_array(rows, "x", (None, 2), mask=jnp.array([True, False])).shape == (2, 2)
    with pytest.raises(InputError, match="2 values"):
        float_array(rows, "x", (None, 2), mask=jnp.array([True, True]))


def test_traced_values_are_checked_by_shape_only() -> None:
    doubled = jax.jit(lambda x: 2 * float_array(x, "x", (None,)))
    assert bool(jnp.isnan(doubled(jnp.array([jnp.nan]))).all())
    with pytest.raises(InputError, match="shape"):
        jax.jit(lambda x: float_array(x, "x", (2,)))(jnp.ones(3))


@pytest.mark.parametrize("transform", [jax.jit, jax.grad])
@pytest.mark.parametrize("kind", [jnp.asarray, np.asarray, list])
def test_constants_inside_a_trace_are_checked_as_outside(
    transform: Callable[..., Any], kind: Callable[..., Any]
) -> None:
    def total(constant: list[float], rows: list[int]) -> jax.Array:
        held, taken = kind(constant), kind(rows)

        def of(x: jax.Array) -> jax.Array:
            mask = mask_array(None, "mask", 2)
            both = float_array(x, "x", (2,), mask=mask) + float_array(held, "constant", (2,), mask=mask)
            return both[index_array(taken, "rows", 2, 2)].sum()

        return transform(of)(jnp.ones(2))

    assert np.isfinite(total([1.0, 2.0], [0, 1])).all()
    with pytest.raises(InputError, match=r"constant holds 1 values"):
        total([1.0, float("nan")], [0, 1])
    with pytest.raises(InputError, match=r"rows holds indices from 0 to 7"):
        total([1.0, 2.0], [0, 7])


def test_masks_indices_and_scalars() -> None:
    assert mask_array(None, "m", 3).tolist() == [True] * 3
    assert index_array([0, 2], "i", None, 3).tolist() == [0, 2]
    assert float(positive_scalar(3, "s")) == 3
    for call in (
        lambda: mask_array([1, 0], "m", 2),
        lambda: mask_array([True], "m", 2),
        lambda: index_array([0, 3], "i", None, 3),
        lambda: index_array([-1], "i", None, 3),
        lambda: positive_scalar(0.0, "s"),
        lambda: positive_scalar(np.nan, "s"),
        lambda: positive_scalar([1.0], "s"),
    ):
        with pytest.raises(InputError):
            call()


@pytest.mark.parametrize("change", ["scale", "mirror", "transposed translation", "nan", "zeros"])
def test_only_rigid_poses_pass(change: str) -> None:
    pose = np.eye(4)
    pose[:3, 3] = [1, 2, 3]
    rigid_pose(pose, "T")
    match change:
        case "scale":
            pose[:3, :3] *= 1.1
        case "mirror":
            pose[0, 0] = -1
        case "transposed translation":
            pose = pose.T
        case "nan":
            pose[0, 3] = np.nan
        case "zeros":
            pose[:] = 0
    with pytest.raises(InputError, match="T "):
        rigid_pose(pose, "T")
