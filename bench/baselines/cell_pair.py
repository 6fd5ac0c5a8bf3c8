"""Hull of one cell, two float32 (-low, high) side by side, with an interval: one load, one maximum, one store.

Left to itself the compiler takes the two numbers one by one, each with a branch or a blend of its own. Tried for the
mixture, too (its three sums as one vector): no gain with 16 bytes a cell, and slower with 12.
"""

from collections.abc import Callable
from typing import Any, cast

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils as untyped_cgutils
from numba.extending import intrinsic

cgutils: Any = untyped_cgutils
_PAIR = ir.VectorType(ir.FloatType(), 2)
PAIR_BYTES = 8


def _hull_pair(context: Any, cell: Any, interval: Any) -> tuple[Any, Callable[..., Any]]:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        place, interval = (builder.inttoptr(address, _PAIR.as_pointer()) for address in arguments)
        kind = ir.FunctionType(_PAIR, [_PAIR, _PAIR])
        maximum = cgutils.get_or_insert_function(builder.module, kind, "llvm.maxnum.v2f32")
        pair = builder.load(interval, align=4), builder.load(place, align=4)
        builder.store(builder.call(maximum, pair, fastmath=("nnan",)), place, align=4)
        return context.get_dummy_value()

    return types.void(types.uint64, types.uint64), generate


hull_pair = cast(Callable[[np.uint64, np.uint64], None], intrinsic(_hull_pair))
"""hull_pair(cell, interval): addresses of a cell and of an interval, neither with NaN in it."""
