"""a * b + c with one rounding where the processor can, as LLVM's `fmuladd`: never slower, and never less exact."""

from collections.abc import Callable
from typing import Any, cast

from llvmlite import ir
from numba import types
from numba.core import cgutils as untyped_cgutils
from numba.extending import intrinsic

cgutils: Any = untyped_cgutils
_DOUBLE = ir.DoubleType()


def _fused(typing_context: Any, a: Any, b: Any, c: Any) -> tuple[Any, Callable[..., Any]]:
    return types.float64(types.float64, types.float64, types.float64), _generate


def _generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
    kind = ir.FunctionType(_DOUBLE, [_DOUBLE] * 3)
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, "llvm.fmuladd.f64"), args)


fused = cast(Callable[[float, float, float], float], intrinsic(_fused))
"""fused(a, b, c) = a * b + c"""
