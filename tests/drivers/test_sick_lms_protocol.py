"""Driver and emulated scanner, wired mouth to mouth in virtual time."""

from collections import Counter, deque
from collections.abc import Callable
from dataclasses import replace
from random import Random
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.config import LaserConfig
from drivers.samples import Scan
from drivers.sick_lms.error_memory import ErrorEntry
from drivers.sick_lms.findings import status_findings
from drivers.sick_lms.framing import Frame
from drivers.sick_lms.measurements import CM, MM, TURN_NS
from drivers.sick_lms.protocol import SickLmsProtocol
from drivers.sick_lms.range_telegrams import RangeTelegram
from drivers.sick_lms.sent_times import SentTimes
from drivers.sick_lms.startup import STEPS, TRANSITIONS, WAITS_MS, Outcome, State
from drivers.sick_lms.telegrams import PASSWORD, POWER_ON, VARIANTS, Command, DeviceType, Mode, Variant, answer, request
from simulator.emulators.sick_lms import FACTORY_RECORD, SickLmsEmulator
from simulator.line_faults import KINDS, LINES, Fault, damage

MS = 1_000_000
S = 1000 * MS
CONFIG = LaserConfig(
    port="/dev/laser",
    latency_ms=(0.0, 6.0),
    range_bound_m=0.066,
    angle_bound_deg=0.5,
    mount_x_m=0.0,
    mount_y_m=0.0,
    mount_z_m=0.468,
    mount_pitch_deg=-10.0,
    mount_position_bound_m=0.0,
    mount_angle_bound_deg=0.0,
)
SERVING_RECORD = FACTORY_RECORD[:5] + bytes((0x06,)) + FACTORY_RECORD[6:]


class World:
    """Ranges that tell which measurement they belong to, and when each beam was really shot."""

    def __init__(self) -> None:
        self.nearest_m = 1.0
        self.shots_ns: list[NDArray[np.int64]] = []
        self.ranges_m: list[NDArray[np.float64]] = []

    def measure(self, shots_ns: NDArray[np.int64], angles_rad: NDArray[np.float64]) -> NDArray[np.float64]:
        """A wall that moves away by a centimetre every scan."""
        ranges = self.nearest_m + 0.01 * len(self.shots_ns) + 0.1 * np.cos(angles_rad)
        self.shots_ns.append(shots_ns.copy())
        self.ranges_m.append(ranges)
        return ranges

    def index_of(self, scan: Scan) -> int:
        """Which measurement this scan is."""
        return round(float(scan.ranges_m[0] - self.nearest_m - 0.1 * np.cos(scan.angle_min_rad)) * 100)


class Wire:
    """A line between both, read every few milliseconds; bytes at different rates arrive as noise."""

    def __init__(self, config: LaserConfig = CONFIG, start_ns: int = 10**15, **emulator: Any) -> None:
        self.world = World()
        self.emulator = SickLmsEmulator(self.world.measure, start_ns=start_ns, **emulator)
        self.protocol = SickLmsProtocol(config)
        self.now_ns = start_ns
        self.scans: list[Scan] = []
        self.states: list[str] = []
        self.baud_at_sends: list[int] = []
        self.requests: deque[bytes] = deque(maxlen=1000)
        self.to_scanner: Callable[[bytes], bytes] = lambda data: data
        self.to_host: Callable[[bytes], bytes] = lambda data: data
        self._rng = np.random.default_rng(0)

    def _at_rate(self, data: bytes) -> bytes:
        return data if self.emulator.baud == self.protocol.baud else self._rng.bytes(len(data))

    def run(self, seconds: float, until: Callable[[], bool] = lambda: False) -> None:
        """Let virtual time pass."""
        end = self.now_ns + int(seconds * S)
        while self.now_ns < end and not until():
            self.now_ns += int(self._rng.integers(MS, 5_900_000))
            if data := self.to_host(self._at_rate(self.emulator.data_to_send(self.now_ns))):
                self.scans += self.protocol.receive_data(data, self.now_ns)
            elif self.protocol.deadline_ns <= self.now_ns:
                self.protocol.advance(self.now_ns)
            if request := self.protocol.data_to_send():
                self.requests.append(request)
                self.emulator.receive_data(self._at_rate(self.to_scanner(request)), self.now_ns)
            if not self.states or self.states[-1] != self.protocol.state:
                self.states.append(self.protocol.state)

    def start(self, seconds: float = 10.0) -> None:
        """Run until scans flow."""
        self.run(seconds, until=lambda: bool(self.scans))
        assert self.scans, (self.protocol.state, self.protocol.counts)

    def check_scans(self) -> None:
        """Every scan is one that was really taken, with its values, and no later one is missing between them."""
        indices = [self.world.index_of(scan) for scan in self.scans]
        assert indices == list(range(indices[0], indices[0] + len(indices)))
        for scan, i in zip(self.scans, indices, strict=True):
            assert np.abs(scan.ranges_m - self.world.ranges_m[i]).max() <= 0.0005 + 1e-12
            shots = self.world.shots_ns[i]
            assert np.all(scan.stamp.earliest_ns + scan.beam_offset_ns <= shots)
            assert np.all(shots <= scan.stamp.latest_ns + scan.beam_offset_ns)


