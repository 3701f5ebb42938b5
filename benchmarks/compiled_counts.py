"""What a compiled program starts, moves, computes and waits for: its kernels with their counts, loops followed.

A kernel is what a device starts as one: a fusion, a library call, a sort, a copy. Its bytes are its operands and its
result, once each; of an operand of which only slices or gathered rows are read, those; of a result that is written in
place, what is written. Operations are those of products and of arithmetic on each number; comparisons count.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from math import log2, prod
from typing import Literal

from benchmarks.compiled_hlo import Computation, Instruction, Module

Unit = Literal["plain", "float32", "tf32", "bfloat16"]

# Names for what is there already, or for how a result is seen.
_FREE = {
    "after-all", "add-dependency", "bitcast", "constant", "get-tuple-element", "opt-barrier", "optimization-barrier",
    "parameter", "partition-id", "replica-id", "tuple",
}  # fmt: skip
_NO_ARITHMETIC = _FREE | {
    "broadcast", "concatenate", "copy", "dynamic-slice", "dynamic-update-slice", "fusion", "gather", "iota", "pad",
    "reshape", "reverse", "scatter", "slice", "sort", "transpose",
}  # fmt: skip
_SOME_ROWS = ("dynamic-slice", "gather", "slice")
_COLLECTIVES = ("all-gather", "all-reduce", "all-to-all", "collective-permute", "reduce-scatter")
# Of TPUs: names for memory, and for how indices are kept.
_FREE_CALLS = {"AllocateBuffer", "AssumeGatherIndicesInBound", "ConcatBitcast", "GatherScatterIndicesBitpacked"}
_HOST_SPACE = 5
_HOST_CALLS = ("callback", "MoveToHost", "MoveToDevice", "host_")
_WAITS_FOR_LENGTH = "loop of unknown length"
_WAITS_FOR_BRANCH = "choice of a branch"


@dataclass(frozen=True)
class Kernel:
    """What is started as one, and how often."""

    kind: str  # fusion, library call and which, sort, collective, copy, ...
    origin: str  # the operation of the source that it is from
    times: int
    bytes: int  # that it reads and writes in the device's main memory, each time
    operations: dict[Unit, float]
    sorted_elements: int = 0  # that a sort or a selection takes
    sorted_extent: int = 0  # of each of its rows
    collective_bytes: int = 0

    @property
    def sort_stages(self) -> float:
        """How many comparisons with another one each element needs in a sorting network; 0 unless it is a sort."""
        depth = -(-log2(max(self.sorted_extent, 2)) // 1)
        return depth * (depth + 1) / 2 if self.kind == "sort" else 0


@dataclass(frozen=True)
class Loop:
    """A loop that runs on the device."""

    origin: str
    times: int  # that it is started
    trips: int
    known: bool  # whether the compiler knows how often it runs; else `trips` was assumed
    kernels: int  # in one trip


@dataclass(frozen=True)
class Counts:
    """All of a program."""

    kernels: list[Kernel]
    loops: list[Loop]
    waits: Counter[str]  # for the host to read a condition, on devices whose host starts every kernel
    host_transfers: Counter[str]

    @property
    def launches(self) -> int:
        """How many kernels are started."""
        return sum(kernel.times for kernel in self.kernels)

    @property
    def kinds(self) -> Counter[str]:
        """How many of each kind are started."""
        found: Counter[str] = Counter()
        for kernel in self.kernels:
            found[kernel.kind] += kernel.times
        return found

    @property
    def moved(self) -> int:
        """How many bytes go through the device's main memory."""
        return sum(kernel.times * kernel.bytes for kernel in self.kernels)

    @property
    def collective_bytes(self) -> int:
        """How many bytes of a device's own take part in collectives."""
        return sum(kernel.times * kernel.collective_bytes for kernel in self.kernels)

    @property
    def operations(self) -> dict[Unit, float]:
        """How many operations each unit does."""
        found: Counter[Unit] = Counter()
        for kernel in self.kernels:
            for unit, number in kernel.operations.items():
                found[unit] += kernel.times * number  # type: ignore[assignment]
        return dict(found)


