"""The emulated scanner is as strict as the manual."""

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.sick_lms.measurements import CM, MM, TURN_NS
from drivers.sick_lms.stream import LmsStreamDecoder
from drivers.sick_lms.telegrams import (
    ACK,
    FAST,
    NAK,
    PASSWORD,
    Command,
    Configuration,
    DeviceStatus,
    DeviceType,
    Mode,
    Variant,
    answer,
    request,
)
from simulator.emulators.sick_lms import FACTORY_RECORD, SickLmsEmulator

MS = 1_000_000
START = 10**12


def no_echo(shots_ns: NDArray[np.int64], angles_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    """Nothing anywhere."""
    return np.full(len(angles_rad), np.nan)


def booted(baud: int = 38400, mode: Mode = Mode.STOP) -> SickLmsEmulator:
    """A scanner that somebody set up already."""
    emulator = SickLmsEmulator(no_echo, start_ns=START)
    emulator.leave_streaming(baud, mode)
    return emulator


def ask(emulator: SickLmsEmulator, payload: bytes, now_ns: int, wait_ms: int = 1000) -> bytes:
    """Everything the scanner says within `wait_ms` of a request."""
    emulator.data_to_send(now_ns)
    emulator.receive_data(request(payload), now_ns)
    return emulator.data_to_send(now_ns + wait_ms * MS)


def test_power_on_speaks_at_9600_after_booting() -> None:
    """Nothing is heard or said while it boots; then the type string comes, a byte a millisecond."""
    emulator = SickLmsEmulator(no_echo, start_ns=START, boot_ns=500 * MS, type_text="LMS200;301063;V02.10 ")

    assert ask(emulator, b"\x31", START, wait_ms=499) == b""
    assert len(emulator.data_to_send(START + 511 * MS)) == 10
    rest = emulator.data_to_send(START + 600 * MS)
    assert rest[-2:] == b"\x63\x5e"
    assert emulator.baud == 9600


def test_requests_are_acknowledged_then_answered() -> None:
    """ACK and the answer for a good request, NAK alone for a damaged one, silence for another's address."""
    emulator = booted()

    assert ask(emulator, b"\x32", START) == bytes((ACK,)) + answer(b"\xb2\x10")
    damaged = request(b"\x32")[:-1] + b"\x00"
    emulator.receive_data(damaged, START + 2000 * MS)
    assert emulator.data_to_send(START + 2100 * MS) == bytes((NAK,))
    emulator.receive_data(request(b"\x32", address=5), START + 3000 * MS)
    assert emulator.data_to_send(START + 3100 * MS) == b""


def test_a_request_that_stalls_is_dropped() -> None:
    """More than six milliseconds of silence inside a request, and its beginning is forgotten."""
    emulator = booted()
    data = request(b"\x32")

    emulator.receive_data(data[:3], START)
    emulator.receive_data(data[3:], START + 7 * MS)

    assert emulator.data_to_send(START + 100 * MS) == b""
    assert ask(emulator, b"\x32", START + 200 * MS)[:1] == bytes((ACK,))


@pytest.mark.parametrize("payload", [b"\x77" + FACTORY_RECORD, b"\x55", b"\x20\x99", b"\x3b\xb4"])
def test_impossible_requests_are_refused(payload: bytes) -> None:
    """Writing outside installation mode, unknown commands and missing parameters get ACK and 92h."""
    emulator = booted()

    assert ask(emulator, payload, START) == bytes((ACK,)) + answer(b"\x92\x10")
    assert emulator.eeprom_writes == 0


def test_the_configuration_is_written_in_installation_mode_only() -> None:
    """The right password opens the EEPROM; each write is counted, and echoed."""
    emulator = booted()
    wanted = Configuration(FACTORY_RECORD).with_format(0x05, 0)

    assert ask(emulator, b"\x20\x00SICK_PLS", START)[1:] == answer(b"\xa0\x01\x10")
    assert ask(emulator, b"\x20\x00" + PASSWORD, START + 2000 * MS)[1:] == answer(b"\xa0\x00\x10")
    written = ask(emulator, wanted.serialise_write(), START + 4000 * MS)

    assert written[1:] == answer(wanted.serialise_written(True))
    assert emulator.configuration == wanted
    assert emulator.eeprom_writes == 1


def test_180_degrees_at_a_quarter_is_refused() -> None:
    """BBh says no, and which variant stays."""
    emulator = booted()

    assert ask(emulator, Variant(180, 25).serialise_request(), START)[1:] == answer(
        Variant(180, 100).serialise_answer(False)
    )


def test_a_rate_change_is_answered_at_the_old_rate() -> None:
    """A0h still comes at the old rate, even if it is fetched late; then the scanner is at the new one."""
    emulator = booted(38400)

    said = ask(emulator, bytes((Command.MODE, Mode.BAUD_500000)), START)

    assert said == bytes((ACK,)) + answer(b"\xa0\x00\x10")
    assert emulator.baud == 38400
    emulator.data_to_send(START + 1000 * MS)
    assert emulator.baud == 500000
    status = DeviceStatus.parse(ask(emulator, b"\x31", START + 2000 * MS)[5:-2])
    assert status.baud == 500000


def test_a_request_cuts_the_scan_that_is_being_sent() -> None:
    """The scan's tail is never sent; the ACK comes right behind its last byte."""
    emulator = booted(38400, Mode.STREAM)
    emulator.data_to_send(START + TURN_NS)
    half_way = START + TURN_NS + 40 * MS

    scan = emulator.data_to_send(half_way)
    said = ask(emulator, bytes((Command.MODE, Mode.STOP)), half_way)

    assert 150 <= len(scan) <= 154
    assert said[-10:] == bytes((ACK,)) + answer(b"\xa0\x00\x10")
    assert len(said) <= 11


def test_a_long_telegram_comes_in_two_bursts() -> None:
    """At 500000 baud 508 bytes of a half-degree scan leave in the first mirror turn, the rest in the next."""
    emulator = SickLmsEmulator(no_echo, start_ns=START)
    emulator.leave_streaming(500000, variant=Variant(180, 50))
    begin = START + 2 * TURN_NS

    assert len(emulator.data_to_send(begin)) == 0
    assert len(emulator.data_to_send(begin + 20_000)) == 1
    assert len(emulator.data_to_send(begin + TURN_NS)) == 507
    assert len(emulator.data_to_send(begin + TURN_NS + 10 * MS)) == 732 - 508


def by_angle(shots_ns: NDArray[np.int64], angles_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    """A distance for each eighth of a degree: 7.2 m straight ahead."""
    return 7.2 + np.degrees(angles_rad) / 100


@pytest.mark.parametrize(
    ("mode", "data", "first_deg", "count"),
    [
        (Mode.STREAM, "", -90, 361),
        (Mode.STREAM_MEAN, "05", -90, 361),
        (Mode.STREAM_SUB_RANGE, "0B00 6400", -85, 90),
        (Mode.STREAM_SUB_RANGE_MEAN, "03 0B00 6400", -85, 90),
        (Mode.STREAM_PARTIAL, "", -90, 181),
        (Mode.STREAM_REFLECTIVITY, "0200 0100 0A00 6500 6901", -90, 10),
    ],
)
@pytest.mark.parametrize("unit", [CM, MM])
@pytest.mark.parametrize("measuring_mode", [0x01, 0x04, 0x06, 0x0F])
def test_every_stream_tells_what_was_measured(
    mode: Mode, data: str, first_deg: float, count: int, unit: int, measuring_mode: int
) -> None:
    """Modes, units, flags and indices of the configuration; the recording alone gives the scans back."""
    record = Configuration(FACTORY_RECORD[:4] + b"\x02" + FACTORY_RECORD[5:]).with_format(measuring_mode, unit).record
    emulator = SickLmsEmulator(by_angle, start_ns=START, record=record, flags=0b111)
    emulator.leave_streaming(500000, Mode.STOP, Variant(180, 50))
    said = ask(emulator, bytes((Command.STATUS,)), START)
    said += ask(emulator, bytes((Command.MODE, mode)) + bytes.fromhex(data), START + 2000 * MS)
    decoder = LmsStreamDecoder()

    scans = decoder.receive_data(said) + decoder.finish()

    assert len(scans) >= 4
    assert decoder.counts["undecoded_scans"] == decoder.counts["lost_telegrams"] == 0
    first = next(scan for scan in scans if len(scan.ranges_m) == count)  # partial scans begin with any quarter
    assert np.degrees(first.angle_min_rad) == pytest.approx(first_deg)
    for scan in scans:
        angles_deg = np.degrees(scan.angle_min_rad + scan.angle_increment_rad * np.arange(len(scan.ranges_m)))
        assert scan.ranges_m == pytest.approx(7.2 + angles_deg / 100, abs=0.0051 if unit == CM else 0.00051)


@pytest.mark.parametrize(
    ("payload", "count", "step_deg"),
    [("30 01", 361, 0.5), ("30 06", 181, 1), ("30 07", 19, 10), ("36 02", 361, 0.5), ("37 01 00 05 00", 5, 0.5)],
)
def test_single_scans_are_answered(payload: str, count: int, step_deg: float) -> None:
    """30h, 36h and 37h give one telegram, once the mirror has turned often enough."""
    emulator = SickLmsEmulator(by_angle, start_ns=START)
    emulator.leave_streaming(500000, Mode.STOP, Variant(180, 50))
    decoder = LmsStreamDecoder(measuring_mode=0x00, variant=Variant(180, 50))

    scans = decoder.receive_data(ask(emulator, bytes.fromhex(payload), START)) + decoder.finish()

    (scan,) = scans
    assert len(scan.ranges_m) == count
    assert np.degrees(scan.angle_increment_rad) == pytest.approx(step_deg)


def test_the_lms_fast_sends_reflectivity_and_knows_no_variants() -> None:
    """50h streams C4h, 3Bh is refused, and so is what only the others know."""
    emulator = SickLmsEmulator(by_angle, start_ns=START, type_text="LMS291;S14   ;V02.30 ")
    emulator.leave_streaming(500000, Mode.STOP, FAST)

    assert ask(emulator, Variant(180, 50).serialise_request(), START)[1:] == answer(b"\x92\x10")
    assert ask(emulator, bytes.fromhex("20 2B 0100 0100 0A00"), START + 2000 * MS)[1:] == answer(b"\x92\x10")
    said = ask(emulator, bytes.fromhex("20 50 0100 B500"), START + 4000 * MS)
    decoder = LmsStreamDecoder(measuring_mode=0x00)
    scan = decoder.receive_data(said)[0]

    assert np.degrees(scan.angle_min_rad) == pytest.approx(-45)
    assert len(scan.ranges_m) == 181


def test_the_rate_may_survive_the_power() -> None:
    """66h, in installation mode alone, makes the EEPROM keep the rate."""
    emulator = booted(38400)

    assert ask(emulator, b"\x66\x01", START)[1:] == answer(b"\x92\x10")
    ask(emulator, b"\x20\x00" + PASSWORD, START + 2000 * MS)
    assert ask(emulator, b"\x66\x01", START + 4000 * MS)[1:] == answer(b"\xe6\x01\x10")
    emulator.switch_off_and_on(START + 6000 * MS)

    assert emulator.eeprom_writes == 1
    assert emulator.data_to_send(START + 8000 * MS) == answer(DeviceType("LMS221;302063;V02.30 ").serialise(0x90))
    assert emulator.baud == 38400


def test_no_scan_is_measured_in_installation_mode() -> None:
    """Measuring stops until the mode is left; a wrong password does not open it."""
    emulator = booted(38400, Mode.STREAM)

    assert ask(emulator, b"\x20\x30SICK_PLS", START)[-9:] != answer(b"\xa0\x00\x10")
    ask(emulator, b"\x20\x00" + PASSWORD, START + 2000 * MS)
    assert emulator.data_to_send(START + 9000 * MS) == b""
    assert ask(emulator, b"\x30\x01", START + 9000 * MS)[1:] == answer(b"\x92\x10")


def test_the_status_byte_may_be_xon() -> None:
    """A scanner with an info entry says 11h in every telegram."""
    emulator = SickLmsEmulator(no_echo, start_ns=START, status=0x11)
    emulator.leave_streaming(38400, Mode.STOP)

    assert ask(emulator, b"\x32", START)[1:] == answer(b"\xb2\x11")


def test_a_reset_starts_over_at_9600() -> None:
    """91h at the old rate, then, after booting, 90h at 9600, and the stream is off."""
    emulator = booted(38400, Mode.STREAM)

    said = ask(emulator, bytes((Command.RESET,)), START, wait_ms=40)
    assert said.endswith(answer(b"\x91\x10"))
    emulator.data_to_send(START + 100 * MS)
    assert emulator.baud == 9600
    assert not emulator.streaming
    assert emulator.data_to_send(START + 2000 * MS)[4] == 0x90
