"""Texts of compiled programs: what is read from them, and what is counted, against sums by hand."""

from __future__ import annotations

from collections import Counter

import jax
import jax.numpy as jnp
import pytest

from benchmarks.compiled_counts import Counts, count
from benchmarks.compiled_hlo import parse_module
from benchmarks.compiled_targets import TARGETS, seconds
from benchmarks.compiled_tpu import megabytes, optimized
from kmn_jax.errors import InputError

_FUSIONS = """HloModule jit_f, is_scheduled=true

%add (x: f32[], y: f32[]) -> f32[] {
  %x = f32[] parameter(0)
  %y = f32[] parameter(1)
  ROOT %sum = f32[] add(%x, %y)
}

%rows (p0: f32[100,8], p1: s32[4,1]) -> f32[4] {
  %p0 = f32[100,8]{1,0} parameter(0)
  %p1 = s32[4,1]{1,0} parameter(1)
  %gather.1 = f32[4,8]{1,0} gather(%p0, %p1), offset_dims={1}, slice_sizes={1,8}
  %zero = f32[] constant(0)
  ROOT %reduce.1 = f32[4]{0} reduce(%gather.1, %zero), dimensions={1}, to_apply=%add
}

%sorted (p0.1: f32[64,2048]) -> (f32[64,2048], s32[64,2048]) {
  %p0.1 = f32[64,2048]{1,0} parameter(0)
  %iota = s32[64,2048]{1,0} iota(), iota_dimension=1
  ROOT %sort.1 = (f32[64,2048]{1,0}, s32[64,2048]{1,0}) sort(%p0.1, %iota), dimensions={1}, to_apply=%add
}

%put (whole: f32[1000,8], one: f32[1,8], at: s32[]) -> f32[1000,8] {
  %whole = f32[1000,8]{1,0} parameter(0)
  %one = f32[1,8]{1,0} parameter(1)
  %at = s32[] parameter(2)
  %none = s32[] constant(0)
  ROOT %update = f32[1000,8]{1,0} dynamic-update-slice(%whole, %one, %at, %none)
}

ENTRY %main (a: f32[100,8], b: s32[4,1], c: f32[64,2048], d: f32[1000,8], /*index=4*/e: f32[1,8], f: s32[]) -> f32[4] {
  %a = f32[100,8]{1,0} parameter(0)
  %b = s32[4,1]{1,0} parameter(1)
  %c = f32[64,2048]{1,0:T(8,128)} parameter(2)
  %d = f32[1000,8]{1,0} parameter(3)
  %e = f32[1,8]{1,0} parameter(4)
  %f = s32[] parameter(5)
  %fusion.2 = (f32[64,2048]{1,0}, s32[64,2048]{1,0}) fusion(%c), kind=kCustom, calls=%sorted
  %fusion.3 = f32[1000,8]{1,0} fusion(%d, %e, %f), kind=kLoop, calls=%put
  %part = f32[64,2048]{1,0} get-tuple-element(%fusion.2), index=0
  ROOT %fusion.1 = f32[4]{0} fusion(%a, %b), kind=kInput, calls=%rows, metadata={op_name="jit(f)/sum (of) rows"}
}
"""

_LOOPS = """HloModule jit_g

%body (s: (s32[], f32[256])) -> (s32[], f32[256]) {
  %s = (s32[], f32[256]{0}) parameter(0)
  %x = f32[256]{0} get-tuple-element(%s), index=1
  %i = s32[] get-tuple-element(%s), index=0
  %next = f32[256]{0} add(%x, %x)
  ROOT %t = (s32[], f32[256]{0}) tuple(%i, %next)
}

%more (s.1: (s32[], f32[256])) -> pred[] {
  %s.1 = (s32[], f32[256]{0}) parameter(0)
  %i.1 = s32[] get-tuple-element(%s.1), index=0
  ROOT %less = pred[] compare(%i.1, %i.1), direction=LT
}

%outer (s.2: (s32[], f32[256])) -> (s32[], f32[256]) {
  %s.2 = (s32[], f32[256]{0}) parameter(0)
  ROOT %inner = (s32[], f32[256]{0}) while(%s.2), condition=%more, body=%body
}

%small (x.3: f32[256]) -> f32[256] {
  ROOT %x.3 = f32[256]{0} parameter(0)
}

%large (x.4: f32[256]) -> f32[256] {
  %x.4 = f32[256]{0} parameter(0)
  ROOT %twice = f32[256]{0} multiply(%x.4, %x.4)
}

ENTRY %main (s.5: (s32[], f32[256]), p: s32[]) -> f32[256] {
  %s.5 = (s32[], f32[256]{0}) parameter(0)
  %p = s32[] parameter(1)
  %loop = (s32[], f32[256]{0}) while(%s.5), condition=%more, body=%outer, backend_config={"known_trip_count":{"n":"5"}}
  %x.5 = f32[256]{0} get-tuple-element(%loop), index=1
  ROOT %chosen = f32[256]{0} conditional(%p, %x.5, %x.5), branch_computations={%small, %large}
}
"""

