"""One budget for what is read, a setting; JSON within it, through one function."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save_file

from kmn_jax.bop._files import read_json
from kmn_jax.data import Pack
from kmn_jax.detection._calibration import load_probabilities
from kmn_jax.errors import InputError
from kmn_jax.io import read_pose
from kmn_jax.io._scans import read_camera
from kmn_jax.limits import SETTING, check_bytes, check_elements, most_bytes, most_elements, parse_json
from kmn_jax.models import load_model
from kmn_jax.objects import load_grasps, load_part

PACKAGE = Path(__file__).parent.parent / "kmn_jax"


def test_the_budget_is_a_setting(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(SETTING, raising=False)
    assert (most_bytes(), most_elements()) == (2_000_000_000, 50_000_000)
    check_bytes(2_000_000_000)
    check_elements(50_000_000)
    monkeypatch.setenv(SETTING, "400")
    assert (most_bytes(), most_elements()) == (400, 10)
    with pytest.raises(InputError, match=r"it takes 401 bytes, more than 400: .* set KMN_MOST_BYTES higher"):
        check_bytes(401)
    with pytest.raises(InputError, match=r"it has 11 pixels, more than 10: .* set KMN_MOST_BYTES to more than 440"):
        check_elements(11, "pixels")
    with pytest.raises(InputError, match=r"^.{,200}$"):
        check_elements(10**5000)


@pytest.mark.parametrize("value", ["2 GB", "-5", "0", "1e9", "9" * 5000])
def test_a_setting_that_is_no_number_is_told(value: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(SETTING, value)
    with pytest.raises(InputError, match=r"KMN_MOST_BYTES is .*, but must be a number of bytes"):
        most_bytes()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[" * 100_000, "nested deeper than 64 levels"),
        ("[" * 70 + "]" * 70, "nested deeper than 64 levels"),
        ('{"a":' * 70 + "1" + "}" * 70, "nested deeper than 64 levels"),
        ("9" * 5000, "Exceeds the limit"),
        ("{", "Expecting property name"),
        ("", "Expecting value"),
    ],
)
def test_json_that_cannot_be_used(text: str, message: str) -> None:
    for content in (text, text.encode()):
        with pytest.raises(InputError, match=message):
            parse_json(content)


def test_json_that_can_be_used() -> None:
    assert parse_json('{"a": [1, {"b": "[[[["}]}') == {"a": [1, {"b": "[[[["}]}
    flat = [[0]] * 1000
    assert parse_json(str(flat)) == parse_json(str(flat).encode()) == flat
    assert parse_json('{"a": 1, "a": 2}', lambda pairs: [name for name, _ in pairs]) == ["a", "a"]


def test_json_is_weighed_before_it_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    text = "[" + "[]," * 1000 + "[]]"  # 3 kB, in memory more than 60
    monkeypatch.setenv(SETTING, "50000")
    with pytest.raises(InputError, match=r"it takes .* bytes, more than 50000"):
        parse_json(text)
    assert len(parse_json("[" + "0.123456789, " * 300 + "1]")) == 301


def card(path: Path, text: str) -> None:
    load_part(safetensors(path, {"format": "kmn_jax object card 1", "facts": text}))


def safetensors(path: Path, header: dict[str, str]) -> Path:
    save_file({"a": np.zeros(1, np.float32)}, path, metadata=header)
    return path


def plain(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


READERS: dict[str, Callable[[Path, str], object]] = {
    "camera": lambda path, text: read_camera(plain(path, text)),
    "card": card,
    "model": lambda path, text: load_model(safetensors(path, {"kmn_jax.config": text})),
    "pose": lambda path, text: read_pose(plain(path, text), "T_base_camera"),
    "grasps": lambda path, text: load_grasps(plain(path, text)),
    "calibration": lambda path, text: load_probabilities(plain(path, text), ("a",)),
    "pack": lambda path, text: Pack(plain(path / "manifest.json", text).parent),
    "dataset": lambda path, text: read_json(plain(path, text)),
}


@pytest.mark.parametrize("name", READERS)
def test_deep_json_is_one_sentence_of_every_reader(name: str, tmp_path: Path) -> None:
    path = tmp_path / "a"
    if name == "pack":
        path.mkdir()
    for depth in (100, 300_000):
        with pytest.raises(InputError, match="nested deeper than 64 levels") as caught:
            READERS[name](path, '{"a": ' + "[" * depth + "]" * depth + "}")
        assert str(caught.value).startswith(str(path))


def test_all_json_is_read_by_one_function() -> None:
    others = [
        str(path.relative_to(PACKAGE))
        for path in PACKAGE.rglob("*.py")
        if path.name != "limits.py" and re.search(r"\bjson\.loads?\(", path.read_text(encoding="utf-8"))
    ]
    assert others == []
