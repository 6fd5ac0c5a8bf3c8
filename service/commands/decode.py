"""`terrabound decode`: raw bytes of one device from a file, as JSON Lines."""

import sys
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from drivers.errors import CaptureError
from service.json_lines import sample_line
from service.passive import DeviceKind, passive_decoder

CHUNK_BYTES = 4096


def decode(
    device: DeviceKind,
    file: Path,
    /,
    *,
    dbc: Path | None = None,
    left: str | None = None,
    right: str | None = None,
    unit: Annotated[str, Parameter(help="laser unit where the stream does not tell: cm or mm")] = "cm",
) -> int:
    """Decode raw bytes of one device into JSON Lines on standard output; counts go to standard error.

    Parameters
    ----------
    device
        lms, encoders, imu or gps.
    file
        Bytes as the port gave them; for encoders slcan text or a candump log; "-" reads standard input.
    dbc
        Encoders: the DBC file.
    left
        Encoders: MESSAGE.SIGNAL of the left counter.
    right
        Encoders: MESSAGE.SIGNAL of the right counter.
    """
    decoder = passive_decoder(device, dbc=dbc, left=left, right=right, unit=unit)
    try:
        stream = sys.stdin.buffer if str(file) == "-" else file.open("rb")
    except OSError as error:
        raise CaptureError(f"{file}: cannot be read: {error.strerror}; give a file of raw bytes") from None
    with stream:
        # A file has no times of arrival: stamps count nanoseconds from its beginning, a chunk a step.
        while data := stream.read(CHUNK_BYTES):
            for sample in decoder.receive_data(data, 0):
                print(sample_line(sample))
    for sample in decoder.finish():
        print(sample_line(sample))
    print(decoder.summary(), file=sys.stderr)
    return 0
