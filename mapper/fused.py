"""a * b + c with one rounding where the processor can, as LLVM's `fmuladd`: never slower, and never less exact."""

from collections.abc import Callable
from typing import Any, cast

from llvmlite import ir
from numba import types
from numba.core import cgutils as untyped_cgutils
from numba.extending import intrinsic

cgutils: Any = untyped_cgutils


def _fused(typing_context: Any, a: Any, b: Any, c: Any) -> tuple[Any, Callable[..., Any]]:
    number = types.float32 if a == b == c == types.float32 else types.float64
    return number(number, number, number), _generate


def _generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
    number, bits = (ir.FloatType(), 32) if signature.return_type == types.float32 else (ir.DoubleType(), 64)
    kind = ir.FunctionType(number, [number] * 3)
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, f"llvm.fmuladd.f{bits}"), args)


fused = cast(Callable[[float, float, float], float], intrinsic(_fused))
"""fused(a, b, c) = a * b + c; in float32 if all three are."""
