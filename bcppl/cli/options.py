"""Options that several commands share."""

from __future__ import annotations

from typing import Annotated

import typer

Settings = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="NAME=VALUE",
        help="A setting of the model, such as profile=panda; may be repeated. A belief has those of its run.",
    ),
]

AsJson = Annotated[
    bool, typer.Option("--json", help="Print the result as JSON; all else goes to standard error.")
]
