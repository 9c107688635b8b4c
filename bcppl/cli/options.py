"""Options that several commands share."""

from __future__ import annotations

from typing import Annotated

import typer

NUMBERS = "x y z qw qx qy qz"  # of a pose

Settings = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="NAME=VALUE",
        help="A setting of the model, such as profile=panda; may be repeated. A belief has those of its run.",
    ),
]

Recorded = Annotated[str, typer.Argument(help="A recording (.h5), or the name of a shipped one.")]

Given = Annotated[
    str,
    typer.Argument(
        help="A recording (.h5), a shipped one's name, or a belief that `bcppl run` wrote (belief_*.h5)."
    ),
]

Of = Annotated[str | None, typer.Option(help="The recording that a belief is of.")]

ModelName = Annotated[str | None, typer.Option(help="A model's name or file, as for `bcppl run`.")]

InferenceName = Annotated[
    str | None, typer.Option(help="An inference program's name or file, as for `bcppl run`.")
]

Particles = Annotated[int, typer.Option(min=2, help="How many particles; a belief has its own.")]

Inside = Annotated[
    str | None,
    typer.Option(help="A point (m) in the hole, in the part's frame; needed where there are several: x y."),
]

TableHeight = Annotated[float | None, typer.Option(help="Height (m) of a table that no plan may lead into.")]

Force = Annotated[float | None, typer.Option(help="N; plans that press harder are left out.")]

AsJson = Annotated[
    bool, typer.Option("--json", help="Print the result as JSON; all else goes to standard error.")
]

Arm = Annotated[
    str | None,
    typer.Option(
        "--robot", help="The arm that held the peg (panda, iiwa or a URDF file); it is drawn at every touch."
    ),
]

Link = Annotated[str | None, typer.Option(help="The arm's link that holds the peg.")]

LinkFromPeg = Annotated[
    str | None,
    typer.Option(
        help=f"The peg's frame (its tip at the lowest z) in the link's: {NUMBERS}; panda_hand, whose z "
        "leads along the fingers, holds it at about 0 0 0.1 0 1 0 0."
    ),
]

WorldFromBase = Annotated[
    str | None, typer.Option(help=f"Where the arm stands: {NUMBERS}; at the world's origin by default.")
]
