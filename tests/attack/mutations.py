"""Damage to files: bytes, numbers in text, values of JSON trees. All randomness comes from one generator."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from random import Random
from typing import Any

Mutation = Callable[[bytes, Random], bytes]

_INTEGERS = (0, 1, -1, 255, 65_535, 10**6, 2**31 - 1, 2**31, 2**32 - 1, 10**12, 2**63 - 1, 2**63, 10**20)
_NUMBERS = (b"nan", b"inf", b"-inf", b"1e300", b"-1e300", b"1e-320", b"1e39", b"0", b"-0", b"1e9", b"0.1")
_NUMBER = re.compile(rb"(?<![\w.])[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?")
_HEADER = 400  # bytes of a file that count as its header
_PLACE = "@@place@@"
_VALUES = (
    *("NaN", "Infinity", "-Infinity", "1e300", "-1e300", "1e-320", "1e400", "-1", "0", "1", "-0.0", "0.5"),
    *("2147483648", "4294967296", "9223372036854775808", "-9223372036854775809", "1" * 400, "9" * 5000),
    *(
        "null",
        "true",
        "false",
        '""',
        '"a"',
        '"1"',
        r'"\u0000"',
        r'"\ud800"',
        '"../../a"',
        '"/"',
        '"' + "a" * 5000 + '"',
    ),
    *("[]", "{}", "[[]]", "[1]", "[null]", "[NaN]", "[true, 3]", '{"a": 1}', "[0, 0, 0]", "[[1, 2], [3]]"),
    *("[" * 5000 + "]" * 5000, '{"a":' * 5000 + "1" + "}" * 5000, "[" * 200_000, "[1, 2", "0x10", "'a'"),
)


def mutated_bytes(content: bytes, random: Random) -> bytes:
    """Flip, cut, insert, repeat, move or overwrite bytes, once or a few times."""
    for _ in range(random.choice((1, 1, 1, 2, 3))):
        content = _once(content, random)
    return content


def _once(content: bytes, random: Random) -> bytes:
    if not content:
        return random.choice((b"\0", b"{}", b"\xff" * 100))
    kind = random.choice(
        ("flip", "flip", "cut", "insert", "noise", "repeat", "delete", "swap", "word", "word", "empty")
    )
    reach = min(len(content), _HEADER) if random.random() < 0.5 else len(content)  # headers break more
    start, far, length = random.randrange(reach), random.randrange(len(content)), random.randint(1, 200)
    before, block, rest = content[:start], content[start : start + length], content[start + length :]
    match kind:
        case "flip":
            return before + bytes([content[start] ^ (1 << random.randrange(8))]) + content[start + 1 :]
        case "cut":
            return content[:far] if random.random() < 0.5 else before
        case "insert":
            return before + str(random.choice(_INTEGERS)).encode() + content[start:]
        case "noise":
            return before + random.randbytes(length) + content[start:]
        case "repeat":
            return before + block * random.choice((2, 2, 10, 1000)) + rest
        case "delete":
            return before + rest
        case "swap":
            return content[:far] + block + content[far + length :]
        case "word":
            size = random.choice((1, 2, 4, 8))
            order = random.choice(("little", "big"))
            word = (random.choice(_INTEGERS) % 256**size).to_bytes(size, order)  # type: ignore[arg-type]
            word = random.choice((word, word, b"\x00\x00\xc0\x7f", b"\x00\x00\x80\x7f", b"\xff" * 8))
            return before + word + content[start + len(word) :]
    return b"" if random.random() < 0.2 else content[:1]


def mutated_numbers(content: bytes, random: Random, reach: int | None = None) -> bytes:
    """Replace some of the numbers that stand in text, of its first `reach` bytes only if that is given."""
    found = list(_NUMBER.finditer(content[:reach]))
    if not found:
        return mutated_bytes(content, random)
    for match in sorted(random.sample(found, min(len(found), random.choice((1, 1, 2, 5)))), key=lambda m: -m.start()):
        number = random.choice((*_NUMBERS, *(str(value).encode() for value in _INTEGERS), b"9" * 5000, b"a", b""))
        content = content[: match.start()] + number + content[match.end() :]
    return content


def mutated_header(content: bytes, random: Random) -> bytes:
    """Replace numbers of the text that a binary file begins with."""
    return mutated_numbers(content, random, _HEADER)


def mutated_lines(content: bytes, random: Random) -> bytes:
    """Drop, repeat, move or join lines."""
    lines = content.splitlines(keepends=True)
    if not lines:
        return content
    row, other = random.randrange(len(lines)), random.randrange(len(lines))
    match random.choice(("drop", "repeat", "move", "join", "many")):
        case "drop":
            del lines[row : row + random.choice((1, 1, 10))]
        case "repeat":
            lines.insert(row, lines[row])
        case "move":
            lines[row], lines[other] = lines[other], lines[row]
        case "join":
            lines[row] = lines[row].rstrip(b"\r\n") + b" "
        case "many":
            lines[row] *= 5000
    return b"".join(lines)


def mutated_tree(content: bytes, random: Random) -> bytes:
    """Replace, drop, repeat or rename one value of a JSON text; what is not JSON is damaged as text."""
    try:
        tree = json.loads(content)
    except (ValueError, RecursionError):
        return mutated_bytes(content, random)
    places = list(_places(tree))
    if not places:
        return random.choice(_VALUES).encode()
    holder, key = random.choice(places)
    match random.choice(("value", "value", "value", "drop", "rename", "whole")):
        case "value":
            holder[key] = _PLACE
        case "drop":
            del holder[key]
        case "rename" if isinstance(holder, dict):
            name = random.choice(("", "-1", "1" * 5000, "a", key.upper(), "\u0660", "../a", "1e3"))
            holder[name] = holder.pop(key)
        case _:
            tree = random.choice((_PLACE, [tree], {"a": tree}, [tree, tree]))
    return json.dumps(tree).replace(f'"{_PLACE}"', random.choice(_VALUES)).encode()


def mutated_rows(content: bytes, random: Random) -> bytes:
    """Damage a value of one row of a file that has JSON in each."""
    rows = content.splitlines() or [b""]
    row = random.randrange(len(rows))
    rows[row] = mutated_tree(rows[row], random)
    return b"\n".join(rows) + b"\n"


def _places(tree: Any) -> Any:
    pending = [tree]
    while pending:
        node = pending.pop()
        items = list(node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ())
        yield from ((node, key) for key, _ in items)
        pending += [value for _, value in items]
