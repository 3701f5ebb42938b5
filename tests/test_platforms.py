"""Forms of a computation: programs hold that of their devices, what is exported for any holds all."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import pytest
from jax import export

from kmn_jax import platforms
from kmn_jax.platforms import by_platform, for_any_platform, own_form


@jax.jit
def told(x: jax.Array) -> jax.Array:
    return by_platform(x, cpu=lambda x: x + 1, default=lambda x: x * 100)


def test_a_program_holds_the_form_of_its_devices_alone() -> None:
    own, other = own_form(lambda: ("add", "mul"), lambda: ("mul", "add"))()
    program = str(jax.make_jaxpr(told)(jnp.float32(2)))
    assert f"= {own}" in program
    assert f"= {other}" not in program


def test_what_is_for_any_platform_holds_both_also_if_it_was_traced_before() -> None:
    here = told(jnp.float32(2))
    with for_any_platform():
        assert told(jnp.float32(2)) == here
        text = export.export(told, platforms=("cpu", "cuda"))(jnp.float32(2)).mlir_module()
    assert "stablehlo.add" in text
    assert "stablehlo.multiply" in text
    alone = export.export(told)(jnp.float32(2)).mlir_module()
    assert ("stablehlo.add" in alone) != ("stablehlo.multiply" in alone)


def test_beside_an_accelerator_the_host_is_given_its_own_form(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(platforms.jax, "default_backend", lambda: "gpu")

    def times(x: jax.Array) -> jax.Array:
        return by_platform(x, cpu=lambda x: x + 1, default=lambda x: x * 100)

    again = jax.jit(times)
    assert again(jnp.float32(2)) == 200
    with jax.default_device(jax.devices("cpu")[0]):
        assert again(jnp.float32(2)) == 3
    with jax.default_device("cpu"):
        assert again(jnp.float32(2)) == 3
    assert again(jnp.float32(2)) == 200
