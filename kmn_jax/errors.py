"""Checks at the Python edge: one clear error that names the argument, what is wrong and what to do.

Every public function that takes a user's arrays calls these first. Shapes and dtypes are checked always;
values wherever there are any: a traced array has none (inside jit, failure is data: see PoseResult), but a constant
inside of a trace has.
"""

from __future__ import annotations

import contextlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from kmn_jax.typing import ArrayInput

_STEPS = 200  # across the size of points: with fewer, as float32 has far from the origin, their shape is lost


class InputError(ValueError):
    """The caller's input cannot be used. The message is one sentence for people."""


def shown(value: object, most: int = 120) -> str:
    """Return what a sentence quotes, a damaged file's words or a library's: one line of at most `most` characters.

    An InputError is quoted whole, as it has cut what it quotes.
    """
    if isinstance(value, InputError):
        return str(value)
    text = " ".join(str(value).split())
    return text if len(text) <= most else f"{text[: most - 3]}..."


def require(condition: bool, message: str) -> None:
    """Raise InputError with `message` unless the condition holds; for the checks of configs."""
    if not condition:
        raise InputError(message)


def check_whole(value: object, name: str, low: int, high: int | None = None) -> None:
    """Raise InputError unless `value` is a whole number from `low` to `high`, of Python or of NumPy."""
    whole = int(value) if isinstance(value, int | np.integer) and not isinstance(value, bool) else None
    if whole is None or whole < low or (high is not None and whole > high):
        allowed = f"of {low} or more" if high is None else f"between {low} and {high}"
        raise InputError(f"{name} is {shown(repr(value))}, but must be a whole number {allowed}")


def check_type(value: object, kind: type, name: str) -> None:
    """Raise InputError unless `value` is one of a class."""
    if not isinstance(value, kind):
        raise InputError(f"{name} must be of class {kind.__name__}, not {type(value).__name__}")


def number_list(text: str, name: str, *counts: int) -> list[float]:
    """Return the finite numbers of a text with commas between them, as many as one of `counts`."""
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) not in counts or not np.isfinite(values).all():
        allowed = " or ".join(map(str, counts))
        raise InputError(f"{name} is {text!r}, but must be {allowed} numbers with commas between them")
    return values


def finite_numbers(value: object, name: str, count: int) -> np.ndarray:
    """Return so many finite numbers that a file of JSON holds, in double precision, or raise InputError."""
    try:
        numbers = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        numbers = np.zeros(0)
    if numbers.shape != (count,) or not np.isfinite(numbers).all():
        raise InputError(f"{name} must be {count} finite numbers")
    return numbers


def known_fields(value: object, name: str, known: set[str]) -> dict[str, Any]:
    """Return an object of JSON, or raise InputError if it is none or has a field that is not known."""
    if not isinstance(value, dict):
        raise InputError(f"{name} must be an object with {', '.join(sorted(known))}")
    unknown = sorted(value.keys() - known)
    if unknown:
        raise InputError(
            f"{name} has {shown(repr(unknown[0]))}, which is not known: it may have {', '.join(sorted(known))}"
        )
    return value


def is_traced(value: object) -> bool:
    """Tell whether `value` is an abstract value inside jit, vmap or grad."""
    return isinstance(value, jax.core.Tracer)


def float_array(
    value: ArrayInput,
    name: str,
    shape: tuple[int | None, ...],
    *,
    mask: jax.Array | None = None,
    finite: bool = True,
) -> jax.Array:
    """Return `value` as a floating JAX array of `shape` (None = any length), or raise InputError.

    Rows where `mask` is false are padding and may hold anything; `finite` false allows infinity and NaN
    everywhere. Whole numbers are taken as such; they and float64 become the default float type.
    """
    array = _array(_as_fractions(value, name), name, shape)
    if not jnp.issubdtype(array.dtype, jnp.floating):
        raise InputError(
            f"{name} has dtype {array.dtype}, but must be floating point or whole numbers: convert it to float32"
        )
    if finite and not is_traced(array) and not is_traced(mask) and not _is_finite(array, mask):
        good = np.isfinite(np.asarray(array, dtype=np.float32))
        if mask is not None:
            good = good | ~np.asarray(mask).reshape(mask.shape + (1,) * (good.ndim - mask.ndim))
        row = np.argwhere(~good)[0]
        raise InputError(
            f"{name} holds {int((~good).sum())} values that are NaN, infinite or beyond float32,"
            f" the first at index {tuple(int(i) for i in row)}: remove such points first"
        )
    return array


def point_array(
    value: ArrayInput, name: str, count: int | None = None, *, mask: jax.Array | None = None, size: ArrayInput = 0.0
) -> jax.Array:
    """Return points (count, 3) as `float_array` does; too far from the origin for float32, they raise InputError.

    `size` is what they may be a small part of, or what float32 may have made one place of.
    """
    array = float_array(value, name, (count, 3), mask=mask)
    if not any(map(is_traced, (array, mask, size))):
        points = np.asarray(value, dtype=np.float64)
        check_digits(points if mask is None else points[np.asarray(mask)], name, float(size))
    return array


def extent(points: np.ndarray) -> float:
    """Return the diagonal of the axis-aligned box around points (n, 3) on the host, 0 of none."""
    return float(np.linalg.norm(np.ptp(points, axis=0))) if len(points) else 0.0


