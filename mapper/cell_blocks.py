"""The inner primitive of the map: hull of blocks of eight cells with one interval, as vector instructions.

A cell is two float32, (-low, high), so that its hull with an interval is one maximum of both; a block is 16 of them,
64 bytes. It begins at any multiple of four cells, so that most footprints take one block a row. LLVM makes of the
16-lane vectors what the processor has: one AVX-512 register, two of AVX2, four of NEON. Left to itself it finds no
vectors here, or stores under a mask, which some processors do in microcode.
"""

from collections.abc import Callable
from typing import Any, cast

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils as untyped_cgutils
from numba.extending import intrinsic

from mapper.grid import TILE_SIDE

BLOCK_CELLS = 8
ALIGNED_CELLS = 4
CELL_BYTES = 8
_ALIGNMENT = ALIGNED_CELLS * CELL_BYTES
ROW_BYTES = TILE_SIDE * CELL_BYTES
BLOCK_BYTES = BLOCK_CELLS * CELL_BYTES

_LANES = 2 * BLOCK_CELLS
_WORD, _ADDRESS = ir.IntType(32), ir.IntType(64)
cgutils: Any = untyped_cgutils
_INFINITY = float("inf")
_WINDOWS = [
    0.0 if first <= lane // 2 <= last else -_INFINITY
    for first in range(ALIGNED_CELLS)
    for last in range(BLOCK_CELLS)
    for lane in range(_LANES)
]
_TABLE = ir.ArrayType(ir.FloatType(), len(_WINDOWS))
_FLOATS, _WORDS = ir.VectorType(ir.FloatType(), _LANES), ir.VectorType(_WORD, _LANES)
_PAIR, _PAIRS = ir.IntType(64), ir.VectorType(ir.IntType(64), BLOCK_CELLS)


def _hull_blocks(
    typing_context: Any, address: Any, rows: Any, interval: Any, window: Any
) -> tuple[Any, Callable[..., Any]]:
    return types.boolean(types.uint64, types.int64, types.uint64, types.uint64), _generate


def _generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
    address, rows, pair, window = args
    interval = _spread(builder, builder.load(builder.inttoptr(pair, _PAIR.as_pointer()), align=CELL_BYTES))
    # Added to a number -inf is -inf, and 0 leaves it. Read from memory, so that LLVM can't know what it does: knowing,
    # it would store under a mask.
    table = cgutils.global_constant(builder, "hull_blocks.windows", ir.Constant(_TABLE, _WINDOWS))
    table.align = 64
    place = builder.gep(builder.bitcast(table, ir.IntType(8).as_pointer()), [window])
    interval = builder.fadd(interval, builder.load(builder.bitcast(place, _FLOATS.as_pointer()), align=64))

    maximum = cgutils.get_or_insert_function(
        builder.module, ir.FunctionType(_FLOATS, [_FLOATS, _FLOATS]), f"llvm.maxnum.v{_LANES}f32"
    )

    # Reading what stands there and writing the maximum back, whether it changed or not: a branch between the two, which
    # no processor foresees on ground that is still being mapped, costs more than the writing.
    def widen(cells: Any, wider: Any) -> Any:
        old = builder.load(cells, align=_ALIGNMENT)
        # That no operand is NaN is all that this flag says; without it the maximum takes three more instructions.
        builder.store(builder.call(maximum, [interval, old], fastmath=("nnan",)), cells, align=_ALIGNMENT)
        return builder.or_(wider, builder.sext(builder.fcmp_ordered(">", interval, old), _WORDS))

    wider = _each_row(builder, address, rows, widen)
    # All of it as one number: a single test where the processor has one.
    number = ir.IntType(32 * _LANES)
    return builder.icmp_unsigned("!=", builder.bitcast(wider, number), number(0))


def _each_row(builder: Any, address: Any, rows: Any, do: Callable[[Any, Any], Any]) -> Any:
    """Do something with the block at `address` and those below it, `rows` in all; what one gives the next one takes."""
    before, loop = builder.basic_block, builder.append_basic_block("row")
    builder.branch(loop)
    builder.position_at_end(loop)
    at, left, taken = builder.phi(_ADDRESS), builder.phi(_ADDRESS), builder.phi(_WORDS)
    given = do(builder.inttoptr(at, _FLOATS.as_pointer()), taken)
    next_at, next_left = builder.add(at, _ADDRESS(ROW_BYTES)), builder.sub(left, _ADDRESS(1))
    nothing = ir.Constant(_WORDS, [0] * _LANES)
    for phi, start, following in ((at, address, next_at), (left, rows, next_left), (taken, nothing, given)):
        phi.add_incoming(start, before)
        phi.add_incoming(following, loop)
    end = builder.append_basic_block("rows.end")
    builder.cbranch(builder.icmp_signed(">", next_left, _ADDRESS(0)), loop, end)
    builder.position_at_end(end)
    return given


def _spread(builder: Any, pair: Any) -> Any:
    """A vector that repeats two numbers."""
    undefined = ir.Constant(_PAIRS, ir.Undefined)
    first = builder.insert_element(undefined, pair, _WORD(0))
    order = ir.Constant(ir.VectorType(_WORD, BLOCK_CELLS), [0] * BLOCK_CELLS)
    return builder.bitcast(builder.shuffle_vector(first, undefined, order), _FLOATS)


hull_blocks = cast(Callable[[np.uint64, int, np.uint64, np.uint64], bool], intrinsic(_hull_blocks))
"""hull_blocks(address, rows, interval, window) -> did any cell change?

Hull of cells of the block at `address`, and of those below it in the tile's next rows - 1 >= 0 rows, with the interval
whose two numbers stand at the address `interval`. Which cells: `window` is BLOCK_BYTES * (first * BLOCK_CELLS + last),
first 0..3, last 0..7. Neither the interval nor any cell is NaN. The block's other cells may be written as they were
read.
"""
