"""`terrabound decode`: raw bytes of one device from a file, as JSON Lines."""

import sys
from collections.abc import Iterator
from io import BufferedReader
from pathlib import Path
from typing import Annotated, Literal, TypeAlias, cast

from cyclopts import App, Parameter

from drivers.errors import CaptureError
from drivers.sick_lms.telegrams import Variant
from service.json_lines import counts_line, print_samples
from service.live_line import LiveLine
from service.passive import (
    NO_LINE,
    EncodersFile,
    GpsFile,
    ImuFile,
    LmsFile,
    PassiveDecoder,
    encoders_config,
    gps_config,
    read_dbc,
    understood,
    why_nothing,
)

CHUNK_BYTES = 1 << 16
_PACKETS = "they are a packet capture (pcap): give the bytes that the device sent, as `tshark -z follow,...,raw` does"
_CAN_LOG = "they are another program's CAN log: make one to decode with python-can, python -m can.logconvert FILE x.log"
OTHER_FILES = {
    b"\x89MCAP": "it is a capture: terrabound replay",
    b"\x1f\x8b": "they are compressed: gzip -dc FILE | terrabound decode ... -",
    b"BZh": "they are compressed: bzip2 -dc FILE | terrabound decode ... -",
    b"\x28\xb5\x2f\xfd": "they are compressed: zstd -dc FILE | terrabound decode ... -",
    b"\xfd7zXZ": "they are compressed: xz -dc FILE | terrabound decode ... -",
    b"PK\x03\x04": "they are compressed: unzip -p FILE | terrabound decode ... -",
    b"\xff\xfe": "they are text in UTF-16: give the bytes as the port gave them",
    b"LOGG": _CAN_LOG,
    b"date ": _CAN_LOG,
    b"timestam": _CAN_LOG,
    b";$FILEVE": _CAN_LOG,
    b"\xd4\xc3\xb2\xa1": _PACKETS,
    b"\x4d\x3c\xb2\xa1": _PACKETS,
    b"\x0a\x0d\x0d\x0a": _PACKETS,
}
"""What files that people take for raw bytes begin with."""

File: TypeAlias = Annotated[Path, Parameter(allow_leading_hyphen=True)]
MeasuringMode: TypeAlias = Literal[0, 1, 2, 3, 4, 5, 6, 15]
LmsVariant: TypeAlias = Literal["180/1", "180/0.5", "100/1", "100/0.5", "100/0.25", "90/0.5"]

app = App(
    name="decode",
    help="Raw bytes of one device, from a file, as JSON Lines on standard output; counts go to standard error.",
    help_epilogue=(
        "FILE may be - for standard input. One JSON object a line; absent values are null. Bytes of a drive that was "
        "recorded as .mcap: terrabound replay. Try: terrabound decode gps receiver.nmea | head -3"
    ),
)


@app.command
def lms(file: File, /, *, measuring_mode: MeasuringMode | None = None, variant: LmsVariant | None = None) -> int:
    """Scans of a SICK LMS2xx, from all that the scanner sent.

    {"kind":"scan","stamp_ns":0,"angle_min_rad":..,"angle_increment_rad":..,"ranges_m":[2.623,null,..],"status":16}

    Angles count from straight ahead to the left; null is a beam without distance. A file doesn't tell when the bytes
    came, so stamp_ns is 0.

    Parameters
    ----------
    file
        The bytes as the serial port gave them.
    measuring_mode
        The scanner's measuring mode, which tells how many bits of a value are distance. Without it, it is taken from
        configuration or status telegrams in the file, or else inferred from the values.
    variant
        Angle and resolution that sub-ranges belong to, in degrees. Without it, it is taken from status or variant
        telegrams, whole scans or the power-on string in the file; a sub-range before them is counted, not guessed.
    """
    return _decode(LmsFile(measuring_mode, None if variant is None else Variant.named(variant)), file)


