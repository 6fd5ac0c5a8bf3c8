"""The inner primitives of the mixture map, as vector instructions: Gaussian masses of cells in a row, and their sums.

As mapper/cell_blocks.py is for the hull. Sixteen lanes of float32 a step; what lies behind the last cell gets a mass of
zero, which changes nothing there. The normal distribution's Phi is Abramowitz and Stegun 7.1.28, without a branch or an
exponential: its error is below 3e-7, as much as float32 keeps of it.
"""

from collections.abc import Callable
from math import pi, sqrt
from typing import Any, cast

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils as untyped_cgutils
from numba.extending import intrinsic

LANES = 16
CELLS_A_STEP = LANES - 1
"""Sixteen borders have fifteen cells between them."""

cgutils: Any = untyped_cgutils
_WORD, _ADDRESS = ir.IntType(32), ir.IntType(64)
_FLOATS, _WORDS = ir.VectorType(ir.FloatType(), LANES), ir.VectorType(_WORD, LANES)
_COUNT = ir.Constant(_FLOATS, [float(k) for k in range(LANES)])
_MASS = (0.0705230784, 0.0422820123, 0.0092705272, 0.0001520143, 0.0002765672, 0.0000430638)


def _numbers(value: float) -> Any:
    return ir.Constant(_FLOATS, [float(np.float32(value))] * LANES)


def _spread(builder: Any, value: Any) -> Any:
    """A vector of one number."""
    undefined = ir.Constant(_FLOATS, ir.Undefined)
    first = builder.insert_element(undefined, value, _WORD(0))
    return builder.shuffle_vector(first, undefined, ir.Constant(_WORDS, [0] * LANES))


def _call(builder: Any, name: str, *arguments: Any) -> Any:
    kind = ir.FunctionType(_FLOATS, [_FLOATS] * len(arguments))
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.v{LANES}f32"), arguments)


def _polynomial(builder: Any, x: Any, coefficients: tuple[float, ...]) -> Any:
    """1 + c1 x + c2 x^2 + ..."""
    value = _numbers(coefficients[-1])
    for coefficient in (*coefficients[-2::-1], 1.0):
        value = _call(builder, "fmuladd", value, x, _numbers(coefficient))
    return value


def _sixteenth_power(builder: Any, x: Any) -> Any:
    for _ in range(4):
        x = builder.fmul(x, x)
    return x


def _phi(builder: Any, t: Any) -> Any:
    """Phi(t) = (1 + erf(t / sqrt 2)) / 2."""
    scaled = tuple(c / sqrt(2.0) ** (k + 1) for k, c in enumerate(_MASS))
    power = _sixteenth_power(builder, _polynomial(builder, _call(builder, "fabs", t), scaled))
    half = builder.fsub(_numbers(0.5), builder.fdiv(_numbers(0.5), power))
    return builder.fadd(_numbers(0.5), _call(builder, "copysign", half, t))


def _density(builder: Any, t: Any) -> Any:
    """exp(-t^2 / 2) / sqrt(2 pi), to 0.5 % of itself within three sigma: it only moves a conditional mean."""
    power = _sixteenth_power(builder, _polynomial(builder, builder.fmul(t, t), (1 / 32, 1 / 2048, 1 / 196608)))
    return builder.fdiv(_numbers(1.0 / sqrt(2.0 * pi)), power)


def _borders(builder: Any, first: Any, step: Any) -> Any:
    return _call(builder, "fmuladd", _COUNT, _spread(builder, step), _spread(builder, first))


def _differences(builder: Any, phi: Any) -> Any:
    """Each number's successor less itself; the last lane counts for nothing."""
    following = builder.shuffle_vector(phi, phi, ir.Constant(_WORDS, [*range(1, LANES), LANES - 1]))
    return builder.fsub(following, phi)


def _pointer(builder: Any, address: Any) -> Any:
    return builder.inttoptr(address, _FLOATS.as_pointer())


