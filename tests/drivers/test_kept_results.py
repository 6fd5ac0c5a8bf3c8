"""What libraries told is kept on disk: a start need not load them again, and nothing wrong is ever believed."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from drivers import kept_results
from drivers.imu import codec
from drivers.kept_results import kept_result
from drivers.track_encoders import counters
from drivers.track_encoders.counters import find_counter
from service.shipped import shipped_config

DRIVERS = """
import sys
from pathlib import Path
import drivers.imu.codec
from drivers.track_encoders.counters import find_counter
for name in ("TRACKS.LEFT", "TRACKS.RIGHT"):
    find_counter(Path(sys.argv[1]).read_text(), name)
print(*sorted({"pymavlink", "cantools"} & sys.modules.keys()))
"""


def loaded(folder: Path) -> str:
    """Which of both libraries a process loads that keeps its results in `folder`."""
    return subprocess.run(
        [sys.executable, "-c", DRIVERS, shipped_config("tracks.dbc")],
        env=os.environ | {"NUMBA_CACHE_DIR": str(folder)},
        capture_output=True,
        text=True,
        check=True,
        timeout=100,
    ).stdout.strip()


def test_the_second_start_loads_neither_library(tmp_path: Path) -> None:
    """The first needs both, and keeps what they told."""
    assert loaded(tmp_path) == "cantools pymavlink"
    assert loaded(tmp_path) == ""


def test_a_damaged_result_is_made_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever stands in the file: cut short, a bit turned over, nothing, no text at all."""
    monkeypatch.setattr(kept_results, "code_folder", lambda module: str(tmp_path))

    def make() -> dict[str, int]:
        made.append(1)
        return {"bits": 16}

    made: list[int] = []
    for damage in (None, b"", b"\xff\xfe", lambda d: d[:-3], lambda d: d.replace(b"16", b"17")):
        for path in tmp_path.iterdir():
            if damage is not None:
                path.write_bytes(damage if isinstance(damage, bytes) else damage(path.read_bytes()))
        made.clear()
        assert kept_result(__file__, "cantools", "x", make) == {"bits": 16}
        assert kept_result(__file__, "cantools", "x", make) == {"bits": 16}
        assert len(made) == 1


def test_another_file_or_name_is_another_result(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What was found in one DBC file is never taken for what stands in another."""
    monkeypatch.setattr(kept_results, "code_folder", lambda module: str(tmp_path))
    dbc = shipped_config("tracks.dbc").read_text()
    left = find_counter(dbc, "TRACKS.LEFT")
    assert find_counter(dbc, "TRACKS.RIGHT") != left
    assert find_counter(dbc.replace("BO_ ", "BO_ 1", 1), "TRACKS.LEFT").can_id != left.can_id
    assert find_counter(dbc, "TRACKS.LEFT") == left


def test_what_is_kept_of_a_counter_is_the_counter() -> None:
    """Byte order, place, multiplexer: all of it comes back."""
    little, big = counters.LittleEndianField(3, 255), counters.BigEndianField(8, 65535)
    for field, selector, selected in ((little, None, ()), (big, little, (1, 4)), (little, big, (0,))):
        counter = counters.TrackCounter(0x123, True, 8, 16, True, -3, field, selector, frozenset(selected))
        plain = json.loads(json.dumps(counters._plain(counter)))
        assert counters._counter(plain) == counter


def test_the_definitions_are_those_of_pymavlink() -> None:
    """Number, checksum, layout and names of every message; lengths of version 1."""
    from pymavlink.dialects.v10 import ardupilotmega as v1
    from pymavlink.dialects.v20 import ardupilotmega as v2

    for number, theirs in v2.mavlink_map.items():
        ours = codec._DEFINITION[number]
        assert (ours.msgname, ours.id, ours.crc_extra) == (theirs.msgname, theirs.id, theirs.crc_extra)
        assert (ours.unpacker.format, [*ours.ordered_fieldnames]) == (theirs.unpacker.format, theirs.ordered_fieldnames)
    assert {number: m.unpacker.size for number, m in v1.mavlink_map.items()} == codec._V1_BYTES
    assert len(codec._DEFINITION) == len(v2.mavlink_map) + 2
