"""What the data say of each declared bound, kept by its key.

Two numbers, and they are not the same:

    needed    the bound must be at least this, or another one that the reading was weighed with (`given`) is wrong.
              A proof: no true motion explains the readings otherwise. More than declared: contradicted.
    seen      what the readings look like they use. No proof, since a constant error can hide; but far less than
              declared, from many readings, is a reason to ask why the bound is so wide.
"""

from dataclasses import dataclass, field
from enum import StrEnum
from math import ceil, floor, isfinite, log10

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

ENOUGH_READINGS = 100
WIDE = 1.0 / 3.0
"""Readings that use less than this share of a bound make it look needlessly wide."""
ROUNDING = 1e-6
"""Relative slack of the arithmetic here, which does not round outward."""
ROOM = 1.25
"""A bound proposed in place of a needlessly wide one is larger than what was seen by this factor."""


class Verdict(StrEnum):
    """What to make of a bound."""

    CONTRADICTED = "contradicted"
    """Proved too small, if the bounds it was weighed with hold."""
    SUSPECT = "suspect"
    """More was seen than is declared, but it is no proof."""
    WIDE = "needlessly wide"
    LOOKS_WIDE = "looks wide"
    """This drive used little of it, but it can't show all (`blind_to`)."""
    USED = "fits"
    UNSEEN = "not seen"
    """These data say nothing of it."""


@dataclass(frozen=True, slots=True)
class Usage:
    """One declared bound and what was seen of it, in the unit of its key."""

    key: str
    declared: float
    needed: float
    seen: float
    readings: int
    when_ns: int | None
    """Host time of the worst reading."""
    worst: str
    """That reading, for people."""
    given: tuple[str, ...]
    """Keys of the bounds that the proof rests on."""
    blind_to: str
    """What these data can't show of this bound."""
    whole: bool = True
    """Do the data show the whole of the error? If not, little use of a bound says little."""

    @property
    def used(self) -> float:
        """Share of the declared bound that the data use up for sure."""
        return self.needed / self.declared if self.declared else (float("inf") if self.needed > 0 else 0.0)

    @property
    def seen_share(self) -> float:
        """Share that they seem to use."""
        return self.seen / self.declared if self.declared else (float("inf") if self.seen > 0 else 0.0)

    @property
    def verdict(self) -> Verdict:
        """Contradicted, suspect, needlessly wide, unseen, or none of it."""
        if self.needed > self.declared * (1.0 + ROUNDING):
            return Verdict.CONTRADICTED
        if self.readings == 0:
            return Verdict.UNSEEN
        if self.seen > self.declared * (1.0 + ROUNDING):
            return Verdict.SUSPECT if self.needed == 0.0 else Verdict.USED
        if self.readings >= ENOUGH_READINGS and self.seen < WIDE * self.declared:
            return Verdict.WIDE if self.whole else Verdict.LOOKS_WIDE
        return Verdict.USED

    @property
    def proposal(self) -> float | None:
        """Declare this: no less than what is proved, or, for a wide bound, what was seen with room to spare."""
        if self.verdict is Verdict.CONTRADICTED:
            return rounded_up(self.needed)
        if self.verdict is Verdict.WIDE and self.seen > 0.0:
            return rounded_up(ROOM * self.seen)
        return None


@dataclass(slots=True)
class _Account:
    declared: float
    needed: float = 0.0
    seen: float = 0.0
    readings: int = 0
    needed_worst: tuple[int, str] | None = None
    seen_worst: tuple[int, str] | None = None
    given: tuple[str, ...] = ()
    blind_to: str = ""
    whole: bool = True

    @property
    def contradicted(self) -> bool:
        """Is more needed than declared?"""
        return self.needed > self.declared * (1.0 + ROUNDING)


@dataclass(slots=True)
class Ledger:
    """An account for every declared bound."""

    accounts: dict[str, _Account] = field(default_factory=dict)

    def declare(self, key: str, value: float, blind_to: str = "", *, whole: bool = True) -> None:
        """A bound and its value, in the unit of its key; `whole` as in Usage."""
        self.accounts[key] = _Account(value, blind_to=blind_to, whole=whole)

    def trusted(self, key: str) -> float:
        """The bound to weigh other readings with: as declared, or what was seen of it if it was contradicted.

        So one bound that is too small is not blamed on all the others.
        """
        account = self.accounts[key]
        return max(account.needed, account.seen) if account.contradicted else account.declared

    def charge(
        self,
        key: str,
        *,
        needed: Array,
        seen: Array | None = None,
        when_ns: NDArray[np.int64],
        worst: str,
        values: Array | None = None,
        given: tuple[str, ...] = (),
    ) -> None:
        """Readings [n], each with the bound that it needs, and seems to use; NaN: says nothing.

        `worst` describes a reading; `{}` in it stands for its entry of `values`.
        """
        account = self.accounts[key]
        account.readings += int(np.isfinite(needed).sum())
        for name, amounts in (("needed", needed), ("seen", needed if seen is None else seen)):
            if not np.isfinite(amounts).any():
                continue
            i = int(np.nanargmax(amounts))
            if amounts[i] > getattr(account, name) and isfinite(amounts[i]):
                setattr(account, name, float(amounts[i]))
                text = worst if values is None else worst.format(f"{values[i]:.4g}")
                setattr(account, f"{name}_worst", (int(when_ns[i]), text))
                if name == "needed":
                    account.given = given

    def usages(self) -> list[Usage]:
        """All accounts, in the order they were declared."""
        rows = []
        for key, account in self.accounts.items():
            when, worst = account.needed_worst or account.seen_worst or (None, "")
            rows.append(
                Usage(
                    key,
                    account.declared,
                    account.needed,
                    max(account.seen, account.needed),
                    account.readings,
                    when,
                    worst,
                    account.given,
                    account.blind_to,
                    account.whole,
                )
            )
        return rows


def rounded_up(value: float) -> float:
    """To two significant digits, never down."""
    if value <= 0.0:
        return 0.0
    unit = 10.0 ** (floor(log10(value)) - 1)
    return float(f"{ceil(value / unit - 1e-9) * unit:.6g}")