def test_a_scanner_that_powers_up_streams_true_scans_with_true_stamps() -> None:
    """From power-on at 9600 baud to scans at 500000: right ranges, and every stamp contains its shots."""
    wire = Wire()

    wire.start()
    wire.run(1.0)

    assert wire.protocol.state == "streaming"
    assert wire.protocol.baud == wire.emulator.baud == 500000
    assert 74 <= len(wire.scans) <= 77
    wire.check_scans()
    assert wire.protocol.identity is not None
    assert wire.protocol.identity.type == "LMS221;302063"
    assert wire.protocol.identity.firmware == "V02.30"
    assert wire.protocol.identity.serial == "00410123"


@pytest.mark.parametrize(
    ("angle", "resolution", "count", "hertz"),
    [(180, 1.0, 181, 75), (180, 0.5, 361, 37.5), (100, 1.0, 101, 75), (100, 0.5, 201, 37.5), (100, 0.25, 401, 18.8)],
)
def test_every_variant_streams_at_its_rate(angle: Any, resolution: float, count: int, hertz: float) -> None:
    """Count, rate, values and stamps are right for each angle and resolution."""
    wire = Wire(replace(CONFIG, scan_angle_deg=angle, resolution_deg=resolution), record=SERVING_RECORD)

    wire.start()
    wire.scans.clear()
    wire.run(1.0)

    assert len(wire.scans) == pytest.approx(hertz, abs=1.5)
    assert {len(scan.ranges_m) for scan in wire.scans} == {count}
    wire.check_scans()


def test_quarter_degrees_over_180_come_as_interlaced_turns() -> None:
    """180 degrees at 0.25 degree: each mirror turn is a scan of its own, shifted by a quarter of a degree."""
    wire = Wire(replace(CONFIG, resolution_deg=0.25), record=SERVING_RECORD)

    wire.start()
    wire.run(1.0)

    assert len(wire.scans) == pytest.approx(75, abs=2)
    first_cdeg = [round(np.degrees(scan.angle_min_rad) * 100) + 9000 for scan in wire.scans[:8]]
    at = first_cdeg.index(0)
    assert first_cdeg[at : at + 4] == [0, 25, 50, 75]
    assert {len(scan.ranges_m) for scan in wire.scans} == {180, 181}
    wire.check_scans()


@pytest.mark.parametrize(
    ("baud", "resolution", "period_turns"),
    [(38400, 1.0, 8), (38400, 0.5, 16), (19200, 1.0, 15), (9600, 1.0, 30), (9600, 0.5, 58)],
)
def test_a_slow_line_skips_turns_as_the_manual_says(baud: Any, resolution: float, period_turns: int) -> None:
    """The scan period on a slow line is the manual's multiple of the mirror turn, and stamps stay true."""
    wire = Wire(replace(CONFIG, baud=baud, resolution_deg=resolution), record=SERVING_RECORD)

    wire.start(15.0)
    wire.run(4.0)

    wire.check_scans()
    begins = [int(wire.world.shots_ns[wire.world.index_of(scan)][0]) for scan in wire.scans]
    assert set(np.diff(begins)) == {period_turns * TURN_NS}


@pytest.mark.parametrize("baud", [9600, 19200, 38400, 500000])
def test_a_scanner_left_streaming_is_found_and_set_up(baud: int) -> None:
    """Whatever rate and variant a crashed driver left behind, scans come within five seconds."""
    wire = Wire(record=SERVING_RECORD)
    wire.emulator.leave_streaming(baud, variant=Variant(180, 50))
    wire.run(0.1)

    wire.start(5.0)
    wire.run(0.5)

    wire.check_scans()
    assert {len(scan.ranges_m) for scan in wire.scans} == {181}


