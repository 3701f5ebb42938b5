"""The authors' checkpoints (torch state dicts of the published network) to our parameters, and back."""

from __future__ import annotations

from pathlib import Path

import jax.numpy as jnp
import numpy as np
from flax import nnx
from safetensors.numpy import save

from kmn_jax.errors import InputError
from kmn_jax.files import read_safetensors, write_whole
from kmn_jax.models._config import KeyMatchNetConfig
from kmn_jax.models._keymatchnet import Model, model_structure
from kmn_jax.models._torch_file import read_state_dict, state_dict_bytes

RELEASED_CONFIG = KeyMatchNetConfig(normalization="released", pair_dropout="per_pair")

TORCH_SUFFIXES = (".t7", ".pt", ".pth")

_ENCODER_LAYERS = {
    1: "edge1.first",
    2: "edge1.second",
    3: "edge2.first",
    4: "edge2.second",
    5: "edge3.first",
    6: "embedding",
    7: "out",
}
_LAYERS = {
    **{f"conv_obj{i}": f"object.{name}" for i, name in _ENCODER_LAYERS.items()},
    "conv_obj8": "object_out",
    **{f"conv{i}": f"scene.{name}" for i, name in _ENCODER_LAYERS.items()},
    "conv8": "head.scene_pair",
    "conv8r": "head.context_pair",
}
_OUTPUTS = {"conv9": "head.segmentation", "conv10": "head.keypoint"}
_LAYERS_ON_LISTS = ("conv6", "conv7", "conv_obj6", "conv_obj7", "conv_obj8", "conv9")  # Conv1d, all others Conv2d


def load_released(path: str | Path, config: KeyMatchNetConfig = RELEASED_CONFIG) -> Model:
    """Load published weights as the pair (graphdef, parameters).

    Args:
        path: the authors' state dict: .t7, .pt or .pth (torch's zip format) or .safetensors with the same
            names. No code of the file is run.
        config: the sizes that the weights belong to; the published ones unless the authors' code was changed.

    Raises:
        InputError: unreadable file, missing or unknown names, shapes other than the config's, non-finite values.
    """
    stored = _read(Path(path))
    tensors = {name.removeprefix("module."): tensor for name, tensor in stored.items()}
    if len(tensors) < len(stored):
        raise InputError(f"{path} holds some names both with and without the prefix module.: keep one of the two")
    graphdef, parameters = model_structure(config)
    flat = dict(nnx.to_flat_state(parameters))
    names = _released_names()
    problems = [f"{name} is missing" for name in names if name not in tensors]
    problems += [f"{name} is unknown" for name in tensors if name not in names]
    for name, target in names.items():
        if name not in tensors:
            continue
        wanted = flat[target].shape
        value = np.asarray(tensors[name], dtype=np.float32)
        if target[-1] not in ("norm_scale", "norm_bias"):
            flat_shape = value.shape[:2] if value.ndim >= 2 and set(value.shape[2:]) <= {1} else value.shape
            value = value.reshape(flat_shape).T
        if value.shape != wanted:
            needed = (*wanted[::-1], *(1,) * _trailing(name)) if value.ndim > 1 else wanted
            problems.append(f"{name} has shape {tensors[name].shape}, but the network needs {needed}")
        elif not np.isfinite(value).all():
            problems.append(f"{name} holds NaN or infinite values")
        else:
            flat[target] = flat[target].replace(jnp.asarray(value))
    if problems:
        more = f" and {len(problems) - 8} more" if len(problems) > 8 else ""
        raise InputError(f"{path} does not hold the published network: {'; '.join(problems[:8])}{more}")
    return Model(graphdef, nnx.from_flat_state(flat))


def save_released(model: tuple[nnx.GraphDef, nnx.State], path: str | Path) -> None:
    """Write a model of the published structure under the authors' names.

    Args:
        model: the pair (graphdef, parameters); what the authors' file does not store (input scaling, graph,
            neighbours, groups) must be as their code has it.
        path: .t7, .pt or .pth for a file that `torch.load` reads, .safetensors for that format.

    Raises:
        InputError: a structure that the authors' code does not have, or an unknown suffix.
    """
    suffix = Path(path).suffix
    if suffix not in (*TORCH_SUFFIXES, ".safetensors"):
        raise InputError(f"{path} has no known suffix: use one of {', '.join(TORCH_SUFFIXES)} or .safetensors")
    config = Model(*model).config
    same = ("normalization", "inputs", "graph", "object_branch", "num_neighbors", "groups", "num_coarse_points")
    other = [name for name in same if getattr(config, name) != getattr(RELEASED_CONFIG, name)]
    if other:
        switches = ", ".join(f"{name} = {getattr(config, name)}" for name in other)
        raise InputError(f"the authors' code would compute something else from this model, which has {switches}")
    flat = {path: np.asarray(value[...]) for path, value in nnx.to_flat_state(model[1])}
    tensors = {}
    for name, target in _released_names().items():
        value = flat[target]
        if value.ndim == 2:
            value = value.T.reshape(*value.shape[::-1], *(1,) * _trailing(name))
        tensors[name] = np.ascontiguousarray(value, dtype=np.float32)
    if suffix == ".safetensors":
        write_whole(path, save(tensors))
    else:
        write_whole(path, state_dict_bytes(tensors))


def _trailing(name: str) -> int:
    """Return how many axes of length one a weight of the authors' has after its two of channels."""
    return 1 if name.split(".")[0] in _LAYERS_ON_LISTS else 2


def _released_names() -> dict[str, tuple[str, ...]]:
    names = {}
    for released, ours in _LAYERS.items():
        for suffix, leaf in ((".0.weight", "kernel"), (".1.weight", "norm_scale"), (".1.bias", "norm_bias")):
            names[released + suffix] = (*ours.split("."), leaf)
    return names | {f"{released}.0.weight": tuple(ours.split(".")) for released, ours in _OUTPUTS.items()}


def _read(path: Path) -> dict[str, np.ndarray]:
    if not path.is_file():
        raise InputError(f"{path} does not exist or is not a file")
    if path.suffix == ".safetensors":
        return read_safetensors(path)[0]
    return read_state_dict(path)
