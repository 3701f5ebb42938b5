"""The `kmn` command: each subcommand is one function whose signature is its list of flags."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import tyro

from kmn_jax.checks import InputError


def convert(
    source: Annotated[Path, tyro.conf.Positional],
    target: Annotated[Path, tyro.conf.Positional],
    released_names: bool = False,
) -> None:
    """Convert weights between the authors' checkpoints and kmn_jax models.

    Args:
        source: authors' state dict (.t7, .pt, .pth, .safetensors) or a kmn_jax model (.safetensors).
        target: .safetensors for a kmn_jax model; .t7, .pt or .pth for the authors' form.
        released_names: write the authors' names into a .safetensors target too.
    """
    from kmn_jax.models import load_model, load_released, save_model, save_released
    from kmn_jax.models.weights import is_model_file

    model = load_model(source) if is_model_file(source) else load_released(source)
    if target.suffix == ".safetensors" and not released_names:
        save_model(model, target)
    else:
        save_released(model, target)
    print(f"wrote {target}")


def main(arguments: list[str] | None = None) -> int:
    """Run the command line: 0 is success, 2 bad input (one sentence on stderr), 1 our own failure."""
    try:
        tyro.extras.subcommand_cli_from_dict({"convert": convert}, prog="kmn", args=arguments)
    except InputError as error:
        print(f"kmn: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