def check_digits(points: np.ndarray, name: str, size: float = 0.0) -> None:
    """Raise InputError if points (n, 3) lie so far from the origin that float32 does not hold their shape.

    It is that of something of `size`, or of the points themselves if they are larger.
    """
    farthest, size = float(np.abs(points).max(initial=0)), max(size, extent(points))
    if is_coarse(farthest, size):
        raise InputError(
            f"{name} lies {farthest:.3g} from the origin, but is only {size:.3g} large, and float32 has not enough"
            " digits for both: take its coordinates, and poses, relative to a place near to it"
        )


def is_coarse(farthest: float, size: float) -> bool:
    """Tell whether float32, so far from the origin, does not hold the shape of what is of this size, if it has any."""
    return size > 0 and float(np.spacing(np.float32(farthest))) > size / _STEPS


def check_shape(value: ArrayInput, name: str, shape: tuple[int | None, ...]) -> None:
    """Raise InputError unless `value` is an array of `shape` (None = any length); nothing is asked of its values."""
    own = getattr(value, "shape", None)
    if own is None:
        raise InputError(f"{name} is a {type(value).__name__}, but must be an array of shape {_shape_text(shape)}")
    if len(own) != len(shape) or any(want not in (None, have) for want, have in zip(shape, own, strict=True)):
        raise InputError(f"{name} has shape {own}, but must have shape {_shape_text(shape)}")


def row_count(value: ArrayInput, name: str) -> int:
    """Return the length of the first axis, 0 for a scalar."""
    if not hasattr(value, "shape"):
        value = _numbers(value, name)
    return value.shape[0] if value.shape else 0


def mask_array(value: ArrayInput | None, name: str, length: int) -> jax.Array:
    """Return a boolean mask of `length`; None means that every row is real."""
    if value is None:
        with jax.ensure_compile_time_eval():
            return jnp.ones(length, dtype=bool)
    array = _array(value, name, (length,))
    if not length:  # an empty list has the dtype of numbers
        return array.astype(bool)
    if array.dtype != jnp.bool_:
        raise InputError(f"{name} has dtype {array.dtype}, but must be bool (true = real, false = padding)")
    return array


def index_array(value: ArrayInput, name: str, length: int | None, upper: int) -> jax.Array:
    """Return an integer index array with entries in [0, upper)."""
    array = _array(value, name, (length,))
    if not jnp.issubdtype(array.dtype, jnp.integer):
        raise InputError(f"{name} has dtype {array.dtype}, but must hold integers")
    if not is_traced(array) and array.size:
        values = np.asarray(array)
        low, high = int(values.min()), int(values.max())
        if low < 0 or high >= upper:
            raise InputError(f"{name} holds indices from {low} to {high}, outside of [0, {upper})")
    return array


def positive_scalar(value: ArrayInput, name: str) -> jax.Array:
    """Return a finite float scalar above zero."""
    array = float_array(value, name, ())
    if not is_traced(array) and not float(array) > 0:
        raise InputError(f"{name} is {float(array):g}, but must be above zero")
    return array


def rigid_pose(value: ArrayInput, name: str) -> jax.Array:
    """Return a (4, 4) matrix of a proper rotation and a translation, to the digits that pose files carry."""
    array = float_array(value, name, (4, 4))
    if not is_traced(array):
        matrix = np.asarray(array, dtype=np.float64)
        rotation, last_row = matrix[:3, :3], matrix[3]
        orthogonal = np.allclose(rotation.T @ rotation, np.eye(3), atol=5e-3) and np.linalg.det(rotation) > 0
        if not orthogonal or not np.allclose(last_row, [0, 0, 0, 1], atol=1e-6):
            raise InputError(
                f"{name} is not a rigid pose: it needs a rotation without scale or reflection and a last row 0 0 0 1"
            )
    return array


def _is_finite(array: jax.Array, mask: jax.Array | None) -> bool:
    with jax.ensure_compile_time_eval():
        return bool(_all_finite(array, mask))


@jax.jit
def _all_finite(array: jax.Array, mask: jax.Array | None) -> jax.Array:
    finite = jnp.isfinite(array)
    if mask is not None:
        finite = finite | ~mask.reshape(mask.shape + (1,) * (finite.ndim - mask.ndim))
    return finite.all()


def _array(value: ArrayInput, name: str, shape: tuple[int | None, ...]) -> jax.Array:
    # What does not fit float32 becomes infinite, which is reported as such.
    with jax.ensure_compile_time_eval(), np.errstate(over="ignore"):
        array = value if isinstance(value, jax.Array) else jnp.asarray(_numbers(value, name))
    check_shape(array, name, shape)
    return array


def _shape_text(shape: tuple[int | None, ...]) -> str:
    return f"({', '.join('any' if want is None else str(want) for want in shape)})"


def _as_fractions(value: ArrayInput, name: str) -> ArrayInput:
    """Return whole numbers as fractions, those of the host in double precision."""
    if isinstance(value, jax.Array):
        with contextlib.nullcontext() if is_traced(value) else jax.ensure_compile_time_eval():
            return value.astype(float) if jnp.issubdtype(value.dtype, jnp.integer) else value
    array = _numbers(value, name)
    return array.astype(np.float64) if array.dtype.kind in "iu" else array


def _numbers(value: ArrayInput, name: str) -> np.ndarray:
    try:
        array = np.asarray(value)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name} is not an array: {error}") from None
    if array.dtype.kind not in "biufc" and not jnp.issubdtype(array.dtype, jnp.floating):
        raise InputError(f"{name} is not an array of numbers, but holds {array.dtype} values")
    return array
