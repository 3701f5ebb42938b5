"""Train the pose verifier: `python -m experiments.train_verifier --candidates outputs/poses.npz --every 4 ...`.

It learns which poses are right from those that `python -m experiments.calibrate --candidates FILE` has found in known
worlds, once they are moved onto the depth image, as those that it is shown are; name FILE, images and worlds as there.
How it does on the refined poses of all other images, to which probabilities are fitted, is told, and nothing is chosen
by it. What verifiers are shown of all poses takes an hour, and gigabytes of a folder beside FILE: what was ended goes
on where it was until the network itself is trained, in half an hour. Afterwards raise the number of
`kmn_jax.detection.VERIFIED`, and fit again by the same FILE, whose poses are judged anew.
"""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import tyro
from flax import nnx
from jaxtyping import Array, Bool, Float, Float16, Int
from tqdm import tqdm

from experiments.bins import THRESHOLD
from experiments.candidates import read_columns, read_poses, searches_of, write_columns
from experiments.detect_bins import PRECISION, Tally
from experiments.fits import FitOptions, told, weights_of
from experiments.searches import Columns, Search, Sources
from experiments.two_at_once import side_by_side
from kmn_jax.detection import PREDICTED_CHANNELS, VERIFIER_SIDE, call_rows, polish, verifier_cells
from kmn_jax.errors import InputError, require
from kmn_jax.files import make_folder, write_whole
from kmn_jax.models import (
    VERIFIER,
    VERIFIER_CHANNELS,
    Model,
    Verifier,
    create_verifier,
    load_pretrained,
    save_verifier,
    verify,
)
from kmn_jax.programs import call_in_place
from kmn_jax.report import check_target, environment, markdown_table, print_table, write_json
from kmn_jax.train import OptimizerConfig
from kmn_jax.typing import PRNGKey, Scalar

_AT_ONCE = 256  # poses that are verified
_SHOWN = 1  # version of what verifiers are shown: it goes up with `verifier_cells` and `polish`
_LEAST_RATE = 1e-6
_SPOILED = 1 / 6, 1 / 2  # of a picture's sides, what is spoiled of it


@dataclass(frozen=True)
class Options(FitOptions, Sources):
    """What it is trained on, how, and where it goes."""

    candidates: Path = Path("outputs/poses.npz")
    output: Path = VERIFIER  # and a card beside it
    epochs: int = 7
    batch: int = 64
    learning_rate: float = 3e-3  # the highest, after a quarter of the steps
    weight_decay: float = 1e-2
    random_seed: int = 0
    json: Path | None = None

    def __post_init__(self) -> None:
        """Refuse values that contradict their meaning."""
        super().__post_init__()
        require(min(self.epochs, self.batch) > 0, "epochs and batch must be at least 1")


class State(NamedTuple):
    """All that changes from step to step."""

    parameters: nnx.State
    optimizer: optax.OptState
    step: Int[Array, ""]


def train_verifier(options: Options) -> dict[str, Any]:
    """Train, write and print. Raises InputError if there is nothing to learn from."""
    check_target(options.output, options.json)
    network = load_pretrained()
    poses = told(read_poses(options.candidates, options, options, network)[0])
    require(bool(poses["known"].any()), f"{options.candidates} holds no poses of known worlds: see --known-worlds")
    wanted = poses["known"] | poses["due"]
    poses = {name: values[wanted] for name, values in poses.items()}
    cells, errors = _seen(poses, options, network)
    known = poses["known"] & ~np.isnan(errors)  # what is moved may lie where it is neither right nor wrong
    right = (errors < THRESHOLD).astype(np.float32)
    weights = np.zeros(len(known), dtype=np.float32)
    weights[known] = weights_of({name: values[known] for name, values in poses.items()}, options)
    verifier = fitted(cells, right, weights, options)
    save_verifier(verifier, options.output)
    log_odds = log_odds_of(verifier, cells)
    splits = {"known parts": known, "other parts": poses["due"]}
    rows = [{"poses of": name} | _judged(log_odds[own], right[own]) for name, own in splits.items() if own.any()]
    print_table("The verifier alone", rows)
    _write_card(options, rows)
    results = {"verifier": rows}
    write_json(options.json, results)
    return results


