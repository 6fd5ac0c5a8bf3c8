"""`terrabound check --bounds`: how much of each declared bound a recorded drive uses, and which it contradicts."""

import json
from collections import Counter
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.box import SIMPLE
from rich.console import Console
from rich.table import Column, Table
from rich.text import Text

from drivers.capture import Capture, read_capture
from drivers.errors import CaptureError
from drivers.samples import Sample
from estimator.bound_usage.ledger import Usage, Verdict
from estimator.bound_usage.usage import bound_usage
from service.commands.replay import configuration_of, with_progress
from service.output_files import refuse_unwritable, write_text
from service.replay import arrivals, recorded_devices

STYLES = {Verdict.CONTRADICTED: "bold red", Verdict.SUSPECT: "red", Verdict.WIDE: "yellow", Verdict.LOOKS_WIDE: "dim"}


def check_bounds(capture: Path, config: Path | None = None, report: Path | None = None) -> int:
    """Print the table, write the report; 1 if a bound is contradicted, else 0."""
    refuse_unwritable((report,), inputs=(capture, config))
    recording = read_capture(capture)
    loaded = configuration_of(recording, capture, config)
    devices = recorded_devices(loaded, recording)
    with ExitStack() as stack:
        chunks = with_progress(recording, stack)
        samples: list[Sample] = [arrival.sample for arrival in arrivals(devices, chunks, Counter())]
    if not samples:
        raise CaptureError(f"{capture}: not one reading of a configured device in it")
    settings = loaded.config
    usages = bound_usage(settings.robot, settings.filter, settings.devices, samples)
    begin_ns = min(sample.stamp.earliest_ns for sample in samples)
    seconds = (max(sample.stamp.latest_ns for sample in samples) - begin_ns) * 1e-9
    _print(usages, begin_ns, seconds, recording)
    if report is not None:
        text = json.dumps(_report(usages, begin_ns, seconds, capture), indent=2, allow_nan=False)
        write_text(report, text + "\n")
    return 1 if any(usage.verdict is Verdict.CONTRADICTED for usage in usages) else 0


def _print(usages: list[Usage], begin_ns: int, seconds: float, recording: Capture) -> None:
    """What was seen as a table; what needs words, below it."""
    console = Console()
    cut = ", cut short or damaged there" if recording.truncated else ""
    title = f"{recording.path.name}: {seconds:.0f} s{cut}"
    console.print(title, markup=False, highlight=False, soft_wrap=True)
    table = Table(
        Column("bound", overflow="fold"), Column("declared", justify="right"),
        Column("used at least", justify="right"), Column("at most, it seems", justify="right"),
        "verdict", Column("worst reading", overflow="fold"), box=SIMPLE,
    )  # fmt: skip
    for usage in usages:
        if usage.verdict is not Verdict.UNSEEN:
            style = STYLES.get(usage.verdict, "")
            worst = f"{usage.worst}{_when(usage, begin_ns)}" if usage.worst else ""
            table.add_row(
                usage.key, f"{usage.declared:g}", _percent(usage.used), _percent(usage.seen_share),
                Text(str(usage.verdict), style), Text(worst),
            )  # fmt: skip
    console.print(table)
    for usage in usages:
        if sentence := _sentence(usage, begin_ns):
            style = STYLES.get(usage.verdict, "")
            console.print(sentence, style=style, markup=False, highlight=False, soft_wrap=True)
    unseen = [usage.key for usage in usages if usage.verdict is Verdict.UNSEEN]
    console.print(f"this drive says nothing of: {', '.join(unseen)}", markup=False, highlight=False, soft_wrap=True)
    if not any(usage.verdict is Verdict.CONTRADICTED for usage in usages):
        console.print("no bound is contradicted", style="green")


def _sentence(usage: Usage, begin_ns: int) -> str:
    """What to do about a bound; empty where nothing is to be done."""
    blind = f"; not seen: {usage.blind_to}" if usage.blind_to else ""
    match usage.verdict:
        case Verdict.CONTRADICTED:
            others = f", or widen {' or '.join(usage.given)}" if usage.given else ""
            return (
                f"{usage.key} = {usage.declared:g} is contradicted{_when(usage, begin_ns)}: {usage.worst}; declare at "
                f"least {usage.proposal:g}{others}"
            )
        case Verdict.SUSPECT:
            return (
                f"{usage.key} = {usage.declared:g}: {usage.seen:.3g} was seen; it is no proof (did something move?), "
                "but look into it"
            )
        case Verdict.WIDE:
            enough = f"; {usage.proposal:g} would have been enough" if usage.proposal else ""
            return f"{usage.key} = {usage.declared:g} is needlessly wide for this drive{enough}{blind}"
        case Verdict.LOOKS_WIDE:
            return f"{usage.key} = {usage.declared:g}: this drive used {_percent(usage.seen_share)} of it{blind}"
    return ""


def _when(usage: Usage, begin_ns: int) -> str:
    return "" if usage.when_ns is None else f" at {(usage.when_ns - begin_ns) * 1e-9:.3f} s"


def _percent(share: float) -> str:
    return f"{100.0 * share:.0f} %" if share < 100.0 else "> 9999 %"


def _report(usages: list[Usage], begin_ns: int, seconds: float, capture: Path) -> dict[str, Any]:
    """The same for programs."""
    rows = []
    for usage in usages:
        row = asdict(usage)
        when_ns = row.pop("when_ns")
        row["when_s"] = None if when_ns is None else (when_ns - begin_ns) * 1e-9
        row["used"], row["seen_share"] = (min(share, 1e9) for share in (usage.used, usage.seen_share))
        row["verdict"], row["proposal"] = str(usage.verdict), usage.proposal
        rows.append(row)
    return {"capture": str(capture), "seconds": seconds, "bounds": rows}
