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
    assert main(["convert", "only-one"]) == 2


UNITS = "{auto,mm,cm,m,in}"


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ("", "Expected one of {prepare, detect, view, serve, export, convert}: see kmn --help"),
        ("nope", "Unrecognized options: nope"),
        ("detect", "Missing from kmn detect: --object PATH, --scene PATH: see kmn detect --help"),
        ("detect --objct a --scene b", "Missing from kmn detect: --object PATH; Unrecognized options: --objct, a"),
        (
            "detect --object a --scene b --unit mm",
            f"Unrecognized options: --unit, mm; Perhaps you meant: --object-units {UNITS}, --units {UNITS}: see",
        ),
        ("prepare", "Missing from kmn prepare: PATH"),
        ("detect --object a --scene b --object=c", "--object is given 2 times, but has one value"),
        ("detect --object a --scene b --random-seed 1 --random_seed 2", "--random-seed is given 2 times"),
        (f"prepare a {'long/' * 60}b", f"Unrecognized options: {'long/' * 60}b: see kmn"),
        ("prepare a b", "Unrecognized options: b"),
        ("detect --object a --scene b --top x", "Error parsing --top: "),
        ("detect --object a --scene b --plane x", "invalid choice 'x' for argument '--plane'"),
    ],
)
def test_wrong_arguments_are_one_sentence(arguments: str, said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(arguments.split()) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.startswith(f"kmn: {said}")
    assert printed.err.endswith("--help\n")
    assert printed.err.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ("detect --object a --scene b --at 1,2,3 --at -1,-2,-3 --at=-4,5,6", "a cannot be read: No such file"),
        ("serve --allow-host a --allow-host b --port 99999", "port 99999 is not one"),
    ],
)
def test_some_flags_may_be_given_several_times(arguments: str, said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(arguments.split()) == 2
    assert said in capsys.readouterr().err


def test_an_interrupt_while_libraries_load_leaves_no_traceback(tmp_path: Path) -> None:
    (tmp_path / "tyro.py").write_text("raise KeyboardInterrupt")
    paths = os.pathsep.join([str(tmp_path), str(Path(__file__).parent.parent)])
    done = subprocess.run(
        [sys.executable, "-m", "kmn_jax", "--help"], env=os.environ | {"PYTHONPATH": paths}, capture_output=True
    )
    assert (done.returncode, done.stdout, done.stderr) == (130, b"", b"")


def test_it_is_no_failure_if_nobody_reads_what_is_printed(tmp_path: Path) -> None:
    (tmp_path / "a.t7").write_bytes(state_dict_bytes(draw_state_dict(1)))
    read, write = os.pipe()
    os.close(read)
    command = [PROGRAM, "convert", str(tmp_path / "a.t7"), str(tmp_path / "b.safetensors")]
    process = subprocess.run(command, stdout=write, stderr=subprocess.PIPE, text=True, timeout=200)
    os.close(write)
    assert (process.returncode, process.stderr) == (0, "")
    assert (tmp_path / "b.safetensors").stat().st_size > 1000