_CALLS = """HloModule jit_h

ENTRY %main (a: f32[2048,64], b: f32[64,128], c: bf16[16,32]) -> f32[2048,128] {
  %a = f32[2048,64]{1,0} parameter(0)
  %b = f32[64,128]{1,0} parameter(1)
  %c = bf16[16,32]{1,0} parameter(2)
  %gemm = (f32[2048,128]{1,0}, s8[33554432]{0}) custom-call(%a, %b), custom_call_target="__cublas$lt$matmul", SETTINGS
  %half = bf16[16,16]{1,0} dot(%c, %c), lhs_contracting_dims={1}, rhs_contracting_dims={1}
  %top = (f32[2048,20]{1,0}, s32[2048,20]{1,0}) custom-call(%a), custom_call_target="__gpu$TopK", api_version=TYPED
  %start = bf16[16,16]{1,0} all-reduce-start(%half), replica_groups=[1,8]<=[8], to_apply=%add
  %done = bf16[16,16]{1,0} all-reduce-done(%start)
  %away = (f32[64,128]{1,0:S(5)}, f32[64,128]{1,0}, u32[]) copy-start(%b)
  %back = f32[64,128]{1,0:S(5)} copy-done(%away)
  %call = f32[8]{0} custom-call(%b), custom_call_target="xla_ffi_python_gpu_callback"
  ROOT %result = f32[2048,128]{1,0} get-tuple-element(%gemm), index=0
}
""".replace(
    "SETTINGS",
    'backend_config={"gemm_backend_config":{"dot_dimension_numbers":{"lhs_contracting_dimensions":["1"],'
    '"rhs_contracting_dimensions":["0"]},"precision_config":{"operand_precision":["HIGHEST","HIGHEST"]}}}',
)

