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

_LANES = 2 * BLOCK_CELLS
_WORD, _ADDRESS = ir.IntType(32), ir.IntType(64)
cgutils: Any = untyped_cgutils
_INFINITY = float("inf")
_CURTAIN = ir.ArrayType(ir.FloatType(), 3 * _LANES)
_CURTAIN_VALUES = [-_INFINITY] * _LANES + [0.0] * _LANES + [-_INFINITY] * _LANES
_FLOATS, _WORDS = ir.VectorType(ir.FloatType(), _LANES), ir.VectorType(_WORD, _LANES)


def _hull_blocks(
    typing_context: Any, address: Any, rows: Any, neg_low: Any, high: Any, first: Any, last: Any
) -> tuple[Any, Callable[..., Any]]:
    signature = types.boolean(types.uint64, types.int64, types.float32, types.float32, types.int64, types.int64)
    return signature, _generate


def _generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
    address, rows, neg_low, high, first, last = args
    interval = _spread(builder, (neg_low, high))
    # Added to a number -inf is -inf, and 0 leaves it. Read from memory, so that LLVM can't know what it does: knowing,
    # it would store under a mask.
    curtain = cgutils.global_constant(builder, "hull_blocks.curtain", ir.Constant(_CURTAIN, _CURTAIN_VALUES))
    for lanes in (builder.mul(first, _ADDRESS(-2)), builder.sub(_ADDRESS(_LANES - 2), builder.mul(last, _ADDRESS(2)))):
        place = builder.add(lanes, _ADDRESS(_LANES))
        window = builder.bitcast(builder.gep(curtain, [_WORD(0), place]), _FLOATS.as_pointer())
        interval = builder.fadd(interval, builder.load(window, align=4))

    maximum = cgutils.get_or_insert_function(
        builder.module, ir.FunctionType(_FLOATS, [_FLOATS, _FLOATS]), f"llvm.maxnum.v{_LANES}f32"
    )

    def look(cells: Any, wider: Any) -> Any:
        here = builder.fcmp_ordered(">", interval, builder.load(cells, align=_ALIGNMENT))
        return builder.or_(wider, builder.sext(here, _WORDS))

    def store(cells: Any, wider: Any) -> Any:
        # That no operand is NaN is all that this flag says; without it the maximum takes three more instructions.
        new = builder.call(maximum, [interval, builder.load(cells, align=_ALIGNMENT)], fastmath=("nnan",))
        builder.store(new, cells, align=_ALIGNMENT)
        return wider

    # Where the ground has been seen most hulls change nothing: look first, and store only where there is something to.
    wider = _each_row(builder, address, rows, look)
    # All of it as one number: a single test where the processor has one.
    number = ir.IntType(32 * _LANES)
    changed = builder.icmp_unsigned("!=", builder.bitcast(wider, number), number(0))
    with builder.if_then(changed):
        _each_row(builder, address, rows, store)
    return changed


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


def _spread(builder: Any, values: tuple[Any, ...]) -> Any:
    """A vector that repeats the numbers."""
    undefined = ir.Constant(_FLOATS, ir.Undefined)
    vector = undefined
    for place, value in enumerate(values):
        vector = builder.insert_element(vector, value, _WORD(place))
    order = ir.Constant(_WORDS, [lane % len(values) for lane in range(_LANES)])
    return builder.shuffle_vector(vector, undefined, order)


hull_blocks = cast(Callable[[np.uint64, int, np.float32, np.float32, int, int], bool], intrinsic(_hull_blocks))
"""hull_blocks(address, rows, neg_low, high, first, last) -> did any cell change?

Hull of the cells `first`..`last` (0..7) of the block at `address`, and of those below it in the tile's next rows - 1 >=
0 rows, with the interval. Neither the interval nor any cell is NaN. The block's other cells may be written as they were
read.
"""
