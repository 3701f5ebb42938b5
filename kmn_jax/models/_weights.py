"""Our own model files: safetensors with our parameter names, the config as JSON in the header."""

from __future__ import annotations

import json
from pathlib import Path

import jax
import numpy as np
from flax import nnx
from safetensors import SafetensorError, safe_open

from kmn_jax.errors import InputError, shown
from kmn_jax.files import read_safetensors, safetensors_bytes, write_whole
from kmn_jax.limits import parse_json
from kmn_jax.models._config import KeyMatchNetConfig
from kmn_jax.models._keymatchnet import Model, model_structure
from kmn_jax.released import RELEASED

PRETRAINED = Path(__file__).parent.parent / "pretrained"  # released models, and what belongs to them
_CONFIG_KEY = "kmn_jax.config"


def save_model(model: tuple[nnx.GraphDef, nnx.State], path: str | Path) -> None:
    """Write parameters and config to a .safetensors file."""
    config = json.dumps(Model(*model).config.told())
    write_whole(path, parameters_bytes(model[1], {_CONFIG_KEY: config}))


def parameters_bytes(parameters: nnx.State, metadata: dict[str, str]) -> bytes:
    """Return the content of a .safetensors file of parameters."""
    tensors = {
        ".".join(map(str, path)): np.ascontiguousarray(value[...]) for path, value in nnx.to_flat_state(parameters)
    }
    return safetensors_bytes(tensors, metadata)


def is_model_file(path: str | Path) -> bool:
    """Tell whether the file is one of ours (rather than published weights in safetensors form)."""
    try:
        with safe_open(str(path), "np") as file:
            return _CONFIG_KEY in (file.metadata() or {})
    except (SafetensorError, OSError):
        return False


def released_file(name: str = RELEASED) -> Path:
    """Return the file of a released model, one of those in `kmn_jax/pretrained/`.

    Raises InputError if there is none of that name.
    """
    path = PRETRAINED / f"{name}.safetensors"
    if not path.is_file():
        names = ", ".join(sorted(file.stem for file in PRETRAINED.glob("*.safetensors"))) or "none"
        own = "; of a run's folder, name its model.safetensors" if Path(name).is_dir() else ""
        raise InputError(f"there is no released model {name!r}: there are {names}{own}")
    return path


def load_pretrained(name: str = RELEASED) -> Model:
    """Load a released model; a card beside its file tells what it can do. Raises InputError if there is none."""
    return load_model(released_file(name))


def load_model(path: str | Path) -> Model:
    """Load a model that `save_model` wrote.

    Raises:
        InputError: missing or damaged file, not one of ours, or a config that this version does not know.
    """
    tensors, metadata = read_safetensors(path)
    if _CONFIG_KEY not in metadata:
        raise InputError(f"{path} carries no kmn_jax config: if it holds published weights, use load_released")
    try:
        config = KeyMatchNetConfig(**parse_json(metadata[_CONFIG_KEY]))
    except (TypeError, ValueError) as error:
        raise InputError(f"{path} has a config that this version of kmn_jax cannot use: {shown(error)}") from None
    graphdef, parameters = model_structure(config)
    return Model(graphdef, parameters_of(path, tensors, parameters))


def parameters_of(path: str | Path, tensors: dict[str, np.ndarray], shapes: nnx.State) -> nnx.State:
    """Return the tensors of a file as the parameters of a network, given with `shapes` in their place.

    Raises InputError for missing, unknown or misshapen ones, and for values that are not finite.
    """
    flat = dict(nnx.to_flat_state(shapes))
    wanted = {".".join(map(str, target)): target for target in flat}
    problems = [f"{name} is missing" for name in wanted if name not in tensors]
    problems += [f"{shown(name)} is unknown" for name in tensors if name not in wanted]
    problems += [
        f"{name} has shape {tensors[name].shape}, but the network needs {flat[target].shape}"
        for name, target in wanted.items()
        if name in tensors and tensors[name].shape != flat[target].shape
    ]
    problems += [
        f"{name} has values that are not finite numbers"
        for name in wanted
        if name in tensors and not _are_finite(tensors[name])
    ]
    if problems:
        raise InputError(f"{path} does not fit the network: {'; '.join(problems[:8])}")
    return nnx.from_flat_state({t: flat[t].replace(jax.device_put(tensors[name])) for name, t in wanted.items()})


def _are_finite(values: np.ndarray) -> bool:
    """Tell whether values are finite fractions, also in single precision, which all that is wider becomes."""
    with np.errstate(over="ignore"):
        return values.dtype.kind in "fV" and bool(np.isfinite(values.astype(np.float32)).all())
