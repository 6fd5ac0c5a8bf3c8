"""`terrabound listen`: one device on a live port, as JSON Lines."""

import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Literal, TypeAlias

from cyclopts import App, Parameter, validators

from drivers.gps_nmea.protocol import GpsProtocol
from drivers.imu.protocol import ImuProtocol
from drivers.protocol import DeviceProtocol
from drivers.samples import Sample
from drivers.sick_lms.protocol import SickLmsProtocol
from drivers.socketcan import open_socketcan
from drivers.track_encoders.protocol import TrackEncoderProtocol
from drivers.transports import Transport, open_serial
from service.devices import NOW_OR_LATER
from service.json_lines import counts_line, print_samples
from service.lifecycle import stop_on_signals
from service.live_line import LiveLine
from service.passive import (
    NO_LINE,
    encoders_config,
    gps_config,
    imu_config,
    laser_config,
    read_dbc,
    understood,
    why_nothing,
)

LONGEST_READ_S = 0.05
"""A read returns at least this often, so that deadlines and Ctrl-C are seen."""

Seconds: TypeAlias = Annotated[float | None, Parameter(validator=validators.Number(gt=0))]
Baud: TypeAlias = Annotated[int, Parameter(validator=validators.Number(gt=0))]

app = App(
    name="listen",
    help="One device on a live port, as JSON Lines on standard output, until Ctrl-C; counts go to standard error.",
    help_epilogue=(
        "The lines are those of `terrabound decode`; stamp_ns is the host's monotonic clock, the middle of when it may "
        "have been. Ports that are in use by another process (a running service) are refused. Try it without hardware: "
        "terrabound emulate imu --link imu, and elsewhere: terrabound listen imu imu | head -3"
    ),
)


@app.command
def lms(
    port: str,
    /,
    *,
    baud: Literal[9600, 19200, 38400, 500000] = 500000,
    scan_angle: Literal[90, 100, 180] = 180,
    resolution: Literal["0.25", "0.5", "1"] = "1",
    unit: Literal["mm", "cm"] | None = None,
    configure: bool = False,
    seconds: Seconds = None,
) -> int:
    """Scans of a SICK LMS2xx: finds the scanner at whatever rate it speaks, sets it up, and lets it stream.

    A scan's stamp_ns is when its first mirror turn began.

    Parameters
    ----------
    port
        Serial port, as /dev/ttyUSB0.
    baud
        Rate to stream at; a port that can't run at 500000 needs 38400.
    scan_angle
        Degrees; 90 with resolution 0.5 for the LMS Fast.
    resolution
        Degrees from beam to beam.
    unit
        Unit of the distances on the wire; by default the one that the scanner is set to.
    configure
        Allow writing the scanner's EEPROM, where unit or measuring mode do not suit; without it they stay.
    seconds
        End by itself after so long.
    """
    units: tuple[Literal["mm", "cm"], ...] = ("mm", "cm") if unit is None else (unit,)
    protocols = [SickLmsProtocol(laser_config(baud, scan_angle, float(resolution), each, configure)) for each in units]
    return _listen(lambda: open_serial(port, baud), protocols, seconds)


@app.command
def encoders(
    port: str,
    /,
    *,
    dbc: Path,
    left: str,
    right: str,
    interface: Literal["slcan", "socketcan"] = "slcan",
    bitrate: Literal[125000, 250000, 500000, 1000000] = 500000,
    baud: Baud = 115200,
    seconds: Seconds = None,
) -> int:
    """Track counters in CAN frames, behind an slcan adapter (which is opened) or on a CAN interface of the kernel.

    Parameters
    ----------
    port
        Serial port of the slcan adapter, or with --interface socketcan the interface's name, as can0.
    dbc
        DBC file that describes the messages.
    left
        MESSAGE.SIGNAL of the left track's counter.
    right
        MESSAGE.SIGNAL of the right track's counter.
    interface
        What the port is.
    bitrate
        Of the CAN bus, in bit/s.
    baud
        Rate of the serial line to the adapter; one on USB doesn't care.
    seconds
        End by itself after so long.
    """
    protocol = TrackEncoderProtocol(encoders_config(left, right, interface, bitrate), read_dbc(dbc))
    if interface == "socketcan":
        return _listen(lambda: open_socketcan(port, bitrate, protocol.messages), [protocol], seconds)
    return _listen(lambda: open_serial(port, baud), [protocol], seconds, baud)


@app.command
def imu(port: str, /, *, baud: Baud = 115200, seconds: Seconds = None) -> int:
    """Inertial messages of a board that speaks MAVLink (versions 1 and 2).

    Parameters
    ----------
    port
        Serial port, as /dev/ttyACM0.
    baud
        Line rate.
    seconds
        End by itself after so long.
    """
    return _listen(lambda: open_serial(port, baud), [ImuProtocol(imu_config(baud))], seconds)