def test_a_scanner_left_in_installation_mode_is_found() -> None:
    """The stop request also ends an installation mode that somebody left."""
    wire = Wire(record=SERVING_RECORD)
    wire.emulator.leave_streaming(38400, mode=Mode.INSTALLATION)

    wire.start(5.0)


@pytest.mark.parametrize("skip", range(13))
def test_a_missed_request_is_repeated(skip: int) -> None:
    """Whichever of the start-up requests the scanner misses, scans come, and the EEPROM is written once."""
    wire = Wire(record=FACTORY_RECORD)
    wire.emulator.leave_streaming(38400)
    heard = iter(range(100))

    def lose(data: bytes) -> bytes:
        if wire.emulator.baud == wire.protocol.baud and next(heard) == skip:
            wire.emulator.misses = 1
        return data

    wire.to_scanner = lose
    wire.start(10.0)

    wire.check_scans()
    assert wire.protocol.counts["repeats"] + wire.protocol.counts["restarts"] == 1
    assert wire.emulator.eeprom_writes == 1


def test_a_nak_is_answered_by_the_same_request_after_a_pause() -> None:
    """A request damaged on the line is NAKed and sent again 30 ms later, not at the end of a timeout."""
    wire = Wire(record=SERVING_RECORD)
    damaged: list[int] = []

    def damage(data: bytes) -> bytes:
        if data[4] == Command.READ_CONFIGURATION and not damaged:
            damaged.append(wire.now_ns)
            return data[:-1] + bytes((data[-1] ^ 1,))
        if data[4] == Command.READ_CONFIGURATION:
            damaged.append(wire.now_ns)
        return data

    wire.to_scanner = damage
    wire.start()

    assert wire.protocol.counts["naks"] == 1
    assert len(damaged) == 2
    assert 30 * MS <= damaged[1] - damaged[0] <= 60 * MS


def test_the_eeprom_is_written_only_on_a_difference() -> None:
    """The first start writes unit and measuring mode once; the second finds them right and writes nothing."""
    first = Wire(record=FACTORY_RECORD)
    first.start()

    second = Wire(record=first.emulator.configuration.record)
    second.start()

    assert first.emulator.eeprom_writes == 1
    assert first.emulator.configuration.measuring_mode == 0x06
    assert second.emulator.eeprom_writes == 0


def test_a_lost_answer_to_a_write_does_not_wear_the_eeprom() -> None:
    """When F7h is lost, the record is read again, not written again."""
    wire = Wire(record=FACTORY_RECORD)
    wire.to_host = lambda data: data if wire.protocol.state != State.WRITING_CONFIGURATION.value else b""

    wire.start(20.0)

    assert wire.emulator.eeprom_writes == 1


def test_a_lost_answer_to_the_start_costs_no_scan() -> None:
    """Scans that come instead of the awaited A0h are taken, and the start is not asked for again."""
    wire = Wire(record=SERVING_RECORD)

    def lose(data: bytes) -> bytes:
        return data.replace(answer(b"\xa0\x00\x10"), b"") if wire.protocol.state == State.STARTING.value else data

    wire.to_host = lose
    wire.run(10.0, until=lambda: wire.protocol.state == State.STARTING.value)
    asked = len(wire.requests)
    wire.start(1.0)

    assert len(wire.requests) == asked
    assert wire.world.index_of(wire.scans[0]) == 0
    wire.check_scans()


def test_a_measuring_mode_that_reaches_far_enough_is_left_alone() -> None:
    """Reflector flags do not matter: a mode with the needed reach is decoded as it is."""
    wire = Wire(replace(CONFIG, range_max_m=8.0), record=FACTORY_RECORD[:5] + b"\x01" + FACTORY_RECORD[6:])

    wire.start()
    wire.run(0.3)

    wire.check_scans()
    assert wire.emulator.eeprom_writes == 0


def test_another_unit_halts_where_writing_is_forbidden() -> None:
    """The declared range error holds for the declared unit alone: no scan in centimetres, no write, and a way out."""
    record = SERVING_RECORD[:6] + b"\x00" + SERVING_RECORD[7:]
    wire = Wire(replace(CONFIG, write_configuration=False), record=record)

    wire.run(6.0)

    assert wire.scans == []
    assert wire.emulator.eeprom_writes == 0
    assert "halted" in wire.protocol.state
    assert "write_configuration = true" in wire.protocol.state


