"""Forms of a computation: programs hold that of their devices, what is exported for any holds all."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import export

from kmn_jax.platforms import by_platform, for_any_platform


@jax.jit
def told(x: jax.Array) -> jax.Array:
    return by_platform(x, cpu=lambda x: x + 1, default=lambda x: x * 100)


def test_a_program_holds_the_form_of_its_devices_alone() -> None:
    assert told(jnp.float32(2)) == 3
    program = str(jax.make_jaxpr(told)(jnp.float32(2)))
    assert "add" in program
    assert "mul" not in program


def test_what_is_for_any_platform_holds_both_also_if_it_was_traced_before() -> None:
    told(jnp.float32(2))
    with for_any_platform():
        assert told(jnp.float32(2)) == 3
        exported = export.export(told, platforms=("cpu", "cuda"))(jnp.float32(2))
    text = exported.mlir_module()
    assert "stablehlo.add" in text
    assert "stablehlo.multiply" in text
    assert "stablehlo.multiply" not in export.export(told)(jnp.float32(2)).mlir_module()
