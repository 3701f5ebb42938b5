from __future__ import annotations

import pickle
import zipfile
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
from flax import nnx
from safetensors import safe_open
from safetensors.numpy import save_file

from kmn_jax.errors import InputError
from kmn_jax.models import (
    RELEASED_CONFIG,
    KeyMatchNetConfig,
    Model,
    create_model,
    encode_object,
    encode_scene,
    load_model,
    load_released,
    match,
    model_structure,
    save_model,
    save_released,
)
from kmn_jax.models._released import _read
from kmn_jax.models._torch_file import read_state_dict, state_dict_bytes
from tests.golden.make_network import GOLDEN, ROWS, draw_inputs, draw_state_dict
from tests.reference.networks import TINY


@pytest.fixture(scope="module")
def tensors() -> dict[str, np.ndarray]:
    return draw_state_dict(0)


@pytest.fixture(scope="module")
def torch_file(tensors: dict[str, np.ndarray], tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("weights") / "published.t7"
    path.write_bytes(state_dict_bytes(tensors))
    return path


def parameters_equal(a: Model, b: Model) -> bool:
    return all(np.array_equal(x, y) for x, y in zip(jax.tree.leaves(a[1]), jax.tree.leaves(b[1]), strict=True))


def test_golden_logits_of_the_dense_torch_network(tensors: dict[str, np.ndarray], torch_file: Path) -> None:
    """tests/golden/make_network.py made them, in float64."""
    golden = np.load(GOLDEN)
    crop, cloud, keypoints = draw_inputs(0)
    model = load_released(torch_file)
    got = match(model, encode_scene(model, crop), encode_object(model, cloud, keypoints))
    for name, values in zip(("segmentation", "keypoints"), got, strict=True):
        error = np.abs(np.asarray(values)[ROWS] - golden[name]) / golden[f"{name}_range"]
        assert (error < 1e-4).mean() >= 0.995, name
        assert error.max() < 0.02, name


def test_weights_that_are_no_numbers_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "model.safetensors"
    save_model(create_model(TINY, jax.random.key(0)), path)
    with safe_open(str(path), "np") as file:
        values, header = {name: file.get_tensor(name) for name in file.keys()}, file.metadata()  # noqa: SIM118
    name = min(values)
    for bad in (np.float32(np.nan), np.float64(1e300), np.int32(1)):  # 1e300 is infinite in single precision
        save_file(values | {name: np.full_like(values[name], bad, dtype=bad.dtype)}, path, metadata=header)
        with pytest.raises(InputError, match=f"{name} has values that are not finite numbers"):
            load_model(path)


def test_names_may_carry_the_data_parallel_prefix(tensors: dict[str, np.ndarray], torch_file: Path, tmp_path) -> None:
    save_file({f"module.{name}": tensor for name, tensor in tensors.items()}, tmp_path / "w.safetensors")
    assert parameters_equal(load_released(tmp_path / "w.safetensors"), load_released(torch_file))


@pytest.mark.parametrize("suffix", [".pt", ".t7", ".safetensors"])
def test_round_trip_to_the_authors_form(
    tensors: dict[str, np.ndarray], torch_file: Path, suffix: str, tmp_path
) -> None:
    path = tmp_path / f"back{suffix}"
    save_released(load_released(torch_file), path)
    back = _read(path)
    assert back.keys() == tensors.keys()
    for name, tensor in tensors.items():
        assert back[name].shape == tensor.shape, name
        np.testing.assert_array_equal(back[name], tensor, err_msg=name)


def test_own_format_round_trip(tmp_path: Path) -> None:
    config = replace(TINY, num_keypoints=40, num_coarse_points=16, attention="both")
    model = create_model(config, jax.random.key(0))
    path = tmp_path / "model.safetensors"
    save_model(model, path)
    back = load_model(path)
    assert back.config == config
    assert back.graphdef == model.graphdef
    assert parameters_equal(back, model)


def test_only_what_the_authors_code_has_is_written_in_its_form(tmp_path: Path) -> None:
    for changes in ({"graph": "static"}, {"num_neighbors": 10}, {"normalization": "metric"}, {"num_coarse_points": 4}):
        model = model_structure(replace(RELEASED_CONFIG, **changes))
        with pytest.raises(InputError, match=f"something else .* {next(iter(changes))}"):
            save_released(model, tmp_path / "a.pt")
    with pytest.raises(InputError, match="no known suffix"):
        save_released(model_structure(RELEASED_CONFIG), tmp_path / "a.onnx")


def test_wrong_contents_are_named(tensors: dict[str, np.ndarray], tmp_path: Path) -> None:
    def changed(**changes: np.ndarray | None) -> dict[str, np.ndarray]:
        merged = tensors | changes
        return {name: tensor for name, tensor in merged.items() if tensor is not None}

    broken = tensors["conv1.1.bias"].copy()
    broken[5] = np.nan
    cases = [
        (changed(**{"conv8r.0.weight": None}), "conv8r.0.weight is missing"),
        (changed(extra=np.ones(3, "f4")), "extra is unknown"),
        (
            changed(**{"conv6.0.weight": np.ones((512, 192, 1), "f4")}),
            r"conv6.0.weight has shape \(512, 192, 1\), but the network needs \(1024, 192, 1\)",
        ),
        (changed(**{"conv9.0.weight": np.ones((2, 256, 3), "f4")}), r"conv9.0.weight has shape \(2, 256, 3\)"),
        (changed(**{"conv1.1.bias": broken}), "conv1.1.bias holds NaN"),
        ({"a": np.ones(3, "f4")}, "and [0-9]+ more"),
    ]
    for index, (contents, message) in enumerate(cases):
        path = tmp_path / f"{index}.pt"
        path.write_bytes(state_dict_bytes(contents))
        with pytest.raises(InputError, match=message):
            load_released(path)


class _Runs:
    def __reduce__(self):
        return (exec, ("raise SystemExit('code of the file was run')",))


def test_no_code_of_a_file_runs(tmp_path: Path) -> None:
    path = tmp_path / "evil.pt"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("archive/data.pkl", pickle.dumps({"conv1.0.weight": _Runs()}))
    with pytest.raises(InputError, match=r"refused: its pickle names builtins\.exec"):
        load_released(path)


def test_damaged_files_are_one_sentence(torch_file: Path, tmp_path: Path) -> None:
    whole = torch_file.read_bytes()
    path = tmp_path / "damaged.pt"
    for contents in (b"", b"not a zip", whole[: len(whole) // 2], pickle.dumps([1, 2])):
        path.write_bytes(contents)
        with pytest.raises(InputError):
            load_released(path)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("something/else", b"")
    with pytest.raises(InputError, match=r"no data\.pkl"):
        load_released(path)
    with pytest.raises(InputError, match="does not exist"):
        load_released(tmp_path / "nothing.pt")
    (tmp_path / "bad.safetensors").write_bytes(whole)
    for load in (load_released, load_model):
        with pytest.raises(InputError, match="not a readable"):
            load(tmp_path / "bad.safetensors")


def test_mutated_torch_files_never_escape_the_one_error(tmp_path: Path) -> None:
    """Flip bytes in a small file's pickle and directory: InputError, or the tensors, and nothing else."""
    original = bytearray(state_dict_bytes({"a": np.ones((2, 3), "f4"), "b": np.ones(4, "f4")}))
    path = tmp_path / "mutated.pt"
    rng = np.random.default_rng(0)
    for _ in range(300):
        mutated = original.copy()
        for position in rng.integers(0, len(mutated), 3):
            mutated[position] = rng.integers(0, 256)
        path.write_bytes(mutated)
        try:
            tensors = read_state_dict(path)
        except InputError:
            continue
        assert all(isinstance(value, np.ndarray) for value in tensors.values())


def test_config_of_another_version_is_refused(tmp_path: Path) -> None:
    save_file({"a": np.ones(1, "f4")}, tmp_path / "m.safetensors", metadata={"kmn_jax.config": '{"unknown": 1}'})
    with pytest.raises(InputError, match="cannot use"):
        load_model(tmp_path / "m.safetensors")
    save_file({"a": np.ones(1, "f4")}, tmp_path / "p.safetensors")
    with pytest.raises(InputError, match="load_released"):
        load_model(tmp_path / "p.safetensors")


def blob_cloud(seed: int) -> np.ndarray:
    """Return (2048, 6) scattered points: flat faces make near-ties in feature space, which flip in torch itself."""
    cloud = np.random.default_rng(seed).normal(size=(2048, 6))
    cloud[:, :3] *= 20
    cloud[:, 3:] /= np.linalg.norm(cloud[:, 3:], axis=1, keepdims=True)
    return cloud.astype(np.float32)


@pytest.mark.torch
@pytest.mark.parametrize("seed", range(3))
def test_forward_agrees_with_the_dense_torch_network(seed: int, tmp_path: Path) -> None:
    """Both outputs, published sizes, float32; then with the graphs given, so that no near-tie can flip."""
    import torch

    from benchmarks.reference.dense_torch import DenseKeyMatchNet, neighbours

    network = DenseKeyMatchNet().draw(seed).eval()
    torch.save(network.state_dict(), tmp_path / "w.t7")
    model = load_released(tmp_path / "w.t7")
    crop, cloud, keypoints = blob_cloud(seed), blob_cloud(seed + 50), np.random.default_rng(seed).permutation(2048)[:20]
    centered = cloud - cloud.mean(axis=0)
    scene, part = (torch.from_numpy((x / x.std()).T[None].copy()) for x in (crop, centered))
    with torch.no_grad():
        dynamic = network(scene, part, torch.from_numpy(keypoints))
        graphs = [neighbours(x[:, :3], 20) for x in (scene, part)]
        given = network(
            scene,
            part,
            torch.from_numpy(keypoints),
            [graphs[0]] * 3,
            [graphs[1]] * 2 + [torch.arange(20).expand(20, 20)],
        )
    got = match(model, encode_scene(model, crop), encode_object(model, cloud, keypoints))
    for ours, theirs in zip(got, dynamic, strict=True):
        error = np.abs(np.asarray(ours) - theirs.numpy()) / np.ptp(theirs.numpy())
        assert (error < 1e-4).mean() >= 0.995
        assert error.max() < 0.02
    static = Model(
        create_model(KeyMatchNetConfig(normalization="released", graph="static"), jax.random.key(0))[0], model[1]
    )
    got = match(static, encode_scene(static, crop), encode_object(static, cloud, keypoints))
    for ours, theirs in zip(got, given, strict=True):
        assert np.abs(np.asarray(ours) - theirs.numpy()).max() < 1e-4 * np.ptp(theirs.numpy())


@pytest.mark.torch
def test_torch_reads_what_we_write(tmp_path: Path) -> None:
    import torch

    from benchmarks.reference.dense_torch import DenseKeyMatchNet

    model = create_model(RELEASED_CONFIG, jax.random.key(0))
    save_released(model, tmp_path / "ours.pt")
    state = torch.load(tmp_path / "ours.pt", weights_only=True)
    DenseKeyMatchNet().load_state_dict(state, strict=True)
    kernel = np.asarray(dict(nnx.to_flat_state(model[1]))["head", "scene_pair", "kernel"][...])
    np.testing.assert_array_equal(state["conv8.0.weight"][:, :, 0, 0].numpy().T, kernel)


@pytest.mark.torch
def test_torch_files_of_other_layouts(tmp_path: Path) -> None:
    """Wrapped in a dict beside other things, saved as Parameters, in half precision, as views of one buffer."""
    import torch

    base = torch.arange(24, dtype=torch.float32).reshape(4, 6)
    views = {"view": base[1:3, ::2], "half": base.half(), "bf16": base.bfloat16(), "p": torch.nn.Parameter(base)}
    torch.save({"epoch": 3, "loss": base.sum(), "state_dict": views}, tmp_path / "a.pt")
    tensors = read_state_dict(tmp_path / "a.pt")
    np.testing.assert_array_equal(tensors["view"], base[1:3, ::2].numpy())
    np.testing.assert_array_equal(tensors["half"], base.numpy())
    np.testing.assert_array_equal(tensors["p"], base.numpy())
    np.testing.assert_array_equal(tensors["bf16"], base.numpy())