_TPU = """HloModule jit_k

%once_more (s: (s32[], f32[256])) -> (s32[], f32[256]) {
  %s = (s32[]{:T(128)}, f32[256]{0:T(256)}) parameter(0)
  %one = s32[]{:T(128)} constant(1)
  %i = s32[]{:T(128)} get-tuple-element(%s), index=0
  %x = f32[256]{0:T(256)} get-tuple-element(%s), index=1
  %i.2 = s32[]{:T(128)} copy(%i)
  %next = s32[]{:T(128)} add(%i.2, %one)
  %negative = f32[256]{0:T(256)} negate(%x)
  ROOT %t = (s32[]{:T(128)}, f32[256]{0:T(256)}) tuple(%next, %negative)
}

%fewer (s.1: (s32[], f32[256])) -> pred[] {
  %s.1 = (s32[]{:T(128)}, f32[256]{0:T(256)}) parameter(0)
  %all = s32[]{:T(128)} constant(17)
  %i.1 = s32[]{:T(128)} get-tuple-element(%s.1), index=0
  ROOT %less = pred[]{:T(512)} compare(%i.1, %all), direction=LT
}

ENTRY %main (a: bf16[4,100,30], b: bf16[4,30,64], c: f32[256], d: f32[4,20,30], e: s32[]) -> f32[256] {
  %a = bf16[4,100,30]{2,1,0:T(8,128)(2,1)} parameter(0)
  %b = bf16[4,30,64]{2,1,0:T(8,128)(2,1)} parameter(1)
  %c = f32[256]{0:T(256)} parameter(2)
  %d = f32[4,20,30]{1,2,0:T(8,128)} parameter(3)
  %e = s32[]{:T(128)} parameter(4)
  %zero = s32[]{:T(128)} constant(0)
  %copied = s32[]{:T(128)} copy(%zero)
  %buffer = f32[4096]{0:T(1024)} custom-call(), custom_call_target="AllocateBuffer"
  %near = (f32[4,20,30]{1,2,0:T(8,128)S(1)}, f32[4,20,30]{1,2,0:T(8,128)}, u32[]{:S(2)}) copy-start(%d)
  %nearer = f32[4,20,30]{1,2,0:T(8,128)S(1)} copy-done(%near)
  %each = bf16[4,100,64]{2,1,0:T(8,128)(2,1)S(1)} convolution(%a, %b), WINDOW, dim_labels=0bf_0io->0bf
  %both = bf16[100,64]{1,0:T(8,128)(2,1)S(1)} convolution(%a, %b), window={size=4}, dim_labels=0bf_0io->0bf
  %state = (s32[]{:T(128)}, f32[256]{0:T(256)}) tuple(%copied, %c)
  %loop = (s32[]{:T(128)}, f32[256]{0:T(256)}) while(%state), condition=%fewer, body=%once_more
  %later = (s32[]{:T(128)}, f32[256]{0:T(256)}) tuple(%e, %c)
  %other = (s32[]{:T(128)}, f32[256]{0:T(256)}) while(%later), condition=%fewer, body=%once_more
  ROOT %x.1 = f32[256]{0:T(256)} get-tuple-element(%loop), index=1
}
""".replace("WINDOW", "window={size=4 stride=3 lhs_dilate=4}")


def counted(text: str, trips: int = 3) -> Counts:
    return count(parse_module(text), trips)


def test_shapes_operands_and_roots_are_read() -> None:
    module = parse_module(_FUSIONS)
    assert module.entry.name == "main"
    assert [one.name for one in module.entry.parameters] == list("abcdef")
    root = module.entry.root
    assert (root.name, root.opcode, root.operands, root.called) == ("fusion.1", "fusion", ("a", "b"), {"calls": "rows"})
    assert root.attribute("op_name") == "jit(f)/sum (of) rows"
    sort = module.computations["sorted"].root
    assert [(shape.kind, shape.extents, shape.bytes) for shape in sort.shapes] == [
        ("f32", (64, 2048), 524_288),
        ("s32", (64, 2048), 524_288),
    ]
    with pytest.raises(InputError, match="no ENTRY"):
        parse_module("HloModule nothing")


def test_kernels_read_gathered_rows_and_write_in_place() -> None:
    counts = counted(_FUSIONS)
    kernels = {kernel.kind: kernel for kernel in counts.kernels}
    assert set(kernels) == {"sort", "fusion: loop", "fusion: input"}
    assert kernels["fusion: input"].bytes == 4 * 8 * 4 + 4 * 4 + 4 * 4  # four rows, their places, the sums
    assert kernels["fusion: input"].operations == {"plain": 32}
    assert kernels["fusion: loop"].bytes == 8 * 4 + 4 + 2 * 8 * 4  # the row, its place, and what is there
    assert kernels["sort"].bytes == 3 * 524_288
    assert (kernels["sort"].sorted_elements, kernels["sort"].sorted_extent) == (64 * 2048, 2048)
    assert kernels["sort"].sort_stages == 66  # 11 rounds of merging: 1 + 2 + ... + 11


def test_loops_are_followed_and_unknown_lengths_wait_for_the_host() -> None:
    counts = counted(_LOOPS, trips=3)
    # Five trips of the outer loop, which needs no test, each with an inner loop of three trips, each a test and a sum.
    assert [(loop.times, loop.trips, loop.known) for loop in counts.loops] == [(5, 3, False), (1, 5, True)]
    assert counts.kinds == {"compare": 15, "add": 15, "multiply": 1}
    assert counts.waits == {"loop of unknown length": 5 * 4, "choice of a branch": 1}
    assert counts.moved == 15 * 2 * 1024 + 2 * 1024 + 15 * (4 + 1)


