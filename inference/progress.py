"""Progress bars, shown on a terminal and in a notebook."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sized
from contextlib import contextmanager
from importlib.util import find_spec
from typing import TypeVar

from rich import get_console
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

T = TypeVar("T")

# The bars in use: only the outermost is shown.
_shown: list[Progress] = []


@contextmanager
def sole_bar(console: Console | None = None) -> Iterator[Progress]:
    """A progress bar; hidden within another one, and where there is neither terminal nor notebook."""
    console = get_console() if console is None else console
    # Without ipywidgets rich warns at every update and leaves a bar behind for each.
    notebook = console.is_jupyter and find_spec("ipywidgets") is not None
    visible = (console.is_terminal or notebook) and not _shown
    columns = (
        TextColumn("{task.description:>12}"),
        BarColumn(bar_width=30),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("about"),
        TimeRemainingColumn(),
        TextColumn("left"),
    )
    # Between two steps the caller prints: in a notebook that shall stay ordinary output.
    bar = Progress(
        *columns,
        console=console,
        transient=True,
        disable=not visible,
        redirect_stdout=not console.is_jupyter,
        redirect_stderr=not console.is_jupyter,
    )
    _shown.append(bar)
    try:
        with bar:
            yield bar
    finally:
        _shown.remove(bar)


def watched(
    items: Iterable[T],
    *,
    total: int | None = None,
    description: str = "",
    describe: Callable[[T], str] | None = None,
    progress: bool = True,
) -> Iterator[T]:
    """The same items, with a bar that counts them.

    Args:
        items: any iterable: moves, runs, steps of `smc`.
        total: how many there will be; by default the length, where there is one.
        description: beside the bar.
        describe: the description after each item, in place of that.
        progress: False for no bar.
    """
    if not progress:
        yield from items
        return
    expected = len(items) if total is None and isinstance(items, Sized) else total
    with sole_bar() as bar:
        task = bar.add_task(description, total=expected)
        for item in items:
            bar.update(task, advance=1, description=describe(item) if describe else description)
            yield item
