"""At which rate does a device speak that is not understood at the configured one?"""

import time

from drivers.errors import PortError
from service.devices import Device

RATES = (4800, 9600, 19200, 38400, 57600, 115200, 230400, 460800, 921600)
LISTEN_S = 1.3
"""Longer than the second between the fixes of a slow receiver."""
UNDERSTOOD = ("sentences", "frames")
"""What drivers count that passed its checksum."""


def rate_that_is_understood(device: Device) -> int | None:
    """The first rate at which two whole frames come; None where none does, or the wire has no rate to set.

    Only listens: for devices that speak by themselves. Nobody else may have the port open.
    """
    configured = device.protocol().baud
    if configured is None:
        return None
    for rate in RATES:
        if rate != configured and _is_understood(device, rate):
            return rate
    return None


def _is_understood(device: Device, rate: int) -> bool:
    protocol = device.protocol()
    try:
        transport = device.open()
    except PortError:
        return False
    try:
        transport.set_baud(rate)
        protocol.connection_made(time.monotonic_ns())
        until_s = time.monotonic() + LISTEN_S
        while (left_s := until_s - time.monotonic()) > 0:
            protocol.receive_data(transport.read(left_s), time.monotonic_ns())
            if sum(protocol.counts[name] for name in UNDERSTOOD) >= 2:
                return True
    except PortError:
        return False
    finally:
        transport.close()
    return False
