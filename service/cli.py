"""The command line: `terrabound COMMAND`. Each command stands in its own file under service/commands/.

Exit codes: 0 done, 1 failed, 2 bad usage, 78 bad configuration (systemd's EX_CONFIG), 130 interrupted.
"""

import gc
import os
import sys
from typing import TYPE_CHECKING

from drivers.errors import ConfigurationError, TerraboundError

if TYPE_CHECKING:
    from cyclopts import App

EXIT_FAILED, EXIT_USAGE, EXIT_CONFIG, EXIT_INTERRUPTED = 1, 2, 78, 130

COMMANDS = {
    "demo": ("demo:demo", "See it work without hardware: an emulated robot, its map, and the truth held against it."),
    "run": ("run:run", "The service on the robot: sensors in, tiles of the map out."),
    "check": ("check:check", "Configuration, devices, rates: what is wrong, and how to mend it."),
    "record": ("record:record", "The sensors' raw bytes into a capture, nothing else."),
    "replay": ("replay:replay", "The map from a capture."),
    "decode": ("decode:app", "Raw bytes of one device, from a file, as JSON Lines."),
    "listen": ("listen:app", "One device on a live port, as JSON Lines."),
    "watch": ("watch:watch", "A remote copy of a robot's map."),
    "export": ("export:export", "A saved map as another program's file."),
    "emulate": ("emulate:app", "One device, or the whole robot, on pseudo-terminals."),
    "reproduce": ("reproduce:reproduce", "The paper's experiments, run again, with the maps it compares itself to."),
}
"""Where each command stands under service/commands/, and its line on the page of all commands."""


def _app(arguments: list[str]) -> "App":
    """The command line. Commands are imported when called, so that `--help` is quick and `decode` needs no network.

    So the page of all commands needs their lines beforehand; a command's own page has its docstring.
    """
    from cyclopts import App

    app = App(
        name="terrabound",
        help="Terrain maps with guaranteed bounds, live on a tracked robot.",
        version=_version,
        help_epilogue="Start with: terrabound demo",
    )
    for name, (where, line) in COMMANDS.items():
        described = {} if name in arguments[:1] else {"help": line}
        app.command(f"service.commands.{where}", name=name, **described)
    return app


def _version() -> str:
    from importlib.metadata import version  # slow to load, and seldom asked for

    return version("terrabound")


GC_THRESHOLD = 50_000
"""Objects made before the cycle collector looks at the youngest: starting up makes a million that all stay."""


def main() -> None:
    """Run the command line; one clear line instead of a traceback for what a person can mend."""
    gc.set_threshold(GC_THRESHOLD, 10, 100)
    sys.exit(run_command(sys.argv[1:]))


def run_command(arguments: list[str]) -> int:
    """Run one command; returns the exit code."""
    try:
        code = _run_command(arguments)
        if sys.stdout is not None:  # closed by `>&-`
            sys.stdout.flush()
        return code
    except ConfigurationError as error:
        print(f"terrabound: {error}", file=sys.stderr)
        return EXIT_CONFIG
    except TerraboundError as error:
        print(f"terrabound: {error}", file=sys.stderr)
        return EXIT_FAILED
    except KeyboardInterrupt:
        print("terrabound: interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED
    except BrokenPipeError:
        # The reader of our output left (`| head`): nothing more to say.
        _forget_output()
        return 0
    except OSError as error:
        # A full disk, a folder that may not be written: the system's own words name the file and the reason.
        print(f"terrabound: {error}", file=sys.stderr)
        _forget_output()
        return EXIT_FAILED


def _run_command(arguments: list[str]) -> int:
    """The same; what it raises is for a person, not for Python."""
    from cyclopts import CycloptsError  # half of the start: Ctrl-C while it loads is Ctrl-C as ever

    try:
        result = _app(arguments)(arguments, exit_on_error=False, print_error=True, result_action="return_value")
    except CycloptsError:
        return EXIT_USAGE
    except SystemExit as error:
        # A help page is printed by rich, which makes an exit of its own of a reader that left.
        if isinstance(error.__context__, BrokenPipeError):
            raise error.__context__ from None
        raise
    return result if isinstance(result, int) else 0


def _forget_output() -> None:
    """What could not be written to standard output shall not be tried again when the interpreter ends."""
    try:
        if sys.stdout is not None:
            sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


if __name__ == "__main__":
    main()
