"""The option by which commands take settings of a model."""

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
