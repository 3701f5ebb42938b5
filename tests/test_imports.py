"""What may import what, what an import may do, and what committed files may hold."""

from __future__ import annotations

import ast
import json
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
ROOMS = (
    "geometry",
    "models",
    "pose",
    "io",
    "objects",
    "simulate",
    "bop",
    "data",
    "train",
    "detection",
    "viz",
    "serve",
    "session",
    "cli",
)
RANKS = dict.fromkeys(
    (
        "typing",
        "errors",
        "units",
        "extras",
        "files",
        "limits",
        "platforms",
        "programs",
        "released",
        "report",
        "web",
        "arguments",
        "printing",
    ),
    0,
) | {name: rank for rank, name in enumerate(ROOMS, start=1)}
# Pairs of neighbours that the ranks alone would allow: the pose solver takes arrays, not models.
FORBIDDEN = {("kmn_jax.pose", "kmn_jax.models"), ("benchmarks", "experiments"), ("experiments", "benchmarks")}
OUTER_RANKS = {"configs": 20, "experiments": 21, "benchmarks": 21, "tests": 22}
# Bins and crops of known poses, and rivals, live with the experiments.
ALLOWED = {
    ("benchmarks", "experiments.bins"),
    ("benchmarks", "experiments.evaluation"),
}

# flax.nnx itself loads optax, so optax cannot be on this list.
HEAVY = ("open3d", "trimesh", "mujoco", "grain", "viser", "torch", "orbax", "lightgbm", "fastapi", "uvicorn")
PUBLIC = {
    "kmn_jax": [],
    "kmn_jax.pose": ["kabsch", "ransac", "icp", "add", "adi", "mssd", "PoseResult"],
    "kmn_jax.models": ["KeyMatchNet", "load_released", "encode_object", "encode_scene", "match"],
    "kmn_jax.serve": ["detect_on_server"],  # the client needs nothing of the server
}

SUFFIXES = {".py", ".md", ".toml", ".yaml", ".yml", ".json", ".lock", ".txt", ".csv", ".sh", ".cfg", ""}
INDEX_HOSTS = ("pypi", "pythonhosted", r"download\.pytorch")
ADDRESS = re.compile(rf"(?:{'|'.join(INDEX_HOSTS)})\.org", re.IGNORECASE)
MACHINE_PATH = re.compile(rf"(?<![\w.)}}$~/])/(?:{'|'.join(('work', 'root', 'opt'))})/")


def our_files(*suffixes: str) -> list[Path]:
    listed = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard", "-z"], cwd=ROOT, capture_output=True
    )
    if listed.returncode != 0:
        pytest.skip("not a git checkout: which files are ours is unknown")
    paths = {ROOT / name for name in listed.stdout.decode().split("\0") if name}
    return sorted(path for path in paths if path.is_file() and path.suffix in suffixes)


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imported_modules(path: Path, tree: ast.AST) -> Iterator[str]:
    """Yield the full name of each module that a file of ours imports at any depth; `a.b` for `from a import b`."""
    package = path.relative_to(ROOT).parent.parts
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            prefix = ".".join([*base, *([node.module] if node.module else [])])
            yield from (f"{prefix}.{alias.name}" for alias in node.names)


def layer(module: str) -> tuple[str, int] | None:
    """Return the layer that a module belongs to and its rank, or None if it is not ours."""
    first, *rest = module.split(".")
    if first in OUTER_RANKS:
        return first, OUTER_RANKS[first]
    if first != "kmn_jax" or not rest or rest[0].startswith("__"):
        return None  # the package itself holds its version, and public names that nobody inside imports
    return (f"kmn_jax.{rest[0]}", RANKS[rest[0]]) if rest[0] in RANKS else (module, -1)


def layering_faults(path: Path, tree: ast.AST) -> Iterator[str]:
    own_module = module_name(path)
    own = layer(own_module) or (own_module, max(RANKS.values()))
    if own[1] < 0:
        yield f"{own_module} has no place in the layering: give it one in RANKS"
    for target in imported_modules(path, tree):
        other = layer(target)
        if other is None or other[0] == own[0]:
            continue
        if any(own[0] == source and target.startswith(prefix) for source, prefix in ALLOWED):
            continue
        if other[1] < 0 or other[1] > own[1] or (own[0], other[0]) in FORBIDDEN:
            yield f"{own_module} imports {target}"


def import_time_nodes(body: list[ast.stmt]) -> Iterator[ast.AST]:
    """Yield the nodes that run when the module is imported: everything but the bodies of functions."""
    pending: list[ast.AST] = list(body)
    while pending:
        node = pending.pop()
        yield node
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            pending += [*node.decorator_list, *node.args.defaults, *filter(None, node.args.kw_defaults)]
        elif isinstance(node, ast.If) and ast.unparse(node.test) == "__name__ == '__main__'":
            pending += node.orelse
        elif not isinstance(node, ast.Lambda):
            pending += ast.iter_child_nodes(node)