def count(module: Module, assumed_trips: int) -> Counts:
    """Count a program; loops whose length the compiler does not know are taken to make so many trips."""
    counts = Counts([], [], Counter(), Counter())
    _walk(module, module.entry, 1, assumed_trips, counts)
    return counts


def _walk(module: Module, computation: Computation, times: int, assumed: int, counts: Counts) -> None:
    for one in computation:
        if one.opcode in _FREE or one.opcode.endswith(("-done", "-update")):
            continue
        if one.opcode == "custom-call" and one.attribute("custom_call_target") in _FREE_CALLS:
            continue
        if one.opcode == "while":
            known = one.trips if one.trips is not None else _counted_trips(module, computation, one)
            trips = known if known is not None else assumed
            if known is None:
                counts.waits[_WAITS_FOR_LENGTH] += times * (trips + 1)
            before = counts.launches
            for role in ("body",) if known is not None else ("condition", "body"):
                runs = times * trips
                _walk(module, module.computations[one.called[role]], runs, assumed, counts)
            kernels = (counts.launches - before) // max(times * trips, 1)
            counts.loops.append(Loop(origin_of(one), times, trips, known is not None, kernels))
        elif one.opcode == "conditional":
            counts.waits[_WAITS_FOR_BRANCH] += times
            names = one.branches or tuple(one.called[role] for role in ("true_computation", "false_computation"))
            branches = [count_of(module, name, times, assumed) for name in names]
            _add(counts, max(branches, key=lambda branch: (branch.launches, branch.moved)))
        elif one.opcode in ("call", "async-start") and (one.called.get("to_apply") or one.called.get("calls")):
            name = one.called.get("to_apply") or one.called["calls"]
            _walk(module, module.computations[name], times, assumed, counts)
        elif (transfer := _host_transfer(one, computation)) is not None:
            counts.host_transfers[transfer] += times
        else:
            counts.kernels.append(_kernel(module, computation, one, times))


def count_of(module: Module, name: str, times: int, assumed: int) -> Counts:
    """Count one computation of a program."""
    counts = Counts([], [], Counter(), Counter())
    _walk(module, module.computations[name], times, assumed, counts)
    return counts


def _counted_trips(module: Module, computation: Computation, one: Instruction) -> int | None:
    """Return how often a loop runs that counts from 0 by 1 up to a constant; texts for TPUs do not say it."""
    condition, body = (module.computations[one.called[role]] for role in ("condition", "body"))
    test, start, end = condition.root, computation.instructions.get(one.operands[0]), body.root
    if test.opcode != "compare" or test.attribute("direction") != "LT" or start is None:
        return None
    counter = _uncopied(condition, test.operands[0])
    place = None if counter is None else counter.attribute("index")
    if place is None or not start.opcode == end.opcode == "tuple":
        return None
    step = body.instructions[end.operands[int(place)]]
    before = _uncopied(body, step.operands[0]) if step.opcode == "add" else None
    by_one = before is not None and before.attribute("index") == place and _constant(body, step.operands[1]) == 1
    from_zero = _constant(computation, start.operands[int(place)]) == 0
    return _constant(condition, test.operands[1]) if by_one and from_zero else None


def _constant(computation: Computation, name: str) -> int | None:
    one = _uncopied(computation, name)
    return int(one.operands[0]) if one is not None and one.opcode == "constant" and one.operands[0].isdigit() else None


def _uncopied(computation: Computation, name: str) -> Instruction | None:
    one = computation.instructions.get(name)
    while one is not None and one.opcode in ("bitcast", "copy"):
        one = computation.instructions.get(one.operands[0])
    return one


def _add(counts: Counts, more: Counts) -> None:
    counts.kernels.extend(more.kernels)
    counts.loops.extend(more.loops)
    counts.waits.update(more.waits)
    counts.host_transfers.update(more.host_transfers)


