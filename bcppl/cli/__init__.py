"""The command line: `bcppl run`, `view`, `probe`, `insert`, `live`, `sweep`, `check`, `import` and others.

A command imports what it computes with when it is called, so that `bcppl --help` answers at once.
"""

from __future__ import annotations

import os
import sys
import traceback
import warnings
from typing import Annotated, Any

import typer

from bcppl.cli.commands import calibrate, insert, live, new, probe, recordings, run, sweep, view
from bcppl.errors import InferenceError, InputError
from bcppl.untrusted.visible_text import visible

app = typer.Typer(
    name="bcppl",
    help="Estimate where a part is, from depth images and touches, as weighted particles.",
)


def _version(asked: bool) -> None:
    if asked:
        from importlib.metadata import version

        print(f"bcppl {version('bcppl')}")
        raise typer.Exit


@app.callback()
def _options(
    _: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None: ...


app.command("run")(run.run)
app.command("view")(view.view)
app.command("probe")(probe.probe)
app.command("insert")(insert.insert)
app.command("live")(live.live)
app.command("serve")(live.serve)
app.command("sweep")(sweep.sweep)
app.command("check")(recordings.check)
app.command("simulate")(recordings.simulate)
app.add_typer(recordings.import_app, name="import")
app.add_typer(new.new_app, name="new")
app.add_typer(calibrate.calibrate_app, name="calibrate")

BAD_INPUT, FAILED, INTERRUPTED = 2, 1, 130


def main() -> None:
    """Run the command line; an error is one sentence and an exit code, 2 for bad input.

    With BCPPL_TRACEBACK set in the environment, Python's own traceback is shown instead.
    """
    words = sys.argv[1:] or ["--help"]
    if os.environ.get("BCPPL_TRACEBACK"):
        sys.exit(app(words, standalone_mode=False))
    warnings.showwarning = _Warnings()
    try:
        sys.exit(app(words, standalone_mode=False))
    except typer.TyperException as error:
        _stop(error.format_message(), BAD_INPUT)
    except InputError as error:
        _stop(str(error), BAD_INPUT)
    except (InferenceError, OSError) as error:
        _stop(str(error), FAILED)
    except (KeyboardInterrupt, typer.Abort):
        _stop("stopped.", INTERRUPTED)
    except Exception as error:
        last = traceback.extract_tb(error.__traceback__)[-1]
        _stop(
            f"something went wrong ({type(error).__name__}: {error}, line {last.lineno} of {last.filename}); "
            "set BCPPL_TRACEBACK=1 to see the whole way, and report it if it is not in a file of yours.",
            FAILED,
        )


class _Warnings:
    """Prints each warning once, as a sentence and without a place in the source."""

    def __init__(self) -> None:
        self._printed: set[str] = set()

    def __call__(self, message: Warning | str, *_: Any, **__: Any) -> None:
        sentence = visible(" ".join(str(message).split()))
        if sentence not in self._printed:
            self._printed.add(sentence)
            print(f"bcppl: warning: {sentence}", file=sys.stderr)


def _stop(sentence: str, code: int) -> None:
    sentence = visible(" ".join(sentence.split()))  # it may quote a file
    print(f"bcppl: {sentence}{'' if sentence.endswith(('.', '?')) else '.'}", file=sys.stderr)
    sys.exit(code)
