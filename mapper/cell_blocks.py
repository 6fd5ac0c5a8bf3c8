"""The inner primitives of the map: hull of blocks of eight or twelve cells with one interval, as vector instructions.

A cell is two float32, (-low, high), so that its hull with an interval is one maximum of both; a block is 16 of them,
64 bytes, or 24. It begins at any multiple of four cells, so that most footprints take one block a row. LLVM makes of
the vectors what the processor has: one AVX-512 register, two of AVX2, four of NEON. Left to itself it finds no vectors
here, or stores under a mask, which some processors do in microcode.
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
WIDE_CELLS = 12
ALIGNED_CELLS = 4
CELL_BYTES = 8
_ALIGNMENT = ALIGNED_CELLS * CELL_BYTES
ROW_BYTES = TILE_SIDE * CELL_BYTES
WINDOW_BYTES = 64
"""A window of a block, in the table of those there are ..."""
WIDE_WINDOW_BYTES = 128
"""... and of a wide one: whole lines of the cache."""

_WORD, _ADDRESS = ir.IntType(32), ir.IntType(64)
cgutils: Any = untyped_cgutils
_INFINITY = float("inf")
_PAIR = ir.IntType(64)


def _vector(lanes: int) -> Any:
    return ir.VectorType(ir.FloatType(), lanes)


def _windows(cells: int, window_bytes: int) -> Any:
    """For each first and last cell of a block: 0 for those between, -inf for the others. Floats, two a cell."""
    return [
        0.0 if first <= number // 2 <= last else -_INFINITY
        for first in range(ALIGNED_CELLS)
        for last in range(cells)
        for number in range(window_bytes // 4)
    ]


def _hull_of(cells: int, window_bytes: int, looking: bool) -> Callable[..., Any]:
    """The primitive for blocks of so many cells, as vectors of eight and of four; looking: for cells that change."""
    parts = [(cell * CELL_BYTES, 2 * min(BLOCK_CELLS, cells - cell)) for cell in range(0, cells, BLOCK_CELLS)]
    windows = _windows(cells, window_bytes)

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        address, rows, pair, window = args
        # Added to a number -inf is -inf, and 0 leaves it. Read from memory, so that LLVM can't know what it does:
        # knowing, it would store under a mask.
        kind = ir.ArrayType(ir.FloatType(), len(windows))
        table = cgutils.global_constant(builder, f"hull.windows.{cells}", ir.Constant(kind, windows))
        table.align = WINDOW_BYTES
        pair = builder.load(builder.inttoptr(pair, _PAIR.as_pointer()), align=CELL_BYTES)
        intervals = []
        for offset, lanes in parts:
            place = builder.gep(
                builder.bitcast(table, ir.IntType(8).as_pointer()), [builder.add(window, _ADDRESS(offset))]
            )
            mask = builder.load(builder.bitcast(place, _vector(lanes).as_pointer()), align=WINDOW_BYTES)
            intervals.append(builder.fadd(_spread(builder, pair, lanes), mask))

        # Reading what stands there and writing the maximum back, whether it changed or not: a branch between the two,
        # which no processor foresees on ground that is still being mapped, costs more than the writing.
        def widen(row: Any, wider: list[Any]) -> list[Any]:
            given = []
            for (offset, lanes), interval, before in zip(parts, intervals, wider, strict=True):
                cells = builder.inttoptr(builder.add(row, _ADDRESS(offset)), _vector(lanes).as_pointer())
                old = builder.load(cells, align=_ALIGNMENT)
                builder.store(_larger(builder, interval, old, lanes), cells, align=_ALIGNMENT)
                if looking:
                    grows = builder.sext(builder.fcmp_ordered(">", interval, old), before.type)
                    given.append(builder.or_(before, grows))
                else:
                    given.append(before)
            return given

        changed = _each_row(builder, address, rows, widen)
        if not looking:
            return cgutils.true_bit
        # All of it as one number: a single test where the processor has one.
        tests = []
        for wider in changed:
            number = ir.IntType(32 * wider.type.count)
            tests.append(builder.icmp_unsigned("!=", builder.bitcast(wider, number), number(0)))
        return builder.or_(tests[0], tests[-1])

    def _each_row(builder: Any, address: Any, rows: Any, do: Callable[[Any, list[Any]], list[Any]]) -> list[Any]:
        """Do something with the block at `address` and those below it; what one gives the next one takes."""
        before, loop = builder.basic_block, builder.append_basic_block("row")
        builder.branch(loop)
        builder.position_at_end(loop)
        nothing = [ir.Constant(ir.VectorType(_WORD, lanes), [0] * lanes) for _, lanes in parts]
        at, left, taken = builder.phi(_ADDRESS), builder.phi(_ADDRESS), [builder.phi(zero.type) for zero in nothing]
        given = do(at, taken)
        next_at, next_left = builder.add(at, _ADDRESS(ROW_BYTES)), builder.sub(left, _ADDRESS(1))
        starts, following = (address, rows, *nothing), (next_at, next_left, *given)
        for phi, start, next_one in zip((at, left, *taken), starts, following, strict=True):
            phi.add_incoming(start, before)
            phi.add_incoming(next_one, loop)
        end = builder.append_basic_block("rows.end")
        builder.cbranch(builder.icmp_signed(">", next_left, _ADDRESS(0)), loop, end)
        builder.position_at_end(end)
        return given

    def typed(
        typing_context: Any, address: Any, rows: Any, interval: Any, window: Any
    ) -> tuple[Any, Callable[..., Any]]:
        return types.boolean(types.uint64, types.int64, types.uint64, types.uint64), generate

    return typed


def _larger(builder: Any, a: Any, b: Any, lanes: int) -> Any:
    """That no operand is NaN is all that this flag says; without it the maximum takes three more instructions."""
    kind = ir.FunctionType(_vector(lanes), [_vector(lanes)] * 2)
    maximum = cgutils.get_or_insert_function(builder.module, kind, f"llvm.maxnum.v{lanes}f32")
    return builder.call(maximum, [a, b], fastmath=("nnan",))


def _spread(builder: Any, pair: Any, lanes: int) -> Any:
    """A vector that repeats two numbers."""
    undefined = ir.Constant(ir.VectorType(_PAIR, lanes // 2), ir.Undefined)
    first = builder.insert_element(undefined, pair, _WORD(0))
    order = ir.Constant(ir.VectorType(_WORD, lanes // 2), [0] * (lanes // 2))
    return builder.bitcast(builder.shuffle_vector(first, undefined, order), _vector(lanes))


Hull = Callable[[np.uint64, int, np.uint64, np.uint64], bool]
hull_blocks = cast(Hull, intrinsic(_hull_of(BLOCK_CELLS, WINDOW_BYTES, True)))
"""hull_blocks(address, rows, interval, window) -> did any cell change?

Hull of cells of the block at `address`, and of those below it in the tile's next rows - 1 >= 0 rows, with the interval
whose two numbers stand at the address `interval`. Which cells: `window` is WINDOW_BYTES * (first * BLOCK_CELLS + last),
first 0..3, last 0..7. Neither the interval nor any cell is NaN. The block's other cells may be written as they were
read.
"""
hull_blocks_unseen = cast(Hull, intrinsic(_hull_of(BLOCK_CELLS, WINDOW_BYTES, False)))
"""The same without looking; True. Half the work."""
hull_wide_blocks = cast(Hull, intrinsic(_hull_of(WIDE_CELLS, WIDE_WINDOW_BYTES, True)))
"""The same of twelve cells; `window` is WIDE_WINDOW_BYTES * (first * WIDE_CELLS + last), last 0..11."""
hull_wide_blocks_unseen = cast(Hull, intrinsic(_hull_of(WIDE_CELLS, WIDE_WINDOW_BYTES, False)))