def test_a_scanner_with_another_password_halts_with_a_way_out() -> None:
    """Its configuration can't be written: what is wrong and both ways to mend it are told, and nothing is worn out."""
    wire = Wire(config=replace(CONFIG, unit="cm", range_max_m=80.0))
    entry, wrong = (request(bytes((Command.MODE, Mode.INSTALLATION)) + word) for word in (PASSWORD, b"SICK_PLS"))
    wire.to_scanner = lambda data: wrong if data == entry else data
    wire.run(8.0, until=lambda: "halted" in wire.protocol.state)
    for words in ("the password is wrong", "SICK_LMS", "write_configuration = false"):
        assert words in wire.protocol.state
    assert wire.emulator.eeprom_writes == 0
    assert wire.scans == []


def test_a_shorter_reach_does_not_halt_where_writing_is_forbidden() -> None:
    """An 8 m measuring mode is used as it is, and told."""
    wire = Wire(replace(CONFIG, write_configuration=False), record=FACTORY_RECORD)

    wire.start()
    wire.run(0.3)

    wire.check_scans()
    assert wire.emulator.eeprom_writes == 0
    assert any("reaches 8.2 m, short of range_max_m" in finding for finding in wire.protocol.findings)


def test_a_spontaneous_reset_is_survived() -> None:
    """The scanner loses power while streaming: found again at 9600 baud, and back at 500000 by itself."""
    wire = Wire(record=SERVING_RECORD, boot_ns=3 * S)
    wire.start()
    wire.run(0.5)

    before = len(wire.scans)
    wire.emulator.switch_off_and_on(wire.now_ns)
    wire.run(12.0)

    assert wire.protocol.state == "streaming"
    assert wire.protocol.counts["restarts"] >= 1
    assert len(wire.scans) > before + 200
    for scan in wire.scans:
        shots = wire.world.shots_ns[wire.world.index_of(scan)]
        assert np.all(scan.stamp.earliest_ns + scan.beam_offset_ns <= shots)
        assert np.all(shots <= scan.stamp.latest_ns + scan.beam_offset_ns)


@pytest.mark.parametrize("phase_ms", [-6.66, 0.0, 6.66])
@pytest.mark.parametrize(("resolution", "baud"), [(1.0, 500000), (0.5, 500000), (0.25, 500000), (0.5, 38400)])
def test_stamps_contain_every_shot_whatever_the_mirrors_phase(phase_ms: float, resolution: float, baud: Any) -> None:
    """The manual does not tell when in the mirror's turn a telegram leaves: the default bound covers all of a turn."""
    config = replace(CONFIG, resolution_deg=resolution, baud=baud)
    wire = Wire(config, record=SERVING_RECORD, phase_ns=round(phase_ms * MS))

    wire.start()
    wire.run(1.0)

    wire.check_scans()


def test_a_declared_mirror_phase_narrows_the_stamps() -> None:
    """Who has measured the phase gets stamps as narrow as the latency, less what the line itself takes."""
    wire = Wire(replace(CONFIG, mirror_phase_ms=(2.0, 2.5)), record=SERVING_RECORD, phase_ns=2_200_000)

    wire.start()
    wire.run(1.0)

    wire.check_scans()
    widths = [scan.stamp.latest_ns - scan.stamp.earliest_ns for scan in wire.scans]
    assert max(widths) <= 6.6 * MS
    assert np.median(widths) < 6 * MS  # a read that holds n bytes of a telegram ended n byte times after its beginning


def test_stamps_never_run_backward_and_a_slow_adapter_is_told() -> None:
    """An adapter that gathers more than was declared still gives true stamps, in order, and is counted."""
    wire = Wire(replace(CONFIG, baud=38400, latency_ms=(0.0, 6.0)), record=SERVING_RECORD)
    wire.start()
    gathered = bytearray()

    def gather(data: bytes) -> bytes:
        gathered.extend(data)
        if len(gathered) < 62:
            return b""
        block = bytes(gathered)
        gathered.clear()
        return block

    wire.to_host = gather
    wire.run(5.0)

    wire.check_scans()
    for end in ("earliest_ns", "latest_ns"):
        ends = [getattr(scan.stamp, end) for scan in wire.scans]
        assert ends == sorted(ends)
    assert wire.protocol.counts["late_telegrams"] > 0
    assert any("latency_ms" in finding for finding in wire.protocol.findings)


