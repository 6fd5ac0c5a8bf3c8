"""How far the simulated sensors are off: laws that draw errors in [-1, 1] times the declared bound.

A draw depends on (seed, channel, time) alone, so a run can be repeated and errors need not be stored. The laws:

    uniform     white, anywhere inside the bound
    corners     white, always at the bound, random sign
    constant    at the bound for the whole drive, one sign a channel
    drift       slowly from bound to bound and back
    switching   at the bound, the sign changing now and then (a telegraph)
    mixed       each channel follows one of the laws above
"""

import zlib
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled

LAWS = ("uniform", "corners", "constant", "drift", "switching", "mixed")

DRIFT_PERIOD_NS = 16_000_000_000
SWITCH_SLOT_NS = 400_000_000
SMOOTH_SLOT_NS = 1_000_000_000

_UNIFORM, _CORNERS, _CONSTANT, _DRIFT, _SWITCHING, _MIXED = range(6)
_WHICH_LAW = 1 << 62


@compiled
def chance(key: int, index: int) -> float:
    """A number in [0, 1) that depends on nothing but its arguments (the finaliser of splitmix64)."""
    x = np.uint64(key) + np.uint64(index) * np.uint64(0x9E3779B97F4A7C15)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    x = x ^ (x >> np.uint64(31))
    return float(np.float64(x >> np.uint64(11)) * 2.0**-53)


@compiled
def followed(law: int, key: int) -> int:
    """The law that a channel follows: under `mixed` one that its key names."""
    return int(chance(key, _WHICH_LAW) * _MIXED) if law == _MIXED else law


@compiled
def draw(law: int, key: int, t_ns: int) -> float:
    """Error at time t_ns as a share of the bound, in [-1, 1]."""
    law = followed(law, key)
    if law == _UNIFORM:
        return 2.0 * chance(key, t_ns) - 1.0
    if law == _CORNERS:
        return 1.0 if chance(key, t_ns) < 0.5 else -1.0
    if law == _CONSTANT:
        return 1.0 if chance(key, 0) < 0.5 else -1.0
    if law == _DRIFT:
        phase = (t_ns / DRIFT_PERIOD_NS + chance(key, 0)) % 1.0
        return 4.0 * abs(phase - 0.5) - 1.0
    return 1.0 if chance(key, t_ns // SWITCH_SLOT_NS) < 0.5 else -1.0


@compiled
def level(law: int, key: int) -> float:
    """A share of the bound that holds for the whole drive."""
    return draw(_UNIFORM if followed(law, key) == _UNIFORM else _CONSTANT, key, 0)


@compiled
def wander(law: int, key: int, t_ns: int, bound: float, rate_bound: float) -> float:
    """A bias at time t_ns; see Channel.wander."""
    if followed(law, key) != _DRIFT:
        return bound * level(law, key)
    swing = min(bound, rate_bound * DRIFT_PERIOD_NS * 1e-9 / 4.0)
    return level(law, key) * ((bound - swing) + swing * draw(law, key, t_ns))


@compiled
def _draw_all(law: int, key: int, t_ns: NDArray[np.int64], out: NDArray[np.float64]) -> None:
    for i in range(t_ns.size):
        out[i] = draw(law, key, t_ns[i])


@dataclass(frozen=True, slots=True)
class Channel:
    """One independent stream of errors, as `gyro.x`."""

    law: int
    key: int

    def at(self, t_ns: int) -> float:
        """The share of the bound at one time."""
        return draw(self.law, self.key, t_ns)

    def over(self, t_ns: NDArray[np.int64]) -> NDArray[np.float64]:
        """The share of the bound at each time."""
        shares = np.empty(t_ns.size)
        _draw_all(self.law, self.key, t_ns, shares)
        return shares

    @property
    def level(self) -> float:
        """A share that holds for the whole drive: for biases and mounts. Only `uniform` stays off the bound."""
        return level(self.law, self.key)

    def smooth(self, t_ns: NDArray[np.int64]) -> NDArray[np.float64]:
        """Shares without jumps, for what is a motion and not a reading: draws a second apart, blended."""
        if followed(self.law, self.key) in (_CONSTANT, _DRIFT):
            return self.over(t_ns)
        slot = t_ns // SMOOTH_SLOT_NS
        part = (t_ns - slot * SMOOTH_SLOT_NS) / SMOOTH_SLOT_NS
        blend = part**3 * (10.0 - 15.0 * part + 6.0 * part**2)
        before, after = self.over(slot * SMOOTH_SLOT_NS), self.over((slot + 1) * SMOOTH_SLOT_NS)
        return before + blend * (after - before)

    def wander(self, t_ns: int, bound: float, rate_bound: float) -> float:
        """A bias: |bias| <= bound, and its change per second <= rate_bound; constant except under `drift`."""
        return wander(self.law, self.key, t_ns, bound, rate_bound)


@dataclass(frozen=True, slots=True)
class ErrorLaw:
    """Which law, and the seed; every sensor asks for its own channels."""

    name: str = "uniform"
    seed: int = 1
    _law: int = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if self.name not in LAWS:
            raise ValueError(f"no error law is called {self.name!r}; there are {', '.join(LAWS)}")
        object.__setattr__(self, "_law", LAWS.index(self.name))

    def channel(self, name: str) -> Channel:
        """The channel of that name: other names and other seeds are independent of it."""
        key = zlib.crc32(f"{self.seed}/{name}".encode()) | zlib.crc32(f"{name}/{self.seed}".encode()) << 31
        return Channel(self._law, key)