@app.command
def gps(
    port: str,
    /,
    *,
    baud: Baud = 115200,
    gst_factor: float = 5.0,
    range_error_m: float = 5.0,
    seconds: Seconds = None,
) -> int:
    """Fixes of a GPS receiver that speaks NMEA 0183.

    Parameters
    ----------
    port
        Serial port, as /dev/ttyUSB0.
    baud
        Line rate; many receivers speak at 4800, 9600 or 38400.
    gst_factor
        Half-width in standard deviations, where the receiver sends them (GST).
    range_error_m
        Half-width for each unit of HDOP, where it doesn't.
    seconds
        End by itself after so long.
    """
    protocol = GpsProtocol(gps_config(gst_factor, range_error_m, baud), NOW_OR_LATER)
    return _listen(lambda: open_serial(port, baud), [protocol], seconds)


def _listen(
    open_port: Callable[[], Transport],
    candidates: Sequence[DeviceProtocol[Sample]],
    seconds: float | None,
    baud: int | None = None,
) -> int:
    """Print what the device sends until the end; the next candidate speaks where the one before gave up.

    `baud`, where given, stands in place of the rate that the protocol wants.
    """
    ended = threading.Event()
    until_ns = None if seconds is None else time.monotonic_ns() + round(seconds * 1e9)
    printed = 0
    wire = _Wire(open_port(), ended, until_ns, baud)
    protocol, *others = candidates
    live = LiveLine()
    try:
        with stop_on_signals(ended):
            while True:
                for samples in wire.converse(protocol):
                    printed += print_samples((sample.stamp.mid_ns, sample) for sample in samples)
                    live.show(f"{wire.port}: {printed} lines from {wire.byte_count} bytes; Ctrl-C ends it")
                if ended.is_set() or not others or not _halted(protocol):
                    break
                protocol, *others = others
    finally:
        wire.close()
        live.clear()
        print(counts_line(wire.byte_count, printed, protocol.counts), file=sys.stderr)
    if _halted(protocol):
        print(f"terrabound: {wire.port}: {getattr(protocol, 'state', '')}", file=sys.stderr)
        return 1
    if printed:
        return 0
    if understood(protocol.counts):
        print(f"terrabound: {wire.port}: {NO_LINE}", file=sys.stderr)
        return 0
    print(f"terrabound: {wire.port}: {_why_nothing(wire.byte_count, protocol)}", file=sys.stderr)
    return 1


class _Wire:
    """An open port, until Ctrl-C or the end of the time."""

    def __init__(
        self, transport: Transport, ended: threading.Event, until_ns: int | None, baud: int | None = None
    ) -> None:
        self.port = transport.name
        self.byte_count = 0
        self._transport, self._ended, self._until_ns, self._baud = transport, ended, until_ns, baud

    def converse(self, protocol: DeviceProtocol[Sample]) -> Iterator[list[Sample]]:
        """Carry bytes between port and protocol, until the end or until the device can't do what is asked of it."""
        protocol.connection_made(time.monotonic_ns())
        while not self._over() and not _halted(protocol):
            if request := protocol.data_to_send():
                self._transport.write(request)
            if (baud := self._baud or protocol.baud) is not None:
                self._transport.set_baud(baud)
            data = self._transport.read(_patience_s(protocol.deadline_ns))
            now_ns = self._transport.read_ns if data else time.monotonic_ns()
            if protocol.deadline_ns is not None and protocol.deadline_ns <= now_ns:
                protocol.advance(now_ns)
            self.byte_count += len(data)
            if data:
                yield list(protocol.receive_data(data, self._transport.received_ns or now_ns))

    def close(self) -> None:
        """Let go of the port."""
        self._transport.close()

    def _over(self) -> bool:
        return self._ended.is_set() or (self._until_ns is not None and time.monotonic_ns() >= self._until_ns)


def _patience_s(deadline_ns: int | None) -> float:
    """How long a read may wait."""
    if deadline_ns is None:
        return LONGEST_READ_S
    return min(max((deadline_ns - time.monotonic_ns()) * 1e-9, 0.0), LONGEST_READ_S)


def _halted(protocol: DeviceProtocol[Sample]) -> bool:
    """Can the device not do what is asked of it? Only the scanner is asked for anything that it could refuse."""
    return str(getattr(protocol, "state", "")).startswith("halted")


def _why_nothing(byte_count: int, protocol: DeviceProtocol[Sample]) -> str:
    """What to look at when no sample came."""
    if byte_count == 0:
        return "nothing came; check the device's power, its cable, and that it is this port"
    state = getattr(protocol, "state", None)
    if why := why_nothing(protocol.counts):
        return why
    where = f" (at the end: {state})" if state else ""
    return f"bytes came, but no sample{where}; check the rate (--baud) and that this device is on this port"