@app.command
def encoders(file: File, /, *, dbc: Path, left: str, right: str) -> int:
    """Track counters in CAN frames, from slcan text or candump's lines (`-l`, `-L`, or as shown); found out by itself.

    {"kind":"ticks","stamp_ns":..,"left":..,"right":..}

    Counts are raw integers, unwrapped. stamp_ns is the time of candump's line, 0 where it has none, as in slcan text.

    Parameters
    ----------
    file
        What the slcan adapter sent, or candump.
    dbc
        DBC file that describes the messages.
    left
        MESSAGE.SIGNAL of the left track's counter.
    right
        MESSAGE.SIGNAL of the right track's counter.
    """
    return _decode(EncodersFile(encoders_config(left, right), read_dbc(dbc)), file)


@app.command
def imu(file: File, /) -> int:
    """Inertial messages of a MAVLink stream (versions 1 and 2).

    {"kind":"inertial","stamp_ns":..,"message":"RAW_IMU","id":0,"accel_mps2":[x,y,z],"gyro_rps":[x,y,z],"tilt_rad":[roll,pitch]}

    Axes are x ahead, y left, z up; absent ones are null. stamp_ns is the board's own clock.

    Parameters
    ----------
    file
        The bytes as the serial port gave them.
    """
    return _decode(ImuFile(), file)


@app.command
def gps(file: File, /, *, gst_factor: float = 5.0, range_error_m: float = 5.0) -> int:
    """Fixes of a GPS receiver, one for each epoch with a valid position, from NMEA 0183 sentences.

    {"kind":"fix","stamp_ns":..,"utc":"..","lat_deg":..,"lon_deg":..,"alt_m":..,"quality":..,"hdop":..,"bound_m":[e,n,u]}

    alt_m is above the WGS-84 ellipsoid. stamp_ns is the fix's UTC since 1970, or 0 while no date was told. bound_m
    holds half-widths, which are as good as the two factors below.

    Parameters
    ----------
    file
        The bytes as the serial port gave them.
    gst_factor
        Half-width in standard deviations, where the receiver sends them (GST).
    range_error_m
        Half-width for each unit of HDOP, where it doesn't.
    """
    return _decode(GpsFile(gps_config(gst_factor, range_error_m)), file)


def _decode(decoder: PassiveDecoder, file: Path) -> int:
    """Print what the decoder finds, a chunk at a time, however long the file is."""
    printed = byte_count = 0
    head = b""
    stream, live = _open(file), LiveLine()
    try:
        for data in _chunks(file, stream):
            byte_count += len(data)
            head = head or data[:8]
            printed += print_samples(decoder.receive_data(data))
            live.show(f"{file}: {printed} lines from {byte_count / 1e6:.1f} MB")
        printed += print_samples(decoder.finish())
    finally:
        live.clear()
        print(counts_line(byte_count, printed, decoder.counts), file=sys.stderr)
    if printed:
        return 0
    if understood(decoder.counts):
        print(f"terrabound: {file}: {NO_LINE}", file=sys.stderr)
        return 0
    why = next((what for magic, what in OTHER_FILES.items() if head.startswith(magic)), why_nothing(decoder.counts))
    why = why or "are they of this device?"
    said = f"nothing in these bytes could be decoded; {why}" if byte_count else "is empty; give a file of raw bytes"
    print(f"terrabound: {file}: {said}", file=sys.stderr)
    return 1


def _open(file: Path) -> BufferedReader:
    """The file, or standard input."""
    if str(file) == "-":
        if sys.stdin is None:
            raise CaptureError("-: standard input is closed; give a file of raw bytes")
        return cast(BufferedReader, sys.stdin.buffer)
    try:
        return file.open("rb")
    except OSError as error:
        raise _unreadable(file, error) from None


def _chunks(file: Path, stream: BufferedReader) -> Iterator[bytes]:
    """What the file holds; from a pipe what there is, at once."""
    try:
        while data := stream.read1(CHUNK_BYTES):
            yield data
    except OSError as error:
        raise _unreadable(file, error) from None


def _unreadable(file: Path, error: OSError) -> CaptureError:
    return CaptureError(f"{file}: cannot be read: {error.strerror}; give a file of raw bytes")
