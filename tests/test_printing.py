"""What commands print gets out as far as it can, and what is wrong with stdout is one sentence."""

from __future__ import annotations

import io
import os
import sys
from pathlib import Path

import pytest

from kmn_jax.cli import main
from kmn_jax.errors import InputError
from kmn_jax.printing import say


def test_letters_that_stdout_lacks_are_written_as_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    out = io.TextIOWrapper(io.BytesIO(), "ascii")
    monkeypatch.setattr(sys, "stdout", out)
    say("ß\udcff: found")
    assert out.buffer.getvalue() == b"\\xdf\\udcff: found\n"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no device that is always full")
def test_a_full_stdout_is_one_sentence(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    with open("/dev/full", "w") as out:
        monkeypatch.setattr(sys, "stdout", out)
        assert main(["--version"]) == 2
    assert capsys.readouterr().err.startswith("kmn: cannot print: No space left on device; ")
    with open("/dev/full", "w") as out:
        monkeypatch.setattr(sys, "stdout", out)
        with pytest.raises(InputError, match="cannot print"):
            say("more than a buffer holds " * 1000)
        say("goes nowhere")


def test_a_command_goes_on_though_nobody_reads(monkeypatch: pytest.MonkeyPatch) -> None:
    read, write = os.pipe()
    os.close(read)
    with open(write, "w") as out:
        monkeypatch.setattr(sys, "stdout", out)
        say("the address")
        say("and more")


def test_a_closed_stdout_is_no_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdout", None)
    assert main(["--version"]) == 0
    assert sys.stdout.name == os.devnull  # whose place a file of results could have taken
    sys.stdout.close()
