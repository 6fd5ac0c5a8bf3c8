"""Arrays that compiled code is given once, not at each call: each argument that is one costs a call 50 ns and more.

`bind` notes where arrays lie, and how long they are; compiled code makes them arrays again. The caller keeps the arrays
themselves, for as long as it calls.
"""

from collections.abc import Callable
from typing import Any, cast

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from numba.np import arrayobj
from numpy.typing import NDArray

_NUMBER = ir.IntType(64)
_arrays: Any = arrayobj

Bound = NDArray[np.uint64]
"""Address and number of items of one array after the other."""


def bind(*arrays: NDArray[Any]) -> Bound:
    """Note where arrays lie; they must be contiguous."""
    for array in arrays:
        if not array.flags.c_contiguous:
            raise ValueError("only contiguous arrays can be bound")
    return np.array([number for array in arrays for number in (array.ctypes.data, array.size)], np.uint64)


def _row_of(item: Any) -> Any:
    """The n-th array as one row of items of that type."""
    row = types.Array(item, 1, "C")

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        bound = _arrays.make_array(signature.args[0])(context, builder, arguments[0])
        place = builder.mul(arguments[1], _NUMBER(2))
        address, size = (
            builder.load(builder.gep(bound.data, [builder.add(place, _NUMBER(offset))])) for offset in (0, 1)
        )
        array, kind = _arrays.make_array(row)(context, builder), context.get_data_type(item)
        item_bytes = _NUMBER(context.get_abi_sizeof(kind))
        data = builder.inttoptr(address, kind.as_pointer())
        _arrays.populate_array(array, data=data, shape=[size], strides=[item_bytes], itemsize=item_bytes, meminfo=None)
        return array._getvalue()

    def typed(typing_context: Any, bound: Any, n: Any) -> tuple[Any, Callable[..., Any]]:
        return row(bound, types.int64), generate

    return intrinsic(typed)


floats = cast(Callable[[Bound, int], NDArray[np.float64]], _row_of(types.float64))
"""floats(bound, n): the n-th array, as one row of float64. Likewise:"""
singles = cast(Callable[[Bound, int], NDArray[np.float32]], _row_of(types.float32))
integers = cast(Callable[[Bound, int], NDArray[np.int32]], _row_of(types.int32))
counts = cast(Callable[[Bound, int], NDArray[np.int64]], _row_of(types.int64))
words = cast(Callable[[Bound, int], NDArray[np.uint64]], _row_of(types.uint64))
flags = cast(Callable[[Bound, int], NDArray[np.bool_]], _row_of(types.boolean))
