"""Read the text of compiled programs, as XLA prints it: computations of instructions, with their shapes and attributes.

Only what counting needs: names, shapes in bytes and elements, operands, called computations, trip counts of loops.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from math import prod

from kmn_jax.errors import InputError

_BITS = {"pred": 8, "s4": 4, "u4": 4, "s2": 2, "u2": 2, "token": 0, "opaque": 0}
_SHAPE = re.compile(r"([a-z]\w*)\[([\d,]*)\](?:\{([^}]*)\})?")
_SPACE = re.compile(r"S\((\d+)\)")
_TILE = re.compile(r":T\(([\d,]+)\)")
_COMPUTATION = re.compile(r"^(ENTRY )?%?([\w.$\-]+) \(.*\) -> .*\{$")
_INSTRUCTION = re.compile(r"^\s+(ROOT )?%?([\w.$\-]+) = (.*)$")
_CALLS = re.compile(r"\b(calls|to_apply|body|condition|true_computation|false_computation)=%?([\w.$\-]+)")
_BRANCHES = re.compile(r"\bbranch_computations=\{([^}]*)\}")
_TRIPS = re.compile(r'"known_trip_count":\{"n":"(\d+)"')
_COMMENT = re.compile(r"/\*.*?\*/")


@dataclass(frozen=True)
class Shape:
    """An array: its type, its extents, and the memory that it lies in, 0 being the device's main one.

    On TPUs it lies there in tiles, and its last axes in memory are filled up to whole ones.
    """

    kind: str
    extents: tuple[int, ...]
    space: int = 0
    stored: int = 0  # numbers with what fills up tiles, 0 if that is none

    @property
    def elements(self) -> int:
        """How many numbers it has."""
        return prod(self.extents)

    @property
    def bytes(self) -> int:
        """How many bytes they take, those that fill up tiles included."""
        found = re.search(r"\d+", self.kind)
        bits = _BITS.get(self.kind, int(found[0]) if found else 0)
        return -(-max(self.elements, self.stored) * bits // 8)


@dataclass(frozen=True)
class Instruction:
    """One line of a computation."""

    name: str
    opcode: str
    shapes: tuple[Shape, ...]  # of its result, of all parts of a tuple
    operands: tuple[str, ...]
    attributes: str
    is_root: bool
    called: dict[str, str] = field(default_factory=dict)  # role -> computation
    branches: tuple[str, ...] = ()

    @property
    def elements(self) -> int:
        """How many numbers the result has."""
        return sum(shape.elements for shape in self.shapes)

    @property
    def bytes(self) -> int:
        """How many bytes the result takes."""
        return sum(shape.bytes for shape in self.shapes)

    @property
    def trips(self) -> int | None:
        """How often a loop runs, if the compiler knows."""
        found = _TRIPS.search(self.attributes)
        return int(found[1]) if found else None

    def attribute(self, name: str) -> str | None:
        """Return the value of an attribute, without its quotes or braces."""
        found = re.search(rf'\b{name}=(?:"([^"]*)"|\{{([^}}]*)\}}|([\w.\-]+))', self.attributes)
        return next((group for group in found.groups() if group is not None), None) if found else None

    def setting(self, name: str) -> str | None:
        """Return a value within the settings of a library call, as it is written: lists without their brackets."""
        found = re.search(rf'"{name}":(?:"([^"]*)"|\[([^\]]*)\]|([\w.\-]+))', self.attributes)
        return next((group for group in found.groups() if group is not None), None) if found else None


@dataclass(frozen=True)
class Computation:
    """Instructions in the order in which they run, by name."""

    name: str
    instructions: dict[str, Instruction]

    def __iter__(self) -> Iterator[Instruction]:
        return iter(self.instructions.values())

    @property
    def root(self) -> Instruction:
        """The instruction whose result is the computation's."""
        return next(one for one in self if one.is_root)

    @property
    def parameters(self) -> list[Instruction]:
        """Its parameters, by their number."""
        found = [one for one in self if one.opcode == "parameter"]
        return sorted(found, key=lambda one: int(one.operands[0]))

    def users(self) -> dict[str, list[Instruction]]:
        """Return for each name who reads it."""
        result: dict[str, list[Instruction]] = {name: [] for name in self.instructions}
        for one in self:
            for operand in set(one.operands) & result.keys():
                result[operand].append(one)
        return result


@dataclass(frozen=True)
class Module:
    """A compiled program."""

    computations: dict[str, Computation]
    entry: Computation


def parse_module(text: str) -> Module:
    """Read a program. Raises InputError if there is none in the text."""
    computations: dict[str, Computation] = {}
    entry = None
    instructions: dict[str, Instruction] | None = None
    for line in text.splitlines():
        line = _COMMENT.sub("", line)
        if (start := _COMPUTATION.match(line)) is not None:
            instructions = {}
            computations[start[2]] = Computation(start[2], instructions)
            entry = computations[start[2]] if start[1] else entry
        elif line.startswith("}"):
            instructions = None
        elif instructions is not None and (found := _INSTRUCTION.match(line)) is not None:
            one = _instruction(found[2], found[3], bool(found[1]))
            instructions[one.name] = one
    if entry is None:
        raise InputError("this is no compiled program: it has no ENTRY computation")
    return Module(computations, entry)


def _instruction(name: str, text: str, is_root: bool) -> Instruction:
    end = _closing(text, 0) + 1 if text.startswith("(") else text.index(" ")
    shapes, rest = text[:end], text[end:].lstrip()
    opcode = rest[: rest.index("(")]
    close = _closing(rest, len(opcode))
    inside, attributes = rest[len(opcode) + 1 : close], rest[close + 1 :]
    return Instruction(
        name,
        opcode,
        tuple(_shapes(shapes)),
        # Before version 0.9 or so, and in some programs, each operand's shape stands before its name.
        tuple(re.findall(r"%([\w.$\-]+)", inside)) or ((inside,) if opcode in ("constant", "parameter") else ()),
        attributes,
        is_root,
        dict(_CALLS.findall(attributes)),
        tuple(re.findall(r"[\w.$\-]+", branches[1])) if (branches := _BRANCHES.search(attributes)) else (),
    )


def _shapes(text: str) -> Iterator[Shape]:
    for kind, extents, layout in _SHAPE.findall(text):
        space, whole = _SPACE.search(layout), tuple(int(n) for n in extents.split(",") if n)
        yield Shape(kind, whole, int(space[1]) if space else 0, _stored(whole, layout))


def _stored(extents: tuple[int, ...], layout: str) -> int:
    """Return how many numbers an array in tiles takes: a layout names its axes, the last in memory first."""
    tile = _TILE.search(layout)
    if tile is None or 0 in extents:
        return 0
    filled = [extents[int(axis)] for axis in layout[: tile.start()].split(",") if axis] or [1]
    sides = [int(side) for side in tile[1].split(",")]
    for place, side in enumerate(reversed(sides[-len(filled) :])):
        filled[place] = -(-filled[place] // side) * side
    return prod(filled)


def _closing(text: str, start: int) -> int:
    """Return where the parenthesis that opens at `start` closes; quoted text does not count."""
    depth, quoted = 0, False
    for place in range(start, len(text)):
        character = text[place]
        if character == '"' and text[place - 1] != "\\":
            quoted = not quoted
        elif not quoted:
            depth += (character == "(") - (character == ")")
            if depth == 0:
                return place
    raise InputError(f"this is no line of a compiled program: {text[:80]}")