def test_library_calls_collectives_and_transfers_to_the_host_are_told_apart() -> None:
    counts = counted(_CALLS)
    assert counts.operations == {"float32": 2 * 2048 * 128 * 64, "bfloat16": 2 * 16 * 16 * 32}
    assert counts.kinds["library: __cublas$lt$matmul"] == counts.kinds["library: __gpu$TopK"] == 1
    assert counts.collective_bytes == 16 * 16 * 2
    assert counts.host_transfers == {"copy": 1, "xla_ffi_python_gpu_callback": 1}
    product = next(kernel for kernel in counts.kernels if "matmul" in kernel.kind)
    assert product.bytes == 4 * (2048 * 64 + 64 * 128 + 2048 * 128)  # but not its working memory
    selection = next(kernel for kernel in counts.kernels if "TopK" in kernel.kind)
    assert (selection.sorted_elements, selection.sort_stages) == (2048 * 64, 0)


def test_texts_for_tpus_have_tiles_loops_that_do_not_say_their_length_and_products_as_convolutions() -> None:
    counts = counted(_TPU, trips=3)
    # The second loop starts from a number that only the data knows.
    assert [(loop.trips, loop.known) for loop in counts.loops] == [(17, True), (3, False)]
    assert counts.kinds["negate"] == 17 + 3
    each, both = (kernel for kernel in counts.kernels if kernel.kind == "convolution")
    assert each.operations == {"bfloat16": 2 * 4 * 100 * 64 * 30}  # one product for each of four
    assert both.operations == {"bfloat16": 2 * 100 * 64 * 30 * 4}  # and their sum
    assert each.bytes == 2 * 4 * (104 * 128 + 32 * 128)  # tiles filled up; the result is not in the main memory
    start = next(kernel for kernel in counts.kernels if kernel.kind == "copy" and kernel.origin == "near")
    assert start.bytes == 4 * 4 * 32 * 128  # the axis of 20 lies along lanes; read, and not written back
    assert not any(kind.startswith("library") for kind in counts.kinds)


def test_memory_is_summed_from_the_list_of_a_tpu_s_allocations() -> None:
    memory = """BufferAssignment:
allocation 0: size 2000000, parameter 3, shape |f32[500000]| at ShapeIndex {}:
 value: <138 reduce_and.2 @0> (size=512,offset=0): pred[]{:T(512)}
allocation 1: size 1000000, parameter 4, shape |f32[250000]| at ShapeIndex {}:
allocation 2: size 512, thread-local:
allocation 3: size 3000000, preallocated-temp:
allocation 4: size 4000000, color 1, preallocated-temp:
"""
    assert megabytes(memory) == {"temporary MB": 3.0, "argument MB": 3.0}


def test_a_program_that_is_not_compiled_for_a_tpu_is_an_error() -> None:
    with pytest.raises(InputError, match="no such program"):
        optimized("v5e-1", "no such program")


def test_times_are_the_longest_of_what_a_kernel_does() -> None:
    target = TARGETS["h200x8"]
    floor = target.floor
    loops = counted(_LOOPS)
    assert seconds(loops, floor, 1) == pytest.approx(loops.launches * floor.launch_s + 21 * floor.wait_s)
    sort = max(counted(_FUSIONS).kernels, key=lambda kernel: kernel.bytes)
    one = Counts([sort], [], Counter(), Counter())
    assert seconds(one, floor, 1) == pytest.approx(2 * 66 * 8 * 64 * 2048 / floor.shared_bytes)
    assert target.expected.launch_s > floor.launch_s


def test_a_program_of_this_machine_is_read_whole() -> None:
    def program(x: jax.Array) -> jax.Array:
        return jax.lax.fori_loop(0, 7, lambda _, y: jnp.matmul(y, y) * 1e-3, x).sum()

    counts = counted(jax.jit(program).lower(jnp.ones((32, 32))).compile().as_text())
    assert [(loop.trips, loop.known) for loop in counts.loops] == [(7, True)]
    assert counts.operations["tf32"] == 7 * 2 * 32**3