def origin_of(one: Instruction) -> str:
    """Return the operation of the source that an instruction is from: its last names, transformations left out."""
    found = one.attribute("op_name")
    if not found:
        return one.name.rstrip("0123456789.")
    return found.removeprefix("jit(main)/")


def _host_transfer(one: Instruction, computation: Computation) -> str | None:
    if one.opcode in ("infeed", "outfeed") or (
        one.opcode in ("send", "recv") and "is_host_transfer=true" in one.attributes
    ):
        return one.opcode
    target = one.attribute("custom_call_target") or ""
    if one.opcode == "custom-call" and any(part in target for part in _HOST_CALLS):
        return target
    sources = [computation.instructions[name] for name in one.operands if name in computation.instructions]
    spaces = {shape.space for item in (one, *sources) for shape in item.shapes}
    return "copy" if one.opcode in ("copy", "copy-start") and _HOST_SPACE in spaces else None


def _kernel(module: Module, computation: Computation, one: Instruction, times: int) -> Kernel:
    inside = module.computations.get(one.called.get("calls", "")) if one.opcode == "fusion" else None
    names = dict.fromkeys(one.operands)
    operands = [computation.instructions[name] for name in names if name in computation.instructions]
    work = [(inside, item) for item in inside] if inside is not None else [(computation, one)]
    operations: Counter[Unit] = Counter()
    for where, item in _nested(module, work):
        unit, number = _operations(where, item)
        operations[unit] += number  # type: ignore[assignment]
    chosen = next((item for _, item in work if item.opcode in ("sort", "topk")), None)
    kind, taken = _kind(one, inside), 0
    selected: tuple[int, int] = (0, 0)
    if chosen is not None:
        selected = chosen.shapes[0].elements, _sorted_extent(chosen)
    elif "TopK" in kind or "Sort" in kind:
        first = operands[0].shapes[0]
        selected = first.elements, first.extents[-1]
    if one.opcode.removesuffix("-start") in _COLLECTIVES:
        taken = sum(shape.bytes for operand in operands for shape in operand.shapes)
    read = _read(one, operands, inside)
    written = _written(one, inside)
    some = {unit: float(number) for unit, number in operations.items() if number}
    return Kernel(kind, origin_of(one), times, read + written, some, *selected, taken)


def _nested(module: Module, work: list[tuple[Computation, Instruction]]) -> Iterator[tuple[Computation, Instruction]]:
    """Yield instructions, and those of fusions within fusions."""
    for where, item in work:
        yield where, item
        inside = module.computations.get(item.called.get("calls", "")) if item.opcode == "fusion" else None
        if inside is not None and where is not inside and len(work) > 1:
            yield from _nested(module, [(inside, deeper) for deeper in inside])


def _kind(one: Instruction, inside: Computation | None) -> str:
    if one.opcode == "custom-call":
        return f"library: {one.attribute('custom_call_target')}"
    if inside is None:
        return one.opcode.removesuffix("-start")
    opcodes = {item.opcode for item in inside}
    for special in ("sort", "topk", "scatter"):
        if special in opcodes:
            return special
    if opcodes & {"dot", "convolution"}:
        return "product"
    return f"fusion: {(one.attribute('kind') or 'k').removeprefix('k').lower()}"


def _sorted_extent(one: Instruction) -> int:
    dimension = one.attribute("dimensions")
    extents = one.shapes[0].extents
    return extents[int(dimension.split(",")[0])] if dimension else extents[-1]


def _read(one: Instruction, operands: list[Instruction], inside: Computation | None) -> int:
    """Return the bytes that are read of all operands."""
    if inside is None:
        if one.opcode in _SOME_ROWS:
            return one.bytes
        if one.opcode == "dynamic-update-slice":
            return operands[1].bytes
        return sum(_main_bytes(operand) for operand in operands)
    users = inside.users()
    total = 0
    for operand, parameter in zip(operands, inside.parameters, strict=False):
        readers = users[parameter.name]
        if readers and all(_reads_rows(reader, parameter.name) for reader in readers):
            total += min(sum(_rows_read(reader) for reader in readers), _main_bytes(operand))
        else:
            total += _main_bytes(operand)
    return total


