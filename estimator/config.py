"""What the owner declares of the robot's motion, and how the filter is set."""

from typing import Annotated, Literal, Self, TypeAlias

from pydantic import Field, model_validator
from pydantic.dataclasses import dataclass

from drivers.config import STRICT, NotNegative, Positive, Rising

SetName: TypeAlias = Literal["box", "ellipsoid"]


@dataclass(frozen=True, slots=True, kw_only=True, config=STRICT)
class RobotConfig:
    """The tracked robot and the limits of its motion (SMF.md section 2). The truth never exceeds any of them."""

    name: str = Field(pattern=r"^[A-Za-z0-9_-]+$")
    """Stands in every key on the wire."""
    track_length_m: Positive
    track_gauge_m: Positive
    """Between the middles of the tracks."""
    max_speed_mps: Positive
    max_acceleration_mps2: Positive
    """|dv/dt| along the tracks, and the robot's own acceleration that an accelerometer axis can feel."""
    max_turn_rate_dps: Positive
    """|body rate|, each axis."""
    max_turn_acceleration_dps2: Positive
    slip_ratio: Annotated[float, Field(ge=0, le=0.9)]
    """Each track's longitudinal slip: |ground travel - track travel| <= slip_ratio * |track travel|. (At 1 a track may
    spin at any speed.)"""
    lateral_slip_ratio: NotNegative
    """|v_lateral| <= lateral_slip_ratio * |v| + turning_centre_m * |turn rate|."""
    turning_centre_m: NotNegative
    """Fore-aft offset of the instantaneous turning centre."""
    turning_gauge_m: Annotated[tuple[Positive, Positive], Rising] | None = None
    """[least, most] distance between the tracks' turning centres, to either side of which a track doesn't slide along
    itself; at least the gauge, by calibration; it may change while driving. None: the tracks say nothing of yaw."""
    max_tilt_rate_dps: Positive | None = None
    """|body rate| about the x and the y axis, if slower than max_turn_rate_dps: how fast roll and pitch change."""
    normal_slip_ratio: NotNegative
    """|v_normal| <= normal_slip_ratio * |v|: sinking, bouncing."""


@dataclass(frozen=True, slots=True, kw_only=True, config=STRICT)
class FilterConfig:
    """How the filter runs."""

    set: SetName = "box"
    """What x, y and yaw are kept as: boxes and a window of fixes, the tighter one; or the paper's ellipsoid."""
    reordering_window_ms: Annotated[float, Field(gt=0, le=60_000)] = 100.0
    """Samples are taken in the order of their stamps inside this window; later ones are dropped and counted."""
    standstill_s: Annotated[float, Field(gt=0, le=60)] | None = None
    """Tracks without a tick for this long before and after: the owner vouches that the robot stands. None: never."""
    standstill_rate_dps: NotNegative | None = None
    """... and that no body rate exceeds this then (vibration). Declared together with standstill_s."""
    standstill_way_m: NotNegative | None = None
    """... and that base_link is then, along any axis, no farther than this from where it was before in that time; not
    used by ellipsoids. None: its place is as little known as that of a robot whose tracks run to and fro in a tick."""
    wrong_fixes: Annotated[int, Field(ge=0, le=14)] = 0
    """GPS: so many of any `wrong_fixes_of` fixes in succession may be anywhere, and the pose still holds, without any
    fault being told. 0: each fix keeps its bound. Fixes that come too late or without a bound don't count."""
    wrong_fixes_of: Annotated[int, Field(ge=8, le=60)] = 20
    """At least 4 wrong_fixes + 4, for fixes to be of use."""
    fault_start_s: Annotated[float, Field(gt=0, le=60)] = 3.0
    """A sensor that breaks its bound contradicts the others this soon; what was said meanwhile is then in doubt."""
    fault_length_s: Annotated[float, Field(gt=0, le=600)] = 10.0
    """... and keeps its bound again after so long; until then it is not believed."""
    history_s: Annotated[float, Field(gt=0, le=600)] = 5.0
    """How long past poses are kept for scans that wait."""

    @model_validator(mode="after")
    def _standing_is_declared_whole(self) -> Self:
        if (self.standstill_s is None) != (self.standstill_rate_dps is None):
            raise ValueError("standstill_s and standstill_rate_dps: declare both, or neither")
        if self.standstill_way_m is not None and self.standstill_s is None:
            raise ValueError("standstill_way_m: declare standstill_s and standstill_rate_dps too")
        return self

    @model_validator(mode="after")
    def _fixes_remain(self) -> Self:
        if self.wrong_fixes and self.wrong_fixes_of < (least := 4 * self.wrong_fixes + 4):
            raise ValueError(
                f"wrong_fixes = {self.wrong_fixes} needs wrong_fixes_of >= {least} (it is {self.wrong_fixes_of}): too "
                "few fixes would be left to say anything"
            )
        return self