def test_a_telegram_that_came_late_was_not_sent_before_the_one_ahead_of_it() -> None:
    """A late telegram may have been on its way for long, but not since before an earlier one began."""
    counts: Counter[str] = Counter()
    times = SentTimes(replace(CONFIG, latency_ms=(0.0, 6.0), mirror_phase_ms=(0.0, 0.0)), counts)
    punctual = times.of(Frame(b"\xb0", 1000 * MS, bytes_read=1, place=0), 20_000)
    late = times.of(Frame(b"\xb0", 1001 * MS, bytes_read=600, place=600), 20_000)

    assert counts["late_telegrams"] == 1
    assert late.earliest_ns == punctual.earliest_ns == 1000 * MS - 6 * MS - 20_000
    assert late.latest_ns == punctual.latest_ns


@pytest.mark.parametrize("length", [30, 32, 34])
def test_a_record_of_any_length_is_written_back_as_long_as_it_came(length: int) -> None:
    """Older firmware has shorter records: all bytes but unit and mode come back unchanged, and none is added."""
    wire = Wire(record=FACTORY_RECORD[:length])

    wire.start()

    writes = [data for data in wire.requests if data[4] == Command.WRITE_CONFIGURATION]
    assert [len(data) for data in writes] == [length + 7]
    assert wire.emulator.configuration.record == FACTORY_RECORD[:5] + b"\x06" + FACTORY_RECORD[6:length]
    assert wire.emulator.eeprom_writes == 1


def test_a_nak_of_a_write_is_no_write() -> None:
    """A write that was damaged on the line is sent again, and does not count against the EEPROM's allowance."""
    wire = Wire(record=FACTORY_RECORD)
    damaged = 0

    def damage(data: bytes) -> bytes:
        nonlocal damaged
        if data[4] == Command.WRITE_CONFIGURATION and damaged < 4:
            damaged += 1
            return data[:-1] + bytes((data[-1] ^ 1,))
        return data

    wire.to_scanner = damage
    wire.start()

    assert wire.protocol.counts["naks"] == 4
    assert wire.protocol.counts["configuration_writes"] == wire.emulator.eeprom_writes == 1
    assert wire.protocol.counts["restarts"] == 0


@pytest.mark.parametrize(
    ("type_text", "asks_hours"),
    [
        ("LMS200;301063;V02.19 ", False),
        ("LMS211;302063;V02.30 ", True),
        ("LMS220;301063;V02.10 ", False),
        ("LMS221;302063;V02.30 ", True),
        ("LMS291;S05   ;V02.30 ", True),
        ("LMS200;S18063;X01.27 ", False),
    ],
)
def test_every_type_is_set_up_and_asked_only_what_it_knows(type_text: str, asks_hours: bool) -> None:
    """Operating hours are read where the scanner counts them; the error memory always."""
    wire = Wire(type_text=type_text)

    wire.start()
    wire.run(0.2)

    asked = {data[4] for data in wire.requests}
    assert (Command.COUNTERS in asked) == asks_hours
    assert Command.ERRORS in asked
    assert wire.protocol.operating_hours == (0.0 if asks_hours else None)
    assert wire.protocol.counts["refusals"] == 0
    wire.check_scans()


FAST_TYPE = "LMS291;S14   ;V02.30 "


def test_the_lms_fast_streams_its_90_degrees() -> None:
    """It knows no other variant and does not know the request for one: it is not asked."""
    wire = Wire(replace(CONFIG, scan_angle_deg=90, resolution_deg=0.5), type_text=FAST_TYPE, record=SERVING_RECORD)

    wire.start()
    wire.run(1.0)

    assert len(wire.scans) == pytest.approx(75, abs=2)
    assert wire.protocol.counts["refusals"] == 0
    assert np.degrees(wire.scans[0].angle_min_rad) == pytest.approx(-45)
    wire.check_scans()


def test_the_wrong_scanner_halts_with_a_way_out() -> None:
    """An LMS Fast that shall scan 180 degrees, and another that shall scan 90: each says what to set."""
    fast = Wire(type_text=FAST_TYPE, record=SERVING_RECORD)
    slow = Wire(replace(CONFIG, scan_angle_deg=90, resolution_deg=0.5), record=SERVING_RECORD)

    fast.run(6.0)
    slow.run(6.0)

    assert fast.scans == slow.scans == []
    assert "scan_angle_deg = 90" in fast.protocol.state
    assert "can't scan 90 degrees" in slow.protocol.state


