"""The Dockerfile as far as it goes without Docker: its files, its lock, its package, its command and its check."""

from __future__ import annotations

import fnmatch
import json
import re
import shutil
import subprocess
import sys
import tomllib
from functools import partial
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from kmn_jax.arguments import parsed
from kmn_jax.cli import serve
from tests.serve.serve_sample import running

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def instructions() -> list[tuple[str, str]]:
    """Return the steps of the Dockerfile in order, as words and the rest of their lines."""
    text = re.sub(r"^#.*\n", "", (ROOT / "Dockerfile").read_text(encoding="utf-8"), flags=re.M)
    lines = re.sub(r"\\\n", " ", text).splitlines()
    return [(line.split(maxsplit=1)[0], line.split(maxsplit=1)[1]) for line in lines if line.strip()]


def those_of(word: str) -> list[str]:
    return [rest for first, rest in instructions() if first == word]


@pytest.fixture(scope="module")
def context(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with what the Dockerfile copies, and nothing else."""
    folder = tmp_path_factory.mktemp("context")
    allowed = [line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line.startswith("!")]
    for copy in those_of("COPY"):
        *sources, target = copy.split()
        for source in sources:
            assert any(fnmatch.fnmatch(source, pattern) for pattern in allowed), f"{source} is ignored"
            place = folder / target if len(sources) == 1 else folder / target / source
            if (ROOT / source).is_dir():
                shutil.copytree(ROOT / source, place, ignore=shutil.ignore_patterns("__pycache__"))
            else:
                shutil.copy(ROOT / source, place)
    return folder


def test_the_steps_come_in_an_order_that_works() -> None:
    words = [first for first, _ in instructions()]
    assert words[0] == "ARG"  # of the version of Python, which the first line of an image may use
    assert words[1] == "FROM"
    assert words.index("COPY") < max(number for number, word in enumerate(words) if word == "RUN") < words.index("USER")
    assert set(words) <= {
        *("ARG", "FROM", "RUN", "WORKDIR", "COPY", "USER", "ENV", "EXPOSE"),
        *("STOPSIGNAL", "HEALTHCHECK", "ENTRYPOINT"),
    }
    default = re.search(r"PYTHON=(\d+\.\d+)", those_of("ARG")[0])
    assert default is not None
    assert f"Programming Language :: Python :: {default[1]}" in PROJECT["classifiers"]


def test_the_system_libraries_are_those_of_our_own_environment() -> None:
    ours = re.search(r'^libraries="(.*)"$', (ROOT / ".ci" / "environment").read_text(), re.M)
    assert ours is not None
    assert f" {ours[1]} " in those_of("RUN")[0]


def test_the_package_is_built_of_what_is_copied_at_the_versions_of_the_lock(context: Path, tmp_path: Path) -> None:
    (step,) = (step for step in those_of("RUN") if "pip install" in step)
    strip, install = step.split("&&")
    subprocess.run(["sh", "-ec", strip], cwd=context, check=True, timeout=60)
    lines = (context / "versions.txt").read_text(encoding="utf-8").splitlines()
    pinned = [Requirement(line) for line in lines if line.strip() and not line.lstrip().startswith("#")]
    assert all(str(one.specifier).startswith("==") for one in pinned)
    names = {canonicalize_name(one.name) for one in pinned}
    (extras,) = (arg.partition("=")[2] for arg in those_of("ARG") if arg.startswith("EXTRAS="))
    wanted = [
        *PROJECT["dependencies"],
        *(one for extra in extras.split(",") for one in PROJECT["optional-dependencies"][extra]),
    ]
    assert {canonicalize_name(Requirement(one).name) for one in wanted} - {"kmn-jax"} <= names
    assert "gpu" in PROJECT["optional-dependencies"]  # what the comment at the top asks for
    assert install.split() == ["pip", "install", "--no-cache-dir", "--constraint", "versions.txt", '".[${EXTRAS}]"']
    # The same without what comes from an index: the package alone, by the build backend that is here.
    command = [sys.executable, "-m", *install.split()[:-1], f".[{extras}]"]
    command += ["--no-index", "--no-deps", "--no-build-isolation", "--quiet", "--target", str(tmp_path)]
    subprocess.run(command, cwd=context, check=True, capture_output=True, timeout=100)
    assert (tmp_path / "kmn_jax" / "pretrained").is_dir()


def test_the_command_serves_and_its_check_tells(tmp_path: Path) -> None:
    (command,) = map(json.loads, those_of("ENTRYPOINT"))
    call = parsed(command[1:], (serve,))
    assert command[0] in PROJECT["scripts"]
    assert isinstance(call, partial)
    assert call.keywords["host"] == "0.0.0.0"
    assert str(call.keywords["port"]) == those_of("EXPOSE")[0]
    assert any(f"mkdir {call.keywords['parts']}" in step for step in those_of("RUN"))
    (check,) = those_of("HEALTHCHECK")
    _, flag, program = json.loads(check[check.index("[") :])
    assert f"127.0.0.1:{call.keywords['port']}/health" in program
    with running(tmp_path) as server:
        program = program.replace(f":{call.keywords['port']}", f":{server.port}")
        assert subprocess.run([sys.executable, flag, program], timeout=30).returncode == 0
    done = subprocess.run([sys.executable, flag, program], timeout=30, capture_output=True)
    assert done.returncode == 1
