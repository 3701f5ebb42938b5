"""What is released: the version in all places, the wheel and the sdist, and what is said where packages are missing."""

from __future__ import annotations

import os
import re
import site
import subprocess
import sys
import tarfile
import venv
import zipfile
from pathlib import Path
from types import ModuleType

import pytest

import kmn_jax
from kmn_jax.cli import main
from kmn_jax.extras import missing_packages

ROOT = Path(__file__).parent.parent
ENDS = ("-*.whl", ".tar.gz")
LINES = (
    "numpy>=2.0",  # of no extra
    "scipy>=1.15; extra == 'detect'",
    "open3d>=0.19 ; extra == 'detect'",
    "no-such-package>=4; extra == 'detect'",
    "kmn-jax[plots]; extra == 'view'",
    "no-such-viewer>=1.1; extra == 'view'",
    "matplotlib>=3.10; extra == 'plots'",
)


def test_the_version_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"kmn {kmn_jax.__version__}\n"
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert re.findall(r"^version: (.+)$", citation, re.M) == [kmn_jax.__version__]


def test_wheel_and_sdist_are_whole_and_the_wheel_works_in_an_environment_of_its_own(tmp_path: Path) -> None:
    build = [sys.executable, "-m", "hatchling", "build", "--directory", str(tmp_path / "dist")]
    subprocess.run(build, cwd=ROOT, check=True, capture_output=True, timeout=100)
    (wheel,), (sdist,) = (list((tmp_path / "dist").glob(f"kmn_jax-{kmn_jax.__version__}{end}")) for end in ENDS)
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        (metadata,) = (name for name in names if name.endswith(".dist-info/METADATA"))
        said = archive.read(metadata).decode()
        commands = archive.read(metadata.replace("METADATA", "entry_points.txt")).decode()
    packaged = {name for name in names if "/pretrained/" in name}
    assert packaged >= {path.relative_to(ROOT).as_posix() for path in (ROOT / "kmn_jax/pretrained").rglob("*.*")}
    assert "kmn_jax/py.typed" in names
    assert {Path(name).name for name in names if "/licenses/" in name} == {"LICENSE", "NOTICE"}
    assert not any(name.startswith(("tests/", "experiments/")) for name in names)
    assert "License-Expression: Apache-2.0\n" in said
    assert "Author: The kmn_jax authors\n" in said
    assert "kmn = kmn_jax.__main__:main" in commands
    with tarfile.open(sdist) as archive:
        inside = {name.partition("/")[2] for name in archive.getnames()}
    assert {"pyproject.toml", "LICENSE", "kmn_jax/__init__.py", "tests/conftest.py", "docs/client.cpp"} <= inside
    linked = re.findall(r"\]\(([^):#]+)(?:#[^)]*)?\)", (ROOT / "README.md").read_text(encoding="utf-8"))
    assert {"CHANGELOG.md", "CONTRIBUTING.md", "NOTICE", "docs/detect.md", "docs/bin.png"} <= set(linked) <= inside
    assert sdist.stat().st_size < 12_000_000
    venv.create(tmp_path / "env", with_pip=False)
    python = next(path for folder in ("bin", "Scripts") for path in (tmp_path / "env" / folder).glob("python*"))
    install = [sys.executable, "-m", "pip", "--python", str(python), "install", "--quiet", "--no-index", "--no-deps"]
    subprocess.run([*install, str(wheel)], check=True, capture_output=True, timeout=100)
    program = "import kmn_jax; print(kmn_jax.__version__, kmn_jax.__file__)"
    ran = subprocess.run([str(python), "-I", "-c", program], capture_output=True, text=True, cwd=tmp_path, timeout=60)
    assert ran.stdout.startswith(f"{kmn_jax.__version__} {tmp_path / 'env'}"), ran.stderr
    # The command beside it, with the packages of the environment that runs this: not with its kmn_jax.
    (packages,) = (path.parent for path in (tmp_path / "env").rglob("kmn_jax") if path.is_dir())
    (packages / "shared.pth").write_text("\n".join(site.getsitepackages()))
    (command,) = python.parent.glob("kmn*")
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    ran = subprocess.run(
        [command, "--version"], capture_output=True, text=True, cwd=tmp_path, env=environment, timeout=100
    )
    assert (ran.returncode, ran.stdout) == (0, f"kmn {kmn_jax.__version__}\n"), ran.stderr


@pytest.mark.parametrize(
    ("module", "packages"),
    [
        ("scipy.spatial", ("no-such-package>=4", "scipy>=1.15")),
        ("no_such_package", ("no-such-package>=4",)),
        ("no_such_viewer", ("no-such-package>=4", "no-such-viewer>=1.1")),
        ("matplotlib", ("matplotlib>=3.10", "no-such-package>=4")),  # not the viewer, which takes it in
        ("somebody_elses", ("somebody-elses",)),
    ],
)
def test_all_packages_of_an_extra_that_are_missing_are_named(module: str, packages: tuple[str, ...]) -> None:
    assert missing_packages(module, LINES) == packages


def test_what_is_missing_is_one_sentence_with_a_command_that_exists(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    class Unimportable(ModuleType):
        def __getattr__(self, name: str) -> object:
            raise ModuleNotFoundError(name="open3d")

    monkeypatch.setitem(sys.modules, "kmn_jax.detection", Unimportable("kmn_jax.detection"))
    assert main(["prepare", str(tmp_path / "part.stl")]) == 2
    said = capsys.readouterr().err
    assert said.startswith("kmn: this needs packages that are not installed: pip install ")
    assert "open3d" in said
    assert "kmn" not in said[5:]
    assert said.count("\n") == 1