def _reads_rows(reader: Instruction, name: str) -> bool:
    """Whether an instruction touches only part of an operand: rows of it, or what it writes into it in place."""
    first = reader.operands[:1] == (name,) and name not in reader.operands[1:]
    return first and reader.opcode in (*_SOME_ROWS, "dynamic-update-slice", "scatter")


def _rows_read(reader: Instruction) -> int:
    return reader.bytes if reader.opcode in _SOME_ROWS else 0


def _written(one: Instruction, inside: Computation | None) -> int:
    root = one if inside is None else inside.root
    if inside is not None and root.opcode == "dynamic-update-slice":
        return 2 * inside.instructions[root.operands[1]].bytes
    if one.opcode == "custom-call":  # of a tuple's parts, the last is often working memory
        return one.shapes[0].bytes if len(one.shapes) < 3 and "cublas" in one.attributes else _main_bytes(one)
    if one.opcode == "copy-start":  # what it writes, what it reads, and a number of its own
        return one.shapes[0].bytes if one.shapes[0].space == 0 else 0
    if one.opcode.endswith("-start"):
        return one.shapes[-1].bytes
    return _main_bytes(one)


def _main_bytes(one: Instruction) -> int:
    return sum(shape.bytes for shape in one.shapes if shape.space == 0)


def _operations(where: Computation, one: Instruction) -> tuple[Unit, float]:
    if one.opcode in ("dot", "convolution"):
        left, right = (where.instructions[name].shapes[0] for name in one.operands[:2])
        if one.opcode == "dot":
            contracted = [int(n) for n in (one.attribute("lhs_contracting_dims") or "").split(",") if n]
            depth = prod(left.extents[place] for place in contracted)
        else:
            labels = (one.attribute("dim_labels") or "").split("_")[1].split("->")[0]
            depth = right.extents[labels.index("i")] * _summed_window(one.attribute("window") or "")
        exact = "highest" in one.attributes
        return _unit(left.kind, exact), 2.0 * one.shapes[0].elements * depth
    target = one.attribute("custom_call_target") or ""
    if one.opcode == "custom-call":
        if "cublas" not in target or "gemm" not in target + one.attributes:
            return "plain", 0.0
        left = where.instructions[one.operands[0]].shapes[0]
        places = [int(n) for n in (one.setting("lhs_contracting_dimensions") or "").replace('"', "").split(",") if n]
        exact = "HIGHEST" in (one.setting("operand_precision") or "")
        return _unit(left.kind, exact), 2.0 * one.shapes[0].elements * prod(left.extents[place] for place in places)
    if one.opcode in _NO_ARITHMETIC or one.opcode.removesuffix("-start") in _COLLECTIVES:
        return "plain", 0.0
    if one.opcode in ("reduce", "reduce-window"):
        sources = [where.instructions[name] for name in one.operands[: len(one.operands) // 2]]
        return "plain", float(sum(source.elements for source in sources))
    return "plain", float(one.elements)


def _summed_window(window: str) -> int:
    """Return over how many places of a window there are numbers: TPUs see products as convolutions.

    Where a side of it is padded or its operand is spread out, each result has one number: an axis of a batch.
    """
    found = dict(re.findall(r"(\w+)=(\S+)", window))
    sizes = [int(size) for size in found["size"].split("x")] if "size" in found else []
    pads = found["pad"].split("x") if "pad" in found else ["0_0"] * len(sizes)
    spread = found["lhs_dilate"].split("x") if "lhs_dilate" in found else ["1"] * len(sizes)
    return prod(size for size, pad, by in zip(sizes, pads, spread, strict=True) if (pad, by) == ("0_0", "1"))


def _unit(kind: str, exact: bool) -> Unit:
    if kind == "bf16":
        return "bfloat16"
    return "float32" if exact else "tf32"
