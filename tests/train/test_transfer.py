from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file

from kmn_jax.errors import InputError
from kmn_jax.models import KeyMatchNetConfig
from kmn_jax.train._step import TrainState
from kmn_jax.train._transfer import FILE_LIMIT, MANIFEST, export_snapshot, import_snapshot
from tests.train.snapshot_sample import DAMAGES, abstract_state, assert_same, mixed_state, random_leaf, random_snapshot


@pytest.fixture(scope="module")
def like() -> TrainState:
    return abstract_state(KeyMatchNetConfig())


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory, like: TrainState) -> Path:
    """An export of the published size, step 1000: copy it before changing it."""
    folder = tmp_path_factory.mktemp("exported") / "run"
    export_snapshot(random_snapshot(1000, like), folder)
    return folder


def test_round_trip_in_small_files(exported: Path, like: TrainState) -> None:
    assert_same(import_snapshot(exported, like), random_snapshot(1000, like))
    sizes = {path.name: path.stat().st_size for path in exported.iterdir()}
    assert sum(sizes.values()) > 32_000_000
    assert max(sizes.values()) < FILE_LIMIT
    assert len(sizes) == 4
    tensors = load_file(exported / "state-1-of-3.safetensors")
    assert tensors["step"] == 1000
    kernel = random_snapshot(1000, like).state.parameters["head"]["context_pair"]["kernel"][...]
    assert tensors["parameters/head/context_pair/kernel/value"].tobytes() == np.asarray(kernel).tobytes()


def test_large_and_odd_arrays(tmp_path: Path) -> None:
    tiny = abstract_state()
    state = mixed_state(tiny, 5)
    large = random_leaf(np.random.default_rng(0), (40, 1025, 256), np.dtype(np.float32))  # 42 MB
    state.optimizer[0]["large"] = large
    snapshot = replace(random_snapshot(5, tiny), state=state, batches=bytes(range(256)))
    paths = export_snapshot(snapshot, tmp_path / "a" / "b")
    assert max(path.stat().st_size for path in paths) < FILE_LIMIT
    assert sorted(paths) == sorted((tmp_path / "a" / "b").iterdir())
    found = import_snapshot(tmp_path / "a" / "b", state)
    assert np.asarray(found.state.optimizer[0].pop("large")).tobytes() == large.tobytes()
    del state.optimizer[0]["large"]
    assert_same(found, snapshot)


@pytest.mark.parametrize("damage", DAMAGES)
def test_damage_is_named(exported: Path, tmp_path: Path, like: TrainState, damage: str) -> None:
    for number, name in enumerate(sorted(path.name for path in exported.iterdir())):
        folder = shutil.copytree(exported, tmp_path / str(number))
        DAMAGES[damage](folder / name)
        with pytest.raises(InputError, match=name):
            import_snapshot(folder, like)
        shutil.rmtree(folder)


def test_all_missing_and_foreign_pieces_are_named(exported: Path, tmp_path: Path, like: TrainState) -> None:
    other = tmp_path / "other"
    export_snapshot(random_snapshot(1001, like), other)
    (other / "state-1-of-3.safetensors").unlink()
    shutil.copy(exported / "state-3-of-3.safetensors", other)
    with pytest.raises(
        InputError, match=r"state-1-of-3\.safetensors is missing; state-3-of-3\.safetensors is damaged or of another"
    ):
        import_snapshot(other, like)
    with pytest.raises(InputError, match="holds an export already"):
        export_snapshot(random_snapshot(1000, like), other)


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ({"format": "kmn_jax export 9"}, "format is 'kmn_jax export 9'"),
        ({"files": [{"name": "../state-1-of-1.safetensors", "bytes": 1, "sha256": ""}]}, "no piece of an export"),
        ({"files": []}, "cut short or missing"),
        ({"files": 3}, "no manifest of an exported run, or is damaged"),
        ({"record": {}}, "the record is broken"),
    ],
)
def test_strange_manifests(
    exported: Path, tmp_path: Path, like: TrainState, entry: dict[str, object], message: str
) -> None:
    manifest = json.loads((exported / MANIFEST).read_text())
    for path in exported.iterdir():
        (tmp_path / path.name).symlink_to(path)
    (tmp_path / MANIFEST).unlink()
    (tmp_path / MANIFEST).write_text(json.dumps({**manifest, **entry}))
    with pytest.raises(InputError, match=message) as caught:
        import_snapshot(tmp_path, like)
    assert MANIFEST in str(caught.value)


def test_edited_facts_are_refused(exported: Path, tmp_path: Path, like: TrainState) -> None:
    shutil.copytree(exported, tmp_path, dirs_exist_ok=True)
    manifest = (tmp_path / MANIFEST).read_text()
    (tmp_path / MANIFEST).write_text(manifest.replace('\\"tiny\\"', '\\"tina\\"'))
    with pytest.raises(InputError, match="the SHA-256 differs"):
        import_snapshot(tmp_path, like)


def test_another_network_is_an_error(exported: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="of another network or optimizer"):
        import_snapshot(exported, abstract_state())
    with pytest.raises(InputError, match="give the folder of an exported run"):
        import_snapshot(tmp_path, abstract_state())


def test_unusable_exports(tmp_path: Path) -> None:
    snapshot = random_snapshot(1, abstract_state())
    with pytest.raises(InputError, match="shorten the facts"):
        export_snapshot(replace(snapshot, facts={"long": "x" * FILE_LIMIT}), tmp_path / "long")
    assert not (tmp_path / "long").exists()
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(InputError, match="cannot write to"):
        export_snapshot(snapshot, tmp_path / "file")
