"""The scanner's end of a SICK LMS2xx line, as strict as the manual: LMS2XX sections 1 to 7.

The mirror turns whether or not anybody listens. A scan is sent only if it is complete at the end of a turn and the line
is free at that instant, so a slow line sends every n-th scan, as the real one does.
"""

import heapq
from collections.abc import Callable

from drivers.sick_lms.error_memory import ErrorEntry, serialise_errors
from drivers.sick_lms.measurements import DISTANCE_BITS
from drivers.sick_lms.telegrams import (
    ACK,
    BAUD_MODES,
    NAK,
    OVERHEAD,
    PASSWORD,
    POWER_ON,
    REFUSED,
    RESETTING,
    STATUS_OK,
    STX,
    VARIANTS,
    Command,
    Configuration,
    DeviceStatus,
    DeviceType,
    Mode,
    Variant,
    answer,
    checksum,
)
from simulator.emulators.sick_lms_line import SendingLine
from simulator.emulators.sick_lms_output import (
    Measure,
    Measurements,
    Output,
    output_of_mode,
    output_of_request,
)

MS = 1_000_000

FACTORY_RECORD = bytes.fromhex("0000 7000 00 00 01 0000 02 02") + bytes(21) + b"\x02\x00"
"""8 m in millimetres: the driver has something to write."""

ANSWER_MS: dict[int, int] = {Command.MODE: 30, Command.VARIANT: 40, Command.WRITE_CONFIGURATION: 250}
"""From ACK to answer, where it takes longer than the usual 8 ms."""

SILENCE_WITHIN_REQUEST_NS = 6 * MS
SHORTEST_REQUEST = 7


LMS_221, LMS_FAST = "LMS221;302063;V02.30 ", "LMS291;S14;V02.30    "
"""What types of scanner say of themselves; the Fast sees 90 degrees."""