def test_what_ails_the_scanner_is_told() -> None:
    """Its error memory, a dirty window and implausible values reach people as sentences; the latter are not used."""
    errors = (ErrorEntry(4, 22, True), ErrorEntry(4, 49, True), ErrorEntry(1, 49, False))
    wire = Wire(record=SERVING_RECORD, status=0x11, errors=errors)
    wire.start()

    assert wire.protocol.findings == (
        "the scanner's error memory holds info 49 (laser power)",
        "the scanner had fatal error 22 (window dirty), fatal error 49 (laser power) in the past",
    )
    wire.emulator.status = 0xD2
    before = len(wire.scans)
    wire.run(0.5)
    wire.emulator.status = 0x11
    wire.run(0.1)
    counts = wire.protocol.counts
    assert counts["polluted_scans"] == counts["implausible_scans"] == counts["warned_scans"] > 30
    doubted = [scan for scan in wire.scans[before:] if scan.status == 0xD2]
    assert all(np.isnan(scan.ranges_m).all() for scan in doubted)
    assert not any("dirty: clean" in finding for finding in wire.protocol.findings)
    assert "the scanner's window is dirty: clean it" in list(status_findings(0xD2))


def test_lost_scans_are_counted_where_the_scanner_numbers_them() -> None:
    """With indices appended (block C), a scan that never came is known to have been sent."""
    wire = Wire(record=SERVING_RECORD[:4] + b"\x02" + SERVING_RECORD[5:])
    wire.start()
    wire.run(0.2)

    sent = iter(range(100000))
    wire.to_host = lambda data: data[:-1] if next(sent) % 40 == 20 else data
    wire.run(3.0)
    wire.to_host = lambda data: data
    wire.run(0.2)

    lost = wire.emulator.scans_sent - len(wire.scans)
    assert lost > 5
    assert wire.protocol.counts["lost_telegrams"] == pytest.approx(lost, abs=2)  # cut at either end


@pytest.mark.parametrize("fault", sorted(KINDS))
def test_a_bad_line_costs_the_live_driver_no_intact_scan(fault: str) -> None:
    """Every kind of line fault on a fifth of the telegrams of a running stream: all intact scans, no other ones."""
    wire = Wire(record=SERVING_RECORD)
    wire.start()
    wire.scans.clear()
    rng = np.random.default_rng(12)
    frames = [
        answer(RangeTelegram(rng.integers(0, 0x7FF0, 181).astype(np.uint16), MM).serialise()) for _ in range(1000)
    ]
    damaged = damage(frames, LINES["lms"], [Fault(fault)], seed=3)
    now_ns = wire.now_ns

    found: list[Scan] = []
    for chunk in damaged.chunks:
        now_ns += 2 * MS  # silences and merged writes end before anybody gets nervous
        found += wire.protocol.receive_data(chunk, now_ns)

    expected = [np.frombuffer(frame[7:-3], "<u2") & 0x7FFF for frame in damaged.intact(frames)]
    assert len(found) == len(expected)
    for scan, codes in zip(found, expected, strict=True):
        assert np.array_equal(scan.ranges_m, codes / 1000)
    assert wire.protocol.streaming


def test_a_power_on_string_ends_the_stream_at_once() -> None:
    """A scanner that says it was just switched on is set up anew without waiting for the watchdog."""
    wire = Wire(record=SERVING_RECORD)
    wire.start()

    wire.protocol.receive_data(answer(DeviceType("LMS221;302063;V02.30 ").serialise(POWER_ON)), wire.now_ns)

    assert wire.protocol.state == "finding the scanner at 500000 baud"
    assert wire.protocol.data_to_send() == request(bytes((Command.MODE, Mode.STOP)))


def test_only_scans_as_ordered_are_believed() -> None:
    """While streaming 181 values in millimetres, intact telegrams of another count or unit are no scans."""
    wire = Wire(record=SERVING_RECORD)
    wire.start()
    codes = np.full(361, 1000, np.uint16)

    for telegram in (RangeTelegram(codes, MM), RangeTelegram(codes[:181], CM), RangeTelegram(codes[:181], MM, True)):
        assert wire.protocol.receive_data(answer(telegram.serialise()), wire.now_ns) == []
    assert len(wire.protocol.receive_data(answer(RangeTelegram(codes[:181], MM).serialise()), wire.now_ns)) == 1


