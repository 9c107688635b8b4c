"""The command line: `bcppl run`, `probe`, `check`, `import`, `simulate`."""

from __future__ import annotations

import os
import sys
from importlib.metadata import version
from typing import Annotated

import typer

from bcppl.cli import probe, recordings, run
from bcppl.errors import InferenceError, InputError

app = typer.Typer(
    name="bcppl",
    help="Find where a part is, from depth images and touches, as weighted particles.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)


def _version(asked: bool) -> None:
    if asked:
        print(f"bcppl {version('bcppl')}")
        raise typer.Exit


@app.callback()
def _options(
    _: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Say which version this is.")
    ] = False,
) -> None: ...


app.command("run")(run.run)
app.command("probe")(probe.probe)
app.command("check")(recordings.check)
app.command("simulate")(recordings.simulate)
app.add_typer(recordings.import_app, name="import")

BAD_INPUT, FAILED = 2, 1


def main() -> None:
    """Run the command line; what goes wrong is one sentence and an exit code, 2 for bad input.

    With BCPPL_TRACEBACK set in the environment, Python's own traceback is shown instead.
    """
    if os.environ.get("BCPPL_TRACEBACK"):
        app()
    try:
        app()
    except InputError as error:
        _stop(str(error), BAD_INPUT)
    except (InferenceError, OSError) as error:
        _stop(str(error), FAILED)
    except KeyboardInterrupt:
        _stop("stopped.", 130)
    except Exception as error:
        _stop(
            f"something went wrong ({type(error).__name__}: {error}); "
            "set BCPPL_TRACEBACK=1 to see where, and report it if it is not in a file of yours.",
            FAILED,
        )


def _stop(sentence: str, code: int) -> None:
    print(f"bcppl: {' '.join(sentence.split())}", file=sys.stderr)
    sys.exit(code)
