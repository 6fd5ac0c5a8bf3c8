"""A slice of what `make bench` and `make prove` do with every wire."""

import pytest

from bench.line_faults import measure
from bench.prove_parsers import fire
from bench.wires import WIRES, Wire
from simulator.line_faults import KINDS


@pytest.mark.parametrize("kind", sorted(KINDS))
@pytest.mark.parametrize("wire", WIRES, ids=lambda wire: wire.name)
def test_no_line_fault_costs_an_intact_frame_or_makes_a_false_one(wire: Wire, kind: str) -> None:
    """With every fifth frame struck, all that arrive whole come out, and nothing else does."""
    if kind == "wrong-length" and wire.line.length_at is None:
        pytest.skip("frames of this wire have no length field")

    result = measure(wire, kind, count=150, seed=2)

    assert result.intact > 0
    assert (result.delivered, result.false) == (result.intact, 0)


@pytest.mark.parametrize("wire", WIRES, ids=lambda wire: wire.name)
def test_hostile_bytes_raise_nothing_and_make_nothing(wire: Wire) -> None:
    """Random and mutated bytes in reads of any size; the good frames behind them come out."""
    result = fire(wire, 100_000, seed=2)

    assert result.sound