@pytest.mark.parametrize("unit", ["mm", "cm"])
def test_far_walls_are_seen(unit: Any) -> None:
    """The driver chooses a measuring mode that reaches range_max_m, in either unit."""
    wire = Wire(replace(CONFIG, unit=unit))
    wire.world.nearest_m = 28.0

    wire.start()

    step = 0.01 if unit == "cm" else 0.001
    assert wire.scans[0].ranges_m == pytest.approx(wire.world.ranges_m[0], abs=step / 2 + 1e-9)


@pytest.mark.parametrize("command", [Command.TYPE, Command.STATUS])
def test_a_scanner_that_does_not_introduce_itself_still_streams(command: Command) -> None:
    """Type and status are good to know, but scans do not wait for them."""
    wire = Wire(replace(CONFIG, baud=9600), record=SERVING_RECORD)
    wire.to_scanner = lambda data: b"" if data[4] == command else data

    wire.start(15.0)


def test_silence_while_streaming_is_noticed_and_survived() -> None:
    """A cut cable is noticed within a second, and scans flow again once it is mended."""
    wire = Wire(record=SERVING_RECORD)
    wire.start()

    wire.to_host = lambda data: b""
    wire.run(1.0)
    assert wire.protocol.counts["silences"] == 1
    assert not wire.protocol.streaming
    wire.to_host = lambda data: data
    wire.scans.clear()
    wire.start(5.0)

    wire.check_scans()


def test_nothing_but_noise_never_raises_and_never_scans() -> None:
    """100 kB of random bytes from a broken line give no scan and no exception, and the search goes on."""
    protocol = SickLmsProtocol(CONFIG)
    rng = np.random.default_rng(5)
    rates = set()

    for k in range(2000):
        assert protocol.receive_data(rng.bytes(50), k * 5 * MS) == []
        protocol.data_to_send()
        rates.add(protocol.baud)

    assert rates == {9600, 19200, 38400, 500000}
    assert protocol.counts["scans"] == 0


def test_noise_in_the_stream_loses_no_intact_scan() -> None:
    """Garbage between telegrams never costs a scan nor makes one."""
    wire = Wire(record=SERVING_RECORD)
    wire.start()
    wire.scans.clear()
    rng = np.random.default_rng(6)
    begun = wire.emulator.scans_sent

    def dirty(data: bytes) -> bytes:
        parts = data.split(b"\x02\x80\x6e\x01\xb0")
        return (rng.bytes(20) + b"\x02\x80\x6e\x01\xb0").join(parts)

    wire.to_host = dirty
    wire.run(2.0)

    wire.check_scans()
    assert wire.emulator.scans_sent - begun - len(wire.scans) <= 2  # the ones cut at either end
    assert wire.protocol.counts["skipped_bytes"] > 1000


def hurt(random: Random, data: bytes, share: float) -> bytes:
    """`data` as a bad line hands it over, now and then with something of it wrong."""
    if not data or random.random() > share:
        return data
    at = random.randrange(len(data))
    match random.randrange(5):
        case 0:
            return data[:at] + bytes((data[at] ^ 1 << random.randrange(8),)) + data[at + 1 :]
        case 1:
            return data[:at] + data[at + random.randrange(1, 9) :]
        case 2:
            return data[:at] + random.randbytes(random.randrange(1, 9)) + data[at:]
        case 3:
            return data[:at] + bytes.fromhex("0280 6E01 B0B540") + data[at:]
    return data[:at]