def _seen(
    poses: Columns, options: Options, network: Model
) -> tuple[Float16[np.ndarray, "p s s c"], Float[np.ndarray, " p"]]:
    """Return what a verifier sees of each pose, and by how much it is off; those of known parts are polished before."""
    cells = np.empty((len(poses["error"]), VERIFIER_SIDE, VERIFIER_SIDE, VERIFIER_CHANNELS), dtype=np.float16)
    errors = poses["error"].copy()
    folder = options.candidates.with_name(f"{options.candidates.name}.shown_{_SHOWN}")
    make_folder(folder)

    def see(item: tuple[Search, Int[np.ndarray, " k"]]) -> None:
        search, rows = item
        path = folder / f"{search.name}.npz"
        given = {"given": poses["T_camera_object"][rows], "given_errors": errors[rows]}
        seen = read_columns(path) if path.exists() else {}
        # Another FILE may hold other poses, or the same by other errors.
        if not seen or not all(np.array_equal(seen[name], values, equal_nan=True) for name, values in given.items()):
            seen = given | _seen_in(search, *given.values())
            write_columns(path, seen)
        cells[rows], errors[rows] = seen["cells"], seen["errors"]

    side_by_side(see, searches_of(poses, options, network))
    return cells, errors


def _seen_in(search: Search, poses: Float[np.ndarray, "k 4 4"], errors: Float[np.ndarray, " k"]) -> Columns:
    """Return what is seen of the poses of one search, as columns."""
    part, image = search.on_device, search.scene.image
    if search.is_known:
        poses = polish(poses, part, image)
        errors = search.errors(poses, search.image.errors)
    given = part.surfels, image, part.arrays.diameter
    cells = call_rows(lambda pose: _cells(pose, *given), lambda many: _cells_of_many(many, *given), poses)
    return {"cells": cells.astype(np.float16), "errors": errors}


_cells = jax.jit(verifier_cells)
_cells_of_many = jax.jit(jax.vmap(verifier_cells, in_axes=(0, None, None, None)))


