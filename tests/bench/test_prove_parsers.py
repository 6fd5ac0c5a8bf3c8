"""The proof of the parsers can fail: what comes out and was not sent is told, unless no check could see it."""

from collections.abc import Callable, Hashable, Iterable
from dataclasses import replace

import pytest

from bench.prove_parsers import fire
from bench.wires import WIRES

LIKELY_UNSEEN = ("encoders, slcan", "gps")


@pytest.mark.parametrize("name", LIKELY_UNSEEN)
def test_what_a_parser_invents_is_not_hidden_by_what_no_check_can_see(name: str) -> None:
    """Of a wire whose damage mostly passes unseen, one thing that nothing on the line says is false."""
    wire = next(wire for wire in WIRES if wire.name == name)

    def inventive() -> Callable[[bytes], Iterable[Hashable]]:
        receive, reads = wire.receiver(), 0

        def received(data: bytes) -> Iterable[Hashable]:
            nonlocal reads
            reads += 1
            return [*receive(data), *(["invented"] if reads == 900 else [])]

        return received

    honest = fire(wire, 60_000)
    assert honest.sound
    assert honest.unseen_of_mutated > 5
    lying = fire(replace(wire, receiver=inventive), 60_000)
    assert (lying.false_of_random + lying.false_of_mutated, lying.unseen_of_mutated) == (1, honest.unseen_of_mutated)
