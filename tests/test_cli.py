from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file

from kmn_jax.cli import main
from kmn_jax.models._torch_file import read_state_dict, state_dict_bytes
from tests.golden.make_network import draw_state_dict

PROGRAM = str(Path(sys.executable).with_name("kmn"))


def test_convert_there_and_back(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tensors = draw_state_dict(1)
    (tmp_path / "a.t7").write_bytes(state_dict_bytes(tensors))
    for source, target in (("a.t7", "b.safetensors"), ("b.safetensors", "c.pt"), ("c.pt", "d.pth")):
        assert main(["convert", str(tmp_path / source), str(tmp_path / target)]) == 0
        assert f"wrote {tmp_path / target}" in capsys.readouterr().out
    back = read_state_dict(tmp_path / "d.pth")
    assert all((back[name] == tensor).all() for name, tensor in tensors.items())
    assert main(["convert", str(tmp_path / "c.pt"), str(tmp_path / "e.safetensors"), "--released-names"]) == 0
    assert load_file(tmp_path / "e.safetensors").keys() == tensors.keys()


def test_bad_input_is_one_sentence_and_exit_2(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "bad.pt").write_bytes(state_dict_bytes({"a": np.ones(3, "f4")}))
    (tmp_path / "good.pt").write_bytes(state_dict_bytes(draw_state_dict(2)))
    cases = [
        ("nothing.pt", "out.safetensors", "does not exist"),
        ("bad.pt", "out.safetensors", "is missing"),
        ("good.pt", "out.onnx", "no known suffix"),
        ("good.pt", "missing/out.pt", "cannot write"),
    ]
    for source, target, message in cases:
        assert main(["convert", str(tmp_path / source), str(tmp_path / target)]) == 2
        error = capsys.readouterr().err
        assert error.startswith("kmn: ")
        assert message in error
        assert error.count("\n") == 1
    assert {path.name for path in tmp_path.iterdir()} == {"bad.pt", "good.pt"}


def test_command_is_installed_and_explains_itself() -> None:
    result = subprocess.run([PROGRAM, "convert", "--help"], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    assert "authors" in result.stdout
    with pytest.raises(SystemExit) as ended:
        main(["convert", "only-one"])
    assert ended.value.code == 2


def test_it_is_no_failure_if_nobody_reads_what_is_printed(tmp_path: Path) -> None:
    (tmp_path / "a.t7").write_bytes(state_dict_bytes(draw_state_dict(1)))
    read, write = os.pipe()
    os.close(read)
    command = [PROGRAM, "convert", str(tmp_path / "a.t7"), str(tmp_path / "b.safetensors")]
    process = subprocess.run(command, stdout=write, stderr=subprocess.PIPE, text=True, timeout=200)
    os.close(write)
    assert (process.returncode, process.stderr) == (0, "")
    assert (tmp_path / "b.safetensors").stat().st_size > 1000
