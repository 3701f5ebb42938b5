"""Snapshots of tiny and of published size, full of random bits."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from functools import cache
from pathlib import Path

import jax
import ml_dtypes
import numpy as np
import tensorstore

from kmn_jax.data import BatchIterator, PipelineConfig, SampleBatches
from kmn_jax.models import KeyMatchNetConfig, create_model
from kmn_jax.train import OptimizerConfig
from kmn_jax.train._snapshot import Snapshot
from kmn_jax.train._step import TrainState
from tests.reference.networks import TINY


@cache
def abstract_state(network: KeyMatchNetConfig = TINY, clip_norm: float = 1.0) -> TrainState:
    """Return the shapes of a state, without making one."""
    optimizer = OptimizerConfig(clip_norm=clip_norm).build(10_000)

    def make() -> TrainState:
        parameters = create_model(network, jax.random.key(0))[1]
        return TrainState(jax.numpy.int32(0), parameters, parameters, optimizer.init(parameters))

    return jax.eval_shape(make)


def random_state(like: TrainState, step: int) -> TrainState:
    """Return a state whose floats are any bits at all: NaN with payloads, -0.0, subnormal."""
    random = np.random.default_rng(step)
    state = jax.tree.map(lambda leaf: random_leaf(random, leaf.shape, leaf.dtype), like)
    return jax.tree.map(jax.numpy.array, state._replace(step=np.int32(step)))


def random_leaf(random: np.random.Generator, shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
    size = int(np.prod(shape)) * np.dtype(dtype).itemsize
    return np.frombuffer(random.bytes(size), dtype).reshape(shape)


def random_snapshot(step: int, like: TrainState | None = None) -> Snapshot:
    """Return a snapshot that depends on the step alone."""
    iterator = BatchIterator(SampleBatches(PipelineConfig(batch_size=2, random_seed=step), 3, 4))
    for _ in range(step % 3):
        next(iterator)
    facts = {"config": {"name": "tiny", "rate": 1e-4}, "losses": [0.1 + step, 1 / 3], "commit": None, "é": "ü"}
    return Snapshot(random_state(abstract_state() if like is None else like, step), iterator.get_state(), facts)


def mixed_state(like: TrainState, step: int) -> TrainState:
    """Return a state with an optimizer of odd leaves: bfloat16, bool, bytes, nothing at all."""
    random = np.random.default_rng(step)
    odd = {
        "half": jax.numpy.array(random_leaf(random, (3, 5), np.dtype(ml_dtypes.bfloat16))),
        "flag": jax.numpy.array([True, False]),
        "byte": jax.numpy.arange(7, dtype=jax.numpy.uint8),
        "empty": jax.numpy.zeros((0, 3)),
    }
    return random_state(like, step)._replace(optimizer=(odd, ()))


def assert_same(found: Snapshot | None, wanted: Snapshot) -> None:
    """Compare structure, dtypes, shapes and bits."""
    assert found is not None
    assert jax.tree.structure(found.state) == jax.tree.structure(wanted.state)
    for have, want in zip(jax.tree.leaves(found.state), jax.tree.leaves(wanted.state), strict=True):
        assert isinstance(have, jax.Array)
        assert (have.dtype, have.shape, have.weak_type) == (want.dtype, want.shape, want.weak_type)
        assert np.asarray(have).tobytes() == np.asarray(want).tobytes()
    assert (found.batches, found.facts) == (wanted.batches, wanted.facts)


def flip(path: Path) -> None:
    """Change one bit in the middle of a file."""
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(bytes(content))


def truncate(path: Path) -> None:
    """Keep the first half of a file."""
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])


DAMAGES: dict[str, Callable[[Path], None]] = {"flip": flip, "truncate": truncate, "delete": Path.unlink}


def reversed_manifest(checkpoint: Path) -> Path:
    """Break the list of what a checkpoint's arrays are made of, and return its file."""
    path = checkpoint / "state" / "manifest.ocdbt"
    path.write_bytes(path.read_bytes()[::-1])
    return path


def reversed_chunk(checkpoint: Path) -> Path:
    """Break the largest compressed piece of an array, and return the file that it is in."""
    place = {"driver": "ocdbt", "base": f"{(checkpoint / 'state').as_uri()}/"}
    store = tensorstore.KvStore.open(place).result()
    values = [store.read(key).result().value for key in store.list().result() if not key.endswith(b".zarray")]
    chunk = max(values, key=len)
    path = next(path for path in checkpoint.rglob("*") if path.is_file() and chunk in path.read_bytes())
    path.write_bytes(path.read_bytes().replace(chunk, chunk[::-1]))
    return path


def sign_again(checkpoint: Path, changed: Path) -> None:
    """Write the digest of a file that was changed into its checkpoint."""
    record = checkpoint / "record.json"
    content = json.loads(json.loads(record.read_text())["content"])
    content["files"][str(changed.relative_to(checkpoint))] = hashlib.sha256(changed.read_bytes()).hexdigest()
    text = json.dumps(content)
    record.write_text(json.dumps({"sha256": hashlib.sha256(text.encode()).hexdigest(), "content": text}))
