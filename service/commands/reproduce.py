"""`terrabound reproduce`: the paper's experiments, run again, with the maps that it compares itself to."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter
from rich.console import Console
from rich.markdown import Markdown
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from bench.paper import experiment
from bench.paper.experiment import Outcome
from drivers.errors import TerraboundError
from service.output_files import make_folder, write_text

EXPERIMENTS = ("table1", "stairs", "snow")


def reproduce(
    what: Literal["table1", "stairs", "snow", "all"],
    /,
    *,
    output: Path = Path("reproduce-output"),
    short: Annotated[bool, Parameter(negative=())] = False,
) -> int:
    """Run the paper's experiments again: set-valued map, Gaussian mixture and Kalman map on the same readings.

    table1 is the paper's simulation, stairs and snow its drives, with the emulated robot. Each leaves pictures, its
    numbers as JSON and its tables as Markdown in the output folder. All together take some minutes. Ends with 1 if a
    bound of ours did not hold. What came of it, claim by claim: docs/paper.md.

    Parameters
    ----------
    what
        Which experiment.
    output
        Folder for the results; made if it is not there.
    short
        The same in seconds: fewer seeds, shorter drives. For a first look; the numbers are coarse.
    """
    if find_spec("matplotlib") is None:
        raise TerraboundError("pictures need matplotlib: pip install 'terrabound[plots]'")
    make_folder(output)
    console = Console()
    broken: list[str] = []
    for name in EXPERIMENTS if what == "all" else (what,):
        with _progress(name) as progress:
            outcome: Outcome = import_module(f"bench.paper.{name}").run(output, short, progress)
        _write(output, name, outcome)
        text = f"# {outcome.title}\n\n{outcome.report}"
        console.print(Markdown(text) if console.is_terminal else text, markup=False, highlight=False, soft_wrap=True)
        for picture in outcome.pictures:
            console.print(f"{picture}", markup=False, highlight=False, soft_wrap=True)
        broken += [f"{name}: {promise}" for promise in outcome.broken]
    for promise in broken:
        console.print(promise, style="red", markup=False, highlight=False, soft_wrap=True)
    return 1 if broken else 0


@contextmanager
def _progress(name: str) -> Iterator[experiment.Progress]:
    """A bar on a terminal, nothing elsewhere."""
    columns = (TextColumn("[bold]{task.fields[name]}"), BarColumn(), TextColumn("{task.description}"))
    console = Console(stderr=True)
    with Progress(*columns, TimeElapsedColumn(), console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task("", total=1.0, name=name)
        yield lambda share, doing: bar.update(task, completed=share, description=doing)


def _write(output: Path, name: str, outcome: Outcome) -> None:
    """The outcome as <name>.json and <name>.md."""
    pictures = "".join(f"\n![{picture.stem}]({picture.relative_to(output)})" for picture in outcome.pictures)
    text = f"# {outcome.title}\n\n{outcome.report.rstrip()}\n{pictures}\n"
    write_text(output / f"{name}.md", text)
    write_text(output / f"{name}.json", json.dumps(outcome.numbers, indent=2) + "\n")
