"""The command line: `terrabound COMMAND`. Each command stands in its own file under service/commands/.

Exit codes: 0 done, 1 failed, 2 bad usage, 78 bad configuration (systemd's EX_CONFIG).
"""

import os
import sys
from importlib.metadata import version

from cyclopts import App, CycloptsError

from drivers.errors import ConfigurationError, TerraboundError

EXIT_FAILED, EXIT_USAGE, EXIT_CONFIG, EXIT_INTERRUPTED = 1, 2, 78, 130

app = App(
    name="terrabound",
    help="Terrain maps with guaranteed bounds, live on a tracked robot.",
    version=lambda: version("terrabound"),
    help_epilogue="Start with: terrabound demo",
)

# Commands are imported when called, so that `--help` is quick and `decode` needs no network library.
app.command("service.commands.demo:demo")
app.command("service.commands.run:run")
app.command("service.commands.check:check")
app.command("service.commands.record:record")
app.command("service.commands.replay:replay")
app.command("service.commands.decode:decode")
app.command("service.commands.listen:listen")
app.command("service.commands.watch:watch")
app.command("service.commands.export:export")
app.command("service.commands.emulate:app", name="emulate")


def main() -> None:
    """Run the command line; one clear line instead of a traceback for what a person can mend."""
    sys.exit(_exit_code(sys.argv[1:]))


def _exit_code(arguments: list[str]) -> int:
    try:
        result = app(arguments, exit_on_error=False, print_error=True, result_action="return_value")
    except CycloptsError:
        return EXIT_USAGE
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
        # The reader of our output left (`| head`): nothing more to say, also not at interpreter exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    return result if isinstance(result, int) else 0


if __name__ == "__main__":
    main()