def import_time_writes(tree: ast.Module) -> Iterator[str]:
    calls = re.compile(
        r"((jax\.)?config\.update|(os\.)?environ\.(update|setdefault|pop|clear)|(os\.)?(putenv|unsetenv))\("
    )
    targets = re.compile(r"((jax\.)?config\.jax_\w+|(os\.)?environ\[.*\])$")
    for node in import_time_nodes(tree.body):
        written: list[ast.AST] = []
        if isinstance(node, ast.Assign):
            written = list(node.targets)
        elif isinstance(node, ast.AugAssign | ast.AnnAssign):
            written = [node.target]
        elif isinstance(node, ast.Delete):
            written = list(node.targets)
        if any(targets.match(ast.unparse(target)) for target in written):
            yield ast.unparse(node)
        if isinstance(node, ast.Call) and calls.match(ast.unparse(node)):
            yield ast.unparse(node)


def python_sources(*folders: str) -> Iterator[tuple[Path, ast.Module]]:
    for path in our_files(".py"):
        if path.relative_to(ROOT).parts[0] in folders:
            yield path, ast.parse(path.read_text(encoding="utf-8"), filename=str(path))


@pytest.mark.parametrize("module", PUBLIC)
def test_import_is_light(module: str, record_property: Callable[[str, object], None]) -> None:
    names = PUBLIC[module]
    statement = f"from {module} import {', '.join(names)}" if names else f"import {module}"
    program = (
        "import sys, time, json; start = time.perf_counter(); "
        f"{statement}; "
        "print(json.dumps([time.perf_counter() - start, sorted(sys.modules)]))"
    )
    result = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    seconds, modules = json.loads(result.stdout)
    record_property("seconds", round(seconds, 2))
    assert [name for name in HEAVY if name in modules] == []


def test_layers_import_downwards_only() -> None:
    faults = [fault for path, tree in python_sources("kmn_jax", *OUTER_RANKS) for fault in layering_faults(path, tree)]
    assert faults == []


@pytest.mark.parametrize(
    ("path", "source", "found"),
    [
        ("kmn_jax/pose/a.py", "from kmn_jax.models import match", ["kmn_jax.pose.a imports kmn_jax.models.match"]),
        ("kmn_jax/pose/a.py", "from kmn_jax import models", ["kmn_jax.pose.a imports kmn_jax.models"]),
        ("kmn_jax/pose/a.py", "def f():\n from ..data import cad", ["kmn_jax.pose.a imports kmn_jax.data.cad"]),
        ("kmn_jax/cli.py", "import experiments.bins", ["kmn_jax.cli imports experiments.bins"]),
        ("kmn_jax/other.py", "", ["kmn_jax.other has no place in the layering: give it one in RANKS"]),
        ("kmn_jax/pose/a.py", "from kmn_jax.geometry import knn\nfrom . import b", []),
        ("kmn_jax/cli.py", "from kmn_jax import __version__, data", []),
        ("configs/a.py", "from kmn_jax.train import loop", []),
        ("benchmarks/a.py", "import kmn_jax.cli\nimport experiments.bins", []),
        ("benchmarks/a.py", "from tests.reference import parts", ["benchmarks.a imports tests.reference.parts"]),
    ],
)
def test_layering_check_itself(path: str, source: str, found: list[str]) -> None:
    assert list(layering_faults(ROOT / path, ast.parse(source))) == found


def test_import_writes_no_setting() -> None:
    faults = [
        f"{module_name(path)}: {statement}"
        for path, tree in python_sources("kmn_jax", "configs", "experiments", "benchmarks")
        for statement in import_time_writes(tree)
        if module_name(path) != "kmn_jax.cli"
    ]
    assert faults == []


@pytest.mark.parametrize(
    ("source", "count"),
    [
        ("jax.config.update('jax_enable_x64', True)", 1),
        ("if a:\n os.environ['A'] = '1'", 1),
        ("class A:\n environ.setdefault('A', '1')", 1),
        ("config.jax_enable_x64 = True", 1),
        ("os.putenv('A', '1')", 1),
        ("del os.environ['A']", 1),
        ("def main():\n jax.config.update('jax_enable_x64', True)", 0),
        ("if __name__ == '__main__':\n os.environ['A'] = '1'", 0),
        ("home = os.environ['HOME']\nvalue = config.width", 0),
    ],
)
def test_import_write_check_itself(source: str, count: int) -> None:
    assert len(list(import_time_writes(ast.parse(source)))) == count


def test_files_stay_small() -> None:
    sources = our_files(".py")
    long = {str(path.relative_to(ROOT)): n for path in sources if (n := len(path.read_text().splitlines())) > 400}
    assert long == {}
    assert [path for path in sources if path.stem in ("utils", "util", "helpers")] == []


def test_no_index_address_or_machine_path() -> None:
    faults = [
        f"{path.relative_to(ROOT)}:{number}: {line.strip()[:100]}"
        for path in our_files(*SUFFIXES)
        for number, line in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines(), start=1)
        if ADDRESS.search(line) or MACHINE_PATH.search(line)
    ]
    assert faults == []


def test_address_check_itself() -> None:
    assert ADDRESS.search("https://files." + "pythonhosted" + ".org/packages")
    assert MACHINE_PATH.search('open("' + "/" + 'work/main/x.py")')
    assert not MACHINE_PATH.search("our/work/main and $HOME/" + "opt/x")