@pytest.mark.parametrize("seed", range(12))
def test_after_any_storm_scans_flow_and_no_scan_was_ever_false(seed: int) -> None:
    """Both directions bad, the scanner switched off and on, left at other rates and in other modes, the port reopened:
    every scan is one that was taken, inside its stamp; once the line is good scans flow; the EEPROM is written once.
    """
    random = Random(seed)
    config = replace(
        CONFIG, resolution_deg=random.choice((1.0, 0.5, 0.25)), baud=random.choice((500000, 500000, 38400, 9600))
    )
    wire = Wire(config, record=FACTORY_RECORD[: random.choice((30, 32, 34))], boot_ns=random.randrange(200, 3000) * MS)
    share = random.choice((0.02, 0.1, 0.2))
    wire.to_host = lambda data: hurt(random, data, share)
    wire.to_scanner = lambda data: hurt(random, data, share) if random.random() < 0.9 else b""
    for _ in range(5):
        wire.run(3 * random.random())
        if random.random() < 0.3:
            wire.emulator.switch_off_and_on(wire.now_ns)
        if random.random() < 0.4:
            mode = random.choice((Mode.STREAM, Mode.STREAM_PARTIAL, Mode.STOP, Mode.INSTALLATION))
            wire.emulator.leave_streaming(random.choice((9600, 38400, 500000)), mode, random.choice(VARIANTS))
        if random.random() < 0.2:
            wire.protocol.connection_made(wire.now_ns)
    wire.to_host = wire.to_scanner = lambda data: data
    stormed = len(wire.scans)
    wire.run(20.0, until=lambda: len(wire.scans) > stormed)

    assert len(wire.scans) > stormed, wire.protocol.state
    assert wire.emulator.eeprom_writes <= 1
    for scan in wire.scans:
        i = wire.world.index_of(scan)
        assert np.abs(scan.ranges_m - wire.world.ranges_m[i]).max() <= 0.0005 + 1e-12
        shots = wire.world.shots_ns[i]
        assert np.all(scan.stamp.earliest_ns + scan.beam_offset_ns <= shots)
        assert np.all(shots <= scan.stamp.latest_ns + scan.beam_offset_ns)


def test_a_foreign_scan_that_comes_with_the_last_answer_is_not_taken() -> None:
    """A scan of somebody else's stream, read together with the answer before the start, is none of ours."""
    wire = Wire(record=SERVING_RECORD)
    wire.run(10.0, until=lambda: wire.protocol.state == State.CONFIRMING.value)
    foreign = answer(RangeTelegram(np.full(181, 1234, np.uint16), MM).serialise())

    def add(data: bytes) -> bytes:
        complete = data[-3:-2] == b"\x10"  # a status byte, and the checksum behind it
        return data + foreign if complete and wire.protocol.state == State.CONFIRMING.value else data

    wire.to_host = add
    wire.start()

    assert wire.protocol.counts["scans_before_start"] >= 1
    assert not any((scan.ranges_m == 1.234).all() for scan in wire.scans)


def test_the_line_rate_changes_only_after_the_scanner_agreed() -> None:
    """Found at 9600, the rate stays 9600 until the switch is answered; then nothing is sent for a while."""
    wire = Wire(record=SERVING_RECORD)
    wire.emulator.leave_streaming(9600, mode=Mode.STOP)
    wire.run(10.0, until=lambda: wire.protocol.state == "switching the line rate")
    assert wire.protocol.baud == 9600

    wire.run(1.0, until=lambda: wire.protocol.baud == 500000)
    switched = wire.now_ns
    sent = len(wire.requests)
    wire.run(2.0, until=lambda: len(wire.requests) > sent)

    assert wire.protocol.baud == 500000
    assert wire.now_ns - switched >= 250 * MS


def test_a_lost_answer_to_the_rate_change_costs_less_than_a_search() -> None:
    """The scanner has changed already: it is met at its new rate, without asking round at the others."""
    wire = Wire(record=SERVING_RECORD)
    wire.to_host = lambda data: data if wire.protocol.state != State.SWITCHING_RATE.value else b""
    wire.run(10.0, until=lambda: wire.protocol.state == State.SWITCHING_RATE.value)
    asked_ns = wire.now_ns
    wire.start()

    assert wire.now_ns - asked_ns < 1600 * MS
    assert "restarts" not in wire.protocol.counts
    assert not any("finding" in state for state in wire.states[wire.states.index(State.SWITCHING_RATE.value) :])


def test_the_table_leads_everywhere_and_never_asks_for_the_same_answer_twice_in_a_row() -> None:
    """Every state is a step, a wait or the stream; all are reached; a late answer can't be taken for the next one."""
    assert set(STEPS) | set(WAITS_MS) | {State.STREAMING} == set(State) == set(TRANSITIONS)
    assert {state for edges in TRANSITIONS.values() for state in edges.values()} == set(State)
    for state, edges in TRANSITIONS.items():
        if state not in STEPS:
            continue
        assert {Outcome.DONE, Outcome.REFUSED, Outcome.SILENT} <= set(edges)
        following = edges[Outcome.DONE]
        while following in STEPS and Outcome.NEEDLESS in TRANSITIONS[following]:
            assert STEPS[following].answer != STEPS[state].answer
            following = TRANSITIONS[following][Outcome.NEEDLESS]
        if following in STEPS:
            assert STEPS[following].answer != STEPS[state].answer