def _add(builder: Any, address: Any, plane_bytes: Any, mass: Any, count: Any, u0: Any, du: Any, variance: Any) -> None:
    """Add mass, mass u and mass (u^2 + variance) of the first `count` lanes to the three planes."""
    lanes = ir.Constant(_WORDS, list(range(LANES)))
    undefined = ir.Constant(_WORDS, ir.Undefined)
    limit = builder.insert_element(undefined, builder.trunc(count, _WORD), _WORD(0))
    limit = builder.shuffle_vector(limit, undefined, ir.Constant(_WORDS, [0] * LANES))
    mass = builder.select(builder.icmp_signed("<", lanes, limit), mass, _numbers(0.0))
    u = _borders(builder, u0, du)
    second = _call(builder, "fmuladd", u, u, _spread(builder, variance))
    for weight in (None, u, second):
        place = _pointer(builder, address)
        old = builder.load(place, align=4)
        new = builder.fadd(old, mass) if weight is None else _call(builder, "fmuladd", mass, weight, old)
        builder.store(new, place, align=4)
        address = builder.add(address, plane_bytes)


def _normal_borders(context: Any, address: Any, first: Any, step: Any) -> tuple[Any, Callable[..., Any]]:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        address, first, step = arguments
        t = _borders(builder, first, step)
        builder.store(_phi(builder, t), _pointer(builder, address), align=4)
        builder.store(_density(builder, t), _pointer(builder, builder.add(address, _ADDRESS(4 * LANES))), align=4)
        return context.get_dummy_value()

    return types.void(types.uint64, types.float32, types.float32), generate


def _masses(context: Any, address: Any, first: Any, step: Any) -> tuple[Any, Callable[..., Any]]:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        address, first, step = arguments
        masses = _differences(builder, _phi(builder, _borders(builder, first, step)))
        builder.store(masses, _pointer(builder, address), align=4)
        return context.get_dummy_value()

    return types.void(types.uint64, types.float32, types.float32), generate


_ROW = (types.uint64, types.int64, types.float32, types.int64, types.float32, types.float32, types.float32)


def _add_masses(
    context: Any, address: Any, plane_bytes: Any, share: Any, count: Any, u0: Any, du: Any, variance: Any, masses: Any
) -> tuple[Any, Callable[..., Any]]:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        address, plane_bytes, share, count, u0, du, variance, masses = arguments
        mass = builder.fmul(builder.load(_pointer(builder, masses), align=4), _spread(builder, share))
        _add(builder, address, plane_bytes, mass, count, u0, du, variance)
        return context.get_dummy_value()

    return types.void(*_ROW, types.uint64), generate


def _add_normal(
    context: Any,
    address: Any,
    plane_bytes: Any,
    share: Any,
    count: Any,
    u0: Any,
    du: Any,
    variance: Any,
    first: Any,
    step: Any,
) -> tuple[Any, Callable[..., Any]]:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        address, plane_bytes, share, count, u0, du, variance, first, step = arguments
        masses = _differences(builder, _phi(builder, _borders(builder, first, step)))
        _add(builder, address, plane_bytes, builder.fmul(masses, _spread(builder, share)), count, u0, du, variance)
        return context.get_dummy_value()

    return types.void(*_ROW, types.float32, types.float32), generate


F32 = np.float32
normal_borders = cast(Callable[[np.uint64, F32, F32], None], intrinsic(_normal_borders))
"""normal_borders(address, first, step): Phi of 16 numbers from `first` on by `step` to there, densities behind."""
masses = cast(Callable[[np.uint64, F32, F32], None], intrinsic(_masses))
"""masses(address, first, step): what lies between each of those borders and the next."""
add_masses = cast(Callable[[np.uint64, int, F32, int, F32, F32, F32, np.uint64], None], intrinsic(_add_masses))
"""add_masses(address, plane_bytes, share, count, u0, du, variance, masses)

Add masses read from an address, times share, to `count` <= 15 cells of a row from `address` on: to the plane S0, times
u = u0 + du k to S1 `plane_bytes` further on, times u^2 + variance to S2.
"""
add_normal = cast(Callable[[np.uint64, int, F32, int, F32, F32, F32, F32, F32], None], intrinsic(_add_normal))
"""add_normal(address, plane_bytes, share, count, u0, du, variance, first, step): the same of masses made on the way."""