def fitted(
    cells: Float16[np.ndarray, "p s s c"],
    right: Float[np.ndarray, " p"],
    weights: Float[np.ndarray, " p"],
    options: Options,
) -> Verifier:
    """Return a verifier that is trained with poses, of which each counts as much as its weight, if it has any."""
    chosen = np.flatnonzero(weights)
    require(len(chosen) >= options.batch, f"{len(chosen)} poses are less than a batch of {options.batch}")
    key = jax.random.key(options.random_seed)
    graphdef, parameters = create_verifier(key)
    steps = options.epochs * (len(chosen) // options.batch)
    optimizer = OptimizerConfig(
        "adamw", "cosine", options.learning_rate, _LEAST_RATE, steps // 4, weight_decay=options.weight_decay
    ).build(steps)
    state = State(parameters, optimizer.init(parameters), jnp.int32(0))
    for rows in tqdm(_batches(chosen, options), total=steps, desc="verifier", unit="step"):
        batch = jax.device_put((cells[rows].astype(np.float32), right[rows], weights[rows]))
        state = _train_step(graphdef, optimizer, state, *batch, key)
    return Verifier(graphdef, state.parameters)


def _batches(rows: Int[np.ndarray, " p"], options: Options) -> Iterator[Int[np.ndarray, " b"]]:
    """Yield the rows of batches: in each epoch all, in another order, but for what fills no batch."""
    rng, count = np.random.default_rng(options.random_seed), len(rows)
    for _ in range(options.epochs):
        order = rows[rng.permutation(count)]
        yield from order[: count - count % options.batch].reshape(-1, options.batch)


@partial(jax.jit, static_argnames=("graphdef", "optimizer"))
def _train_step(
    graphdef: nnx.GraphDef,
    optimizer: optax.GradientTransformation,
    state: State,
    cells: Float[Array, "b s s c"],
    right: Float[Array, " b"],
    weights: Float[Array, " b"],
    key: PRNGKey,
) -> State:
    """Return the state after one more step; `key` is that of the run."""
    turns, spoils, drops = jax.random.split(jax.random.fold_in(key, state.step), 3)
    cells = jax.vmap(_turned)(cells, jax.random.bernoulli(turns, shape=(len(cells), 3)))
    cells = jax.vmap(_spoiled)(cells, jax.random.split(spoils, len(cells)))
    keys = jax.random.split(drops, len(cells))

    def loss(parameters: nnx.State) -> Scalar:
        log_odds = jax.vmap(verify, in_axes=(None, None, 0, 0))(graphdef, parameters, cells, keys)
        return (weights * optax.sigmoid_binary_cross_entropy(log_odds, right)).mean()

    change, optimizer_state = optimizer.update(jax.grad(loss)(state.parameters), state.optimizer, state.parameters)
    return State(optax.apply_updates(state.parameters, change), optimizer_state, state.step + 1)


def _turned(cells: Float[Array, "s s c"], which: Bool[Array, "3"]) -> Float[Array, "s s c"]:
    """Return a picture, or its mirror image along one or both of its axes, or that with rows for columns."""
    cells = jnp.where(which[0], cells[::-1], cells)
    cells = jnp.where(which[1], cells[:, ::-1], cells)
    return jnp.where(which[2], jnp.swapaxes(cells, 0, 1), cells)


def _spoiled(cells: Float[Array, "s s c"], key: PRNGKey) -> Float[Array, "s s c"]:
    """Return a picture as it is, or, as often, as if nothing was measured in a rectangle of it.

    What tells a pose must not lie in one place alone: of parts that are not known it does so less often.
    """
    whether, where = jax.random.split(key)
    *shares, row, column = jax.random.uniform(where, (4,))
    least, most = _SPOILED
    height, width = (least + (most - least) * share for share in shares)
    place = jnp.arange(len(cells), dtype=jnp.float32) / len(cells)
    rows, columns = (jnp.abs(place - middle) < size / 2 for middle, size in ((row, height), (column, width)))
    is_measured = ~jnp.isin(jnp.arange(cells.shape[-1]), jnp.asarray(PREDICTED_CHANNELS))
    lost = rows[:, None, None] & columns[None, :, None] & is_measured[None, None]
    return jnp.where(lost & jax.random.bernoulli(whether), 0, cells)


def log_odds_of(verifier: Verifier, cells: Float16[np.ndarray, "p s s c"]) -> Float[np.ndarray, " p"]:
    """Return what a verifier says of poses."""
    parts = (cells[first : first + _AT_ONCE].astype(np.float32) for first in range(0, len(cells), _AT_ONCE))
    return np.concatenate([np.asarray(_verify_many(*verifier, part)) for part in parts])


_verify_many = jax.jit(jax.vmap(verify, in_axes=(None, None, 0)), static_argnums=0)


def _judged(log_odds: Float[np.ndarray, " p"], right: Float[np.ndarray, " p"]) -> dict[str, Any]:
    """Return how well log odds tell which poses are right."""
    loss = np.logaddexp(0, np.where(right > 0, -log_odds, log_odds)).mean()
    is_right = (right > 0).tolist()
    found = Tally(log_odds.tolist(), is_right, is_right, sum(is_right)).recall_at(PRECISION)
    shares = {"right": float(right.mean()), "loss": float(loss), f"recall at {PRECISION:.0%} right": found}
    return {"poses": len(right)} | shares


def _write_card(options: Options, rows: list[dict[str, Any]]) -> None:
    facts = environment()
    digest = hashlib.sha256(options.output.read_bytes()).hexdigest()
    card = f"""# The pose verifier

Made by `experiments/train_verifier.py`; change that, not this file.

- **Weights**: `{options.output.name}`, SHA-256 `{digest[:16]}…`; `kmn_jax.models.load_verifier` loads them. What they
  say of refined poses is one column of the evidence that probabilities are fitted to.
- **Data**: poses as they are found in known worlds (docs/data.md), moved onto the depth image, half of the pictures
  with a rectangle in which nothing was measured; {options.epochs} epochs, batches of {options.batch}.
- **Command**: `{facts["command"]}`, commit {facts["commit"]}.

Of poses by what it says alone; "other parts" are refined poses such as detection chooses among, of images and parts
that it was not trained with:

{markdown_table(rows)}
"""
    write_whole(options.output.with_suffix(".md"), card.encode())


if __name__ == "__main__":
    call_in_place()
    try:
        train_verifier(tyro.cli(Options))
    except InputError as problem:
        sys.exit(f"error: {problem}")
