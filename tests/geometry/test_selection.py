"""The number at a place in order, beside a sort; what is largest is tested beside its form for accelerators."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kmn_jax.geometry import smallest_at
from kmn_jax.geometry._selection import smallest_by_bits

_INFINITE = 0x7F80_0000
_BITS = st.integers(0, _INFINITE) | st.sampled_from([0, 1, 0x3F80_0000, _INFINITE])  # of numbers from zero on


@settings(max_examples=60, deadline=None)
@given(st.lists(_BITS, min_size=32, max_size=32), st.integers(0, 31))
def test_the_number_at_a_place_is_that_of_a_sort_bit_by_bit(bits: list[int], place: int) -> None:
    values = np.array(bits, dtype=np.int32).view(np.float32)
    found = np.asarray(jax.jit(smallest_at)(values, np.int32(place)))
    assert found.view(np.int32) == np.sort(values)[place].view(np.int32)


@pytest.mark.parametrize("place", [0, 1023, 2047])
def test_many_numbers_some_of_them_infinite_under_vmap(place: int) -> None:
    values = jnp.abs(jax.random.normal(jax.random.key(0), (3, 2048)))
    values = jnp.where(values > 1.5, jnp.inf, values)
    found = jax.vmap(smallest_by_bits, in_axes=(0, None))(values, jnp.int32(place))
    np.testing.assert_array_equal(found, np.sort(values, axis=1)[:, place])