class SickLmsEmulator:
    """One scanner, switched on at `start_ns`."""

    def __init__(
        self,
        measure: Measure,
        *,
        start_ns: int = 0,
        boot_ns: int = 500 * MS,
        type_text: str = LMS_221,
        serial: str = "00410123",
        record: bytes = FACTORY_RECORD,
        status: int = STATUS_OK,
        errors: tuple[ErrorEntry, ...] = (),
        phase_ns: int = 0,
        flags: int = 0,
        immediate_partials: bool = False,
        acknowledge_ns: int = 3 * MS,
    ) -> None:
        """`record` is the EEPROM's: measuring mode, unit, indices.

        `phase_ns`: how much later than the manual's formula says the beams are shot. `flags`: bits above each distance.
        `immediate_partials`: partial scans come in measuring mode 0Fh, whatever is configured.
        """
        self._boot_ns = boot_ns
        self._acknowledge_ns = acknowledge_ns
        self._type = DeviceType(type_text)
        self._serial = serial
        self._configuration = Configuration(record)  # EEPROM
        self._rate_kept = 0  # EEPROM, 66h: 0 speaks 9600 baud after power-on, 1 the rate set last
        self._measurements = Measurements(measure, phase_ns, flags, immediate_partials)
        self.eeprom_writes = 0
        self.errors = errors
        self.status = status
        """Status byte of every telegram."""
        self.misses = 0
        """How many of the next requests the scanner shall not notice."""
        self.scans_sent = 0
        self._now_ns = start_ns
        self._baud = 9600
        self._actions: list[tuple[int, int, Callable[[], None]]] = []
        self._actions_made = 0
        self._line = SendingLine(start_ns)
        self._outbox = bytearray()
        self._request = bytearray()
        self._request_ns = start_ns
        self._switch_on()

    @property
    def baud(self) -> int:
        """Rate that the scanner speaks and listens at now."""
        return self._baud

    @property
    def streaming(self) -> bool:
        """Does it send scans unasked?"""
        return self._stream is not None

    @property
    def configuration(self) -> Configuration:
        """What its EEPROM holds."""
        return self._configuration

    def receive_data(self, data: bytes, now_ns: int) -> None:
        """Take what the host wrote, at time `now_ns`."""
        self._advance(now_ns)
        if now_ns - self._request_ns > SILENCE_WITHIN_REQUEST_NS:
            self._request.clear()
        self._request_ns = now_ns
        if not self._booted:
            return
        self._request += data
        self._take_requests()

    def data_to_send(self, now_ns: int) -> bytes:
        """All bytes whose last bit has left by `now_ns` and that were not handed out yet.

        Bytes sent at different rates never come out together, so that `baud` holds for all of them.
        """
        self._advance(now_ns)
        data = bytes(self._outbox)
        self._outbox.clear()
        return data

    def switch_off_and_on(self, now_ns: int) -> None:
        """The power fails for a moment; only the EEPROM survives."""
        self._advance(now_ns)
        self._switch_on()

    def leave_streaming(self, baud: int, mode: Mode = Mode.STREAM, variant: Variant = VARIANTS[0]) -> None:
        """As a former driver left it: booted, at this rate, sending scans."""
        self._boot()
        self._line.clear(self._now_ns)
        self._baud, self._variant = baud, variant
        self._set_mode(mode, output_of_mode(mode, b""))

    # Time

    def _advance(self, now_ns: int) -> None:
        while True:
            action_ns = self._actions[0][0] if self._actions else None
            scan_ns = self._next_scan_ns()
            due = min((t for t in (action_ns, scan_ns) if t is not None), default=None)
            if due is None or due > now_ns:
                break
            self._now_ns = max(self._now_ns, due)
            self._outbox += self._line.leave_until(self._now_ns)
            if action_ns == due:
                if self._rate_changes_next() and self._outbox:
                    return  # these bytes go out first: they were sent at the old rate
                heapq.heappop(self._actions)[2]()
            else:
                self._send_scan()
        self._now_ns = max(self._now_ns, now_ns)
        self._outbox += self._line.leave_until(self._now_ns)

    def _at(self, time_ns: int, action: Callable[[], None]) -> None:
        self._actions_made += 1
        heapq.heappush(self._actions, (time_ns, self._actions_made, action))

    def _rate_changes_next(self) -> bool:
        return self._actions[0][2] in (self._change_rate, self._switch_on)

    # Power

    def _switch_on(self) -> None:
        self._actions.clear()
        self._line.clear(self._now_ns)
        self._request.clear()
        self._booted = False
        self._baud = self._next_baud = self._baud if self._rate_kept else 9600
        self._mode: int = Mode.STOP
        self._stream: Output | None = None
        self._variant = self._type.power_on_variant
        self._measurements.mirror_ns = self._now_ns
        self._stream_ns = self._now_ns
        self._answering = False
        self._at(self._now_ns + self._boot_ns, self._power_on)

    def _boot(self) -> None:
        self._actions.clear()
        self._booted = True

    def _power_on(self) -> None:
        self._boot()
        self._send(answer(self._type.serialise(POWER_ON, self.status)))

    def _change_rate(self) -> None:
        self._line.interrupt(self._now_ns)
        self._baud = self._next_baud

    # Requests

    def _take_requests(self) -> None:
        """Whole requests in the buffer; what does not begin with STX and the broadcast address is dropped."""
        request = self._request
        while len(request) >= SHORTEST_REQUEST:
            length = int.from_bytes(request[2:4], "little")
            if request[0] != STX or request[1] != 0 or not 1 <= length <= 1024:
                del request[0]
                continue
            if len(request) < length + OVERHEAD:
                return
            frame = bytes(request[: length + OVERHEAD])
            del request[: length + OVERHEAD]
            if self.misses > 0:
                self.misses -= 1
                continue
            self._line.interrupt(self._now_ns)
            if checksum(frame[:-2]) == int.from_bytes(frame[-2:], "little"):
                self._answer(frame[4:-2])
            else:
                self._at(self._now_ns + 2 * MS, lambda: self._send(bytes((NAK,))))

    def _answer(self, payload: bytes) -> None:
        """ACK, then the answer; what the request does is done when its answer leaves."""
        acknowledge_ns = self._now_ns + self._acknowledge_ns
        self._answering = True
        self._at(acknowledge_ns, lambda: self._send(bytes((ACK,))))

        def carry_out() -> None:
            self._answering = False
            self._send(answer(self._carry_out(payload) + bytes((self.status,))))

        measuring_ns = 0
        if (output := output_of_request(payload)) is not None:  # from the next mirror turn on
            measuring_ns = (output.averaged + 1) * output.duration_ns(self._variant)
        self._at(acknowledge_ns + ANSWER_MS.get(payload[0], 8) * MS + measuring_ns, carry_out)

    def _carry_out(self, payload: bytes) -> bytes:
        """Do what is asked; the answer's payload without its status byte."""
        installing = self._mode == Mode.INSTALLATION
        match payload[0]:
            case Command.RESET:
                self._set_mode(Mode.STOP, None)
                # Once more 10 ms after its answer, at 9600 baud, as if it were switched on.
                self._at(self._now_ns + 10 * MS + 80_000_000_000 // self._baud, self._switch_on)
                return bytes((RESETTING,))
            case Command.MODE if len(payload) >= 2:
                return self._carry_out_mode(payload[1], payload[2:])
            case Command.STATUS:
                return self._status().serialise()[:-1]
            case Command.ERRORS:
                return serialise_errors(self.errors)[:-1]
            case Command.COUNTERS if self._type.counts_hours:
                return bytes((Command.COUNTERS.answer, 0, 0, 1, 0))
            case Command.TYPE:
                return self._type.serialise(Command.TYPE.answer)[:-1]
            case Command.VARIANT if len(payload) == 5 and not self._type.is_fast:
                wanted = Variant.parse(payload)
                accepted = wanted in VARIANTS
                if accepted:
                    self._variant = wanted
                    self._set_mode(Mode.STOP, None)  # switching ends a stream
                return self._variant.serialise_answer(accepted)[:-1]
            case Command.POWER_ON_RATE if installing and len(payload) == 2 and payload[1] <= 2:
                self._rate_kept = payload[1]
                self.eeprom_writes += 1
                return bytes((Command.POWER_ON_RATE.answer, 1))
            case Command.READ_CONFIGURATION:
                return self._configuration.serialise_read()[:-1]
            case Command.WRITE_CONFIGURATION if installing:
                return self._write(payload[1:])
        output = output_of_request(payload)
        if output is None or installing or not output.fits(self._variant):
            return bytes((REFUSED,))
        return self._measured(output)

    def _carry_out_mode(self, mode: int, data: bytes) -> bytes:
        result = 0
        if mode in (Mode.INSTALLATION, Mode.TEST_PASSWORD) and data != PASSWORD:
            result = 1
        elif mode in BAUD_MODES.values():
            self._next_baud = next(baud for baud, code in BAUD_MODES.items() if code == mode)
            # The answer leaves at the old rate; a millisecond later the rate is the new one.
            self._at(self._now_ns + MS + 90_000_000_000 // self._baud, self._change_rate)
        elif mode in (Mode.INSTALLATION, Mode.STOP):
            self._set_mode(mode, None)
        elif (output := output_of_mode(mode, data)) is not None and output.fits(self._variant):
            self._set_mode(mode, output)
        elif mode != Mode.TEST_PASSWORD:
            return bytes((REFUSED,))
        return bytes((Command.MODE.answer, result))

    def _set_mode(self, mode: int, stream: Output | None) -> None:
        self._mode = mode
        self._stream = stream
        self._stream_ns = self._now_ns

    def _write(self, data: bytes) -> bytes:
        """Write the EEPROM; shorter data than the record leaves its end as it was."""
        record = self._configuration.record
        wanted = Configuration(data + record[len(data) :])
        accepted = 7 <= len(data) <= len(record) and wanted.measuring_mode in DISTANCE_BITS and wanted.unit in (0, 1)
        if accepted:
            self._configuration = wanted
            self.eeprom_writes += 1
        return self._configuration.serialise_written(accepted)[:-1]

    def _status(self) -> DeviceStatus:
        return DeviceStatus(
            firmware=self._type.text.split(";")[-1],
            serial=self._serial,
            operating_mode=self._mode,
            measuring_mode=self._configuration.measuring_mode,
            angle_deg=self._variant.angle_deg,
            resolution_cdeg=self._variant.resolution_cdeg,
            baud=self._baud,
            unit=self._configuration.unit,
        )

    # Scans

    def _next_scan_ns(self) -> int | None:
        """End of the mirror turn at which the next scan can leave."""
        if self._stream is None or self._answering:
            return None
        duration = self._stream.duration_ns(self._variant)
        ready = max(self._line.free_ns, self._stream_ns + duration)
        mirror_ns = self._measurements.mirror_ns
        return mirror_ns + -((mirror_ns - ready) // duration) * duration

    def _send_scan(self) -> None:
        assert self._stream is not None  # or no scan would be due
        self._send(answer(self._measured(self._stream) + bytes((self.status,))))
        self.scans_sent += 1

    def _measured(self, output: Output) -> bytes:
        """Payload of what was measured in the turns that have just ended, without its status byte."""
        return self._measurements.payload(output, self._variant, self._configuration, self.scans_sent, self._now_ns)[
            :-1
        ]

    def _send(self, data: bytes) -> None:
        self._line.send(data, self._baud, self._now_ns)
