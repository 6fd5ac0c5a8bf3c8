"""The one TOML file: read, checked as a whole, every mistake named at once with its path."""

import difflib
import json
import re
import tomllib
from dataclasses import dataclass as plain_dataclass
from dataclasses import field, fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any, Self, get_args, get_type_hints

from pydantic import Field, TypeAdapter, ValidationError, model_validator
from pydantic.dataclasses import dataclass

from drivers.config import STRICT, DevicesConfig, Positive
from drivers.errors import ConfigurationError
from estimator.config import FilterConfig, RobotConfig
from mapper.config import MapConfig
from service.publish_config import PublishConfig


@dataclass(frozen=True, slots=True, kw_only=True, config=STRICT)
class RecordConfig:
    """Keep the raw bytes of the drive."""

    path: str | None = None
    """MCAP file to write while running; None: no recording. A relative path starts at the configuration's folder.

    `%Y%m%d-%H%M%S` and the like in its name stand for the time of the start (UTC); an existing file is never
    overwritten, a number is added instead.
    """


@dataclass(frozen=True, slots=True, kw_only=True, config=STRICT)
class StoreConfig:
    """Keep the map."""

    map: str | None = None
    """`.npz` that is written at the end of a run and every `period_s`; None: the map lives in memory alone."""
    period_s: Annotated[Positive, Field(ge=1.0)] = 30.0
    path: str | None = None
    """Database that holds the map safe against kill -9 and power cuts (docs/store.md); None: no store."""
    interval_s: Annotated[float, Field(ge=0.1, le=60.0)] = 1.0
    """One transaction this often: what a crash can cost."""
    earlier_submaps: Annotated[int, Field(ge=0, le=100)] = 4
    """How many maps of earlier runs, each in its own frame, are published beside the present one."""


MOST_LATENCY_MS = 60_000.0
SPARE_MS = 20.0
"""For threads that wait for their turn."""


@dataclass(frozen=True, slots=True, kw_only=True, config=STRICT)
class Config:
    """Everything an owner declares."""

    robot: RobotConfig
    map: MapConfig
    devices: DevicesConfig
    filter: FilterConfig = field(default_factory=FilterConfig)
    publish: PublishConfig = field(default_factory=PublishConfig)
    record: RecordConfig = field(default_factory=RecordConfig)
    store: StoreConfig = field(default_factory=StoreConfig)

    @model_validator(mode="after")
    def _no_reading_is_too_late(self) -> Self:
        for entry in fields(self.devices):
            device = getattr(self.devices, entry.name)
            if device is not None and device.latency_ms[1] > MOST_LATENCY_MS:
                raise ValueError(
                    f"devices.{entry.name}.latency_ms: {device.latency_ms[1]:g} should be at most {MOST_LATENCY_MS:g} "
                    "(milliseconds); no reading can be used that late"
                )
        return self

    @model_validator(mode="after")
    def _scans_come_inside_the_window(self) -> Self:
        laser, window_ms = self.devices.laser, self.filter.reordering_window_ms
        # At once, and no sooner, a scan is there: later ones than the window are not mapped, which is sound.
        line_ms, (least_ms, most_ms) = laser.telegram_ms, laser.latency_ms
        if line_ms + least_ms + SPARE_MS > window_ms:
            raise ValueError(
                f"filter.reordering_window_ms: {window_ms:g} should be {line_ms + most_ms + SPARE_MS:.0f} or more: "
                f"a scan is {line_ms:.0f} ms on the line at {laser.baud} baud, devices.laser.latency_ms comes on top, "
                "and what comes later than the window is not mapped"
            )
        return self


@plain_dataclass(frozen=True, slots=True)
class LoadedConfig:
    """A checked configuration, with its own text (it goes into every capture) and the folder of its relative paths."""

    config: Config
    text: str
    folder: Path
    source: str
    dbc: str | None = None
    """Text of the encoders' DBC file, where it came with the configuration (as in a capture)."""

    def dbc_text(self) -> str:
        """Text of the encoders' DBC file. Raises ConfigurationError where it can't be read."""
        if self.dbc is not None:
            return self.dbc
        path = self.path(self.config.devices.encoders.dbc)
        try:
            # Comments in other encodings are nobody's business here; names are ASCII.
            return path.read_text(encoding="cp1252", errors="replace")
        except (OSError, ValueError) as error:  # ValueError: no name of a file
            raise ConfigurationError(
                f"devices.encoders.dbc: {path}: cannot be read ({getattr(error, 'strerror', None) or error}); "
                "name the DBC file of the track encoders"
            ) from None

    def path(self, relative: str) -> Path:
        """A path of the configuration, as seen from its file's folder."""
        return self.folder / Path(relative).expanduser()


