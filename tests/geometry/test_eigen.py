"""The elementwise eigenvector against LAPACK in float64."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kmn_jax.geometry import dominant_eigenvector

batched = jax.jit(jax.vmap(dominant_eigenvector))


def with_eigenvalues(seed: int, values: list[float], count: int = 20) -> np.ndarray:
    """Return random symmetric matrices (float32) with these eigenvalues."""
    rng = np.random.default_rng(seed)
    bases = np.linalg.qr(rng.normal(size=(count, len(values), len(values))))[0]
    matrices = bases @ np.diag(values) @ bases.swapaxes(1, 2)
    return ((matrices + matrices.swapaxes(1, 2)) / 2).astype(np.float32)


def rayleigh_quotients(matrices: np.ndarray, vectors: jax.Array) -> np.ndarray:
    vectors = np.asarray(vectors, dtype=np.float64)
    return np.einsum("ni,nij,nj->n", vectors, matrices.astype(np.float64), vectors)


@pytest.mark.parametrize("size", [2, 3, 4])
@pytest.mark.parametrize("seed", range(3))
def test_it_is_the_eigenvector_of_the_largest_eigenvalue(seed: int, size: int) -> None:
    factors = np.random.default_rng(seed).normal(size=(50, size, size)).astype(np.float32)
    matrices = factors @ factors.swapaxes(1, 2)
    values, expected = np.linalg.eigh(matrices.astype(np.float64))
    found = np.asarray(batched(matrices))
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-6)
    cosines = np.abs((found * expected[..., -1]).sum(-1))
    # The direction is as uncertain as rounding over the gap to the next eigenvalue.
    gaps = (values[:, -1] - values[:, -2]) / values[:, -1]
    assert (np.sqrt(np.maximum(1 - cosines**2, 0)) < 1e-5 / gaps + 1e-3).all()
    np.testing.assert_allclose(rayleigh_quotients(matrices, found), values[:, -1], rtol=1e-5)


@pytest.mark.parametrize(
    "values", [[2.0, 2, 1], [1.0, 1, 1], [1.0, 0, 0], [1.0, 1 - 1e-6, 0], [3.0, 3, 3, 0], [1.0, 0, 0, 0]]
)
def test_repeated_and_zero_eigenvalues_give_a_unit_vector_of_the_dominant_space(values: list[float]) -> None:
    matrices = with_eigenvalues(0, values)
    found = batched(matrices)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-6)
    np.testing.assert_allclose(rayleigh_quotients(matrices, found), max(values), rtol=1e-5)


def test_the_zero_matrix_gives_the_first_unit_vector() -> None:
    np.testing.assert_array_equal(dominant_eigenvector(jnp.zeros((4, 4))), [1, 0, 0, 0])


@pytest.mark.parametrize("scale", [1e-12, 1e12])
def test_scale_plays_no_part(scale: float) -> None:
    matrices = with_eigenvalues(1, [3.0, 2, 1])
    cosines = (np.asarray(batched(matrices * np.float32(scale))) * np.asarray(batched(matrices))).sum(-1)
    np.testing.assert_allclose(np.abs(cosines), 1, atol=1e-6)


def test_vmap_equals_a_loop() -> None:
    matrices = with_eigenvalues(2, [3.0, 2, 1], count=4)
    alone = [dominant_eigenvector(jnp.asarray(matrix)) for matrix in matrices]
    np.testing.assert_allclose(batched(matrices), alone, atol=1e-6)