def load(path: Path) -> LoadedConfig:
    """Read and check a configuration file. Raises ConfigurationError that names the file and every wrong key."""
    try:
        text = path.read_text(encoding="utf-8-sig")  # Notepad begins files with a mark
    except FileNotFoundError:
        raise ConfigurationError(f"{path}: no such file; docs/config/ holds examples to start from") from None
    except UnicodeDecodeError as error:
        line = error.object.count(b"\n", 0, error.start) + 1
        raise ConfigurationError(f"{path}: is not UTF-8 text (at line {line}); save it in that encoding") from None
    except OSError as error:
        raise ConfigurationError(f"{path}: cannot be read: {error.strerror}") from None
    return parse(text, folder=path.resolve().parent, source=str(path))


def load_for_ports(path: Path) -> LoadedConfig:
    """`load` for who opens the ports (a replay does not). ConfigurationError where devices share one, or files do."""
    loaded, taken = load(path), dict[str, str]()
    for entry in fields(loaded.config.devices):
        device, key = getattr(loaded.config.devices, entry.name), f"devices.{entry.name}.port"
        if device is None:
            continue
        if not device.port:
            raise ConfigurationError(f"{path}: {key}: is empty; name the port that the device is on")
        if (other := taken.setdefault(device.port, key)) != key:
            raise ConfigurationError(f"{path}: {other} and {key}: both are {device.port!r}; each device needs its own")
    _refuse_shared_files(loaded, path)
    return loaded


def _refuse_shared_files(loaded: LoadedConfig, path: Path) -> None:
    """What is written must not take the place of what is read, nor of each other."""
    config = loaded.config
    taken = {path.resolve(): "the configuration itself"}
    files = {
        "devices.encoders.dbc": config.devices.encoders.dbc,
        "store.path": config.store.path,
        "store.map": config.store.map,
        "record.path": config.record.path,
    }
    for key, name in files.items():
        if name is None:
            continue
        try:
            file = loaded.path(name).resolve()
        except (ValueError, RuntimeError) as error:  # a zero byte; `~nobody`
            raise ConfigurationError(f"{path}: {key}: {name!r} can't be the name of a file ({error})") from None
        if (other := taken.setdefault(file, key)) != key:
            raise ConfigurationError(f"{path}: {key}: {name!r} is {other}, too; name a file of its own")


def parse(text: str, folder: Path, source: str, dbc: str | None = None) -> LoadedConfig:
    """Check a configuration's text. Raises ConfigurationError that names every wrong key."""
    try:
        # Through JSON, strictly: a list may stand for a pair, but text never for a number.
        tree = json.dumps(tomllib.loads(text), default=str)
    except tomllib.TOMLDecodeError as error:
        raise ConfigurationError(f"{source}: not valid TOML: {error}") from None
    except RecursionError:
        raise ConfigurationError(f"{source}: tables or lists in it stand in each other too deeply") from None
    try:
        config = TypeAdapter(Config).validate_json(tree, strict=True)
    except ValidationError as error:
        lines = "\n".join(f"  {_explain(entry)}" for entry in error.errors(include_url=False))
        count = error.error_count()
        noun = "mistake" if count == 1 else "mistakes"
        raise ConfigurationError(f"{source}: {count} {noun} in the configuration\n{lines}") from None
    return LoadedConfig(config, text, folder, source, dbc)


_SHOWN = 80
"""Characters of a wrong value that are repeated."""


def _explain(entry: Any) -> str:
    """One mistake as one line: path, what was found, what to do."""
    path = ".".join(str(part) for part in entry["loc"])
    kind, found = entry["type"], entry["input"]
    if kind in ("unexpected_keyword_argument", "extra_forbidden"):
        *parent, name = entry["loc"]
        known = _keys_at(parent)
        # Units stand in names: `range_bound` is most likely a `range_bound_m` without its unit.
        close = [k for k in known if k.startswith(f"{name}_")] or difflib.get_close_matches(str(name), known, n=1)
        advice = f"did you mean {close[0]}?" if close else f"known keys here: {', '.join(known)}"
        return f"{path}: unknown key; {advice}"
    if kind in ("missing", "missing_argument", "missing_keyword_only_argument"):
        return f"{path}: missing; it has no default, only the owner can know it"
    if kind in ("tuple_type", "list_type") and not isinstance(found, dict):
        return f"{path}: {found!r} should be a list, in brackets"
    message = re.sub(r"^(Value error, |Input )", "", entry["msg"])
    if isinstance(found, dict):  # about several keys at once: it names them
        return f"{path}: {message}" if path else message
    shown = repr(found)
    return f"{path}: {shown if len(shown) <= _SHOWN else shown[:_SHOWN] + '...'} {message}"


def _keys_at(path: list[str | int]) -> list[str]:
    """Names that the configuration knows in the section at `path`."""
    kind: Any = Config
    for part in path:
        hint = get_type_hints(kind).get(str(part)) if is_dataclass(kind) else None
        kind = next((choice for choice in (hint, *get_args(hint)) if is_dataclass(choice)), None)
    return [entry.name for entry in fields(kind)] if is_dataclass(kind) else []
