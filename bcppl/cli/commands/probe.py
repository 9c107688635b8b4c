"""`bcppl probe`: where to touch or look next, from a recording or a belief."""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from bcppl.arguments import LARGEST_SEED
from bcppl.cli.options import (
    AsJson,
    Force,
    Given,
    InferenceName,
    Inside,
    Link,
    LinkFromPeg,
    ModelName,
    Of,
    Particles,
    Settings,
    TableHeight,
    WorldFromBase,
)
from bcppl.cli.outputs import files_of_run, refuse_overwriting
from bcppl.errors import InputError
from bcppl.untrusted.visible_text import visible

if TYPE_CHECKING:
    from rich.table import Table

    from bcppl.inference.design.ranking import Ranking

WIDEST = 1000  # characters of a row of the table


def probe(
    recording: Given,
    candidates: Annotated[
        str | None,
        typer.Option(
            help="A file of plans and views, or kinds and how many of each: touch (one place of the "
            "surface), lean (the same with the peg turned), slide (a touch led on along it), pair (two faces "
            "in turn), search (a spiral over the hole), attempt (straight into it), view (a depth image); "
            "touch:12,lean:4,slide:12,pair:4 by default. "
            "Faces are named by their normals in the part's frame."
        ),
    ] = None,
    top: Annotated[int, typer.Option(min=1, help="How many of the best are shown.")] = 5,
    output: Annotated[
        Path | None,
        typer.Option(
            dir_okay=False, help="File for the best action (.h5 or .json); a picture goes beside it (.png)."
        ),
    ] = None,
    of: Of = None,
    model: ModelName = None,
    set_: Settings = None,
    inference: InferenceName = None,
    particles: Particles = 75,
    seed: Annotated[int, typer.Option(min=0, max=LARGEST_SEED, help="Same seed, same ranking.")] = 0,
    outer_samples: Annotated[
        int | None,
        typer.Option(min=2, help="How many particles serve as the true value in turn; all by default."),
    ] = None,
    by: Annotated[
        Literal["linearised", "reweighted"] | None,
        typer.Option(help="How gains are estimated; linearised by default where the model's sensors can be."),
    ] = None,
    rate: Annotated[float, typer.Option(min=0.0, help="Nats that a second of the arm's time costs.")] = 0.0,
    horizon: Annotated[
        int, typer.Option(min=1, max=2, help="1, or 2: the best probe after it counts as well.")
    ] = 1,
    force: Force = None,
    seconds: Annotated[float | None, typer.Option(help="Plans that last longer are left out.")] = None,
    table: TableHeight = None,
    inside: Inside = None,
    above: Annotated[
        float | None,
        typer.Option(
            min=0.0,
            max=180.0,
            help="Degrees; only touches and views from so near to straight above are kept.",
        ),
    ] = None,
    robot: Annotated[
        str | None,
        typer.Option(help="An arm (panda, iiwa or a URDF file): what it does not reach is left out."),
    ] = None,
    link: Link = None,
    link_from_peg: LinkFromPeg = None,
    world_from_base: WorldFromBase = None,
    as_json: AsJson = False,
) -> None:
    """Rank candidates for the next touch or view by their expected information gain, in nats."""
    from rich.console import Console
    from rich.markup import escape

    from bcppl.cli import candidates as options, loading
    from bcppl.cli.posterior import posterior
    from bcppl.figures import action_in_3d
    from bcppl.inference.design.rules import by_linearised_gain, by_reweighted_gain, can_be_linearised
    from bcppl.inference.planning.candidate_layout import require_uncertain
    from bcppl.recordings.action_file import save_actions
    from bcppl.recordings.hdf5 import replacing
    from bcppl.sensors import sensor_of
    from bcppl.sensors.candidates import duration_of, name_of, named_apart, planner_of, with_candidates

    output = Path(f"{Path(recording).stem}_next.json") if output is None else output
    picture = _picture(output, [recording, *filter(None, (candidates, of, model, inference))])
    asked, point = options.asked_for(candidates), options.point_inside(inside)
    constraints = options.constraints(force, seconds, above)
    constraints += options.reach(robot, link, link_from_peg, world_from_base, seed)
    console = Console(highlight=False, stderr=as_json)
    refuse = partial(options.refuse_without_peg, asked)
    given = loading.settings(set_ or [])
    now = posterior(recording, of, model, given, inference, particles, seed, console, refuse)
    belief = now.population.belief(now.model.pose)
    require_uncertain(belief)
    listed = options.planned(asked, belief, now.recording, constraints, table, seed, point)
    console.print(escape(visible(str(listed))), soft_wrap=True)
    scene = now.model.prepare(with_candidates(now.recording, listed))
    linearised = can_be_linearised(scene, listed)
    if by == "linearised" and not linearised:
        raise InputError("--by linearised needs a model whose sensors can be linearised; leave it out.")
    kind = by_linearised_gain if linearised and by != "reweighted" else by_reweighted_gain
    settings = {"outer_samples": outer_samples, "rate": rate, "horizon": horizon, "seed": seed}
    rule = kind(now.model.pose, cost=duration_of, **settings)
    with console.status("ranking"):
        ranking = rule(now.population, listed, scene)
    table_of_best = _table(ranking, top)
    # Nothing in it is cut, also where the output is no terminal.
    wide = console.measure(table_of_best, options=console.options.update(max_width=WIDEST)).maximum
    console.width = max(console.width, wide)
    console.print(table_of_best)
    best = named_apart(ranking.best.candidate, now.recording)
    save_actions([best], output)
    shown = f"next: {name_of(best)}", belief.world_from_part.numpy(), belief.log_weights.numpy()
    alike = [c for c in listed if sensor_of(c) is sensor_of(best)]
    others = alike if planner_of(best).needs_peg else []
    figure = action_in_3d(now.recording.part, shown, best, now.recording.peg, others)
    with replacing(picture) as beside:
        figure.savefig(beside, dpi=150, format="png")
    console.print(f"the best is in {output}, its picture in {picture}", soft_wrap=True, markup=False)
    if as_json:
        print(json.dumps({"entropy": ranking.entropy, "best": str(output), "ranking": _tree(ranking)}))


def _picture(output: Path, given: Sequence[str]) -> Path:
    """The picture's file; refuses what cannot be written, or would overwrite what is read."""
    from bcppl.recordings.action_file import SUFFIXES

    if output.suffix not in SUFFIXES:
        raise InputError(f"--output is {output}; give a file that ends in {' or '.join(SUFFIXES)}.")
    picture = output.with_suffix(".png")
    for file in (output, picture):
        refuse_overwriting("--output", file, *given, *files_of_run(given[0]))
    return picture


def _tree(ranking: Ranking) -> list[dict[str, Any]]:
    from bcppl.sensors.candidates import duration_of, name_of

    return [
        {
            "what": name_of(each.candidate),
            "information_gain": each.information_gain,
            "standard_error": each.standard_error,
            "cost": each.cost,
            "value": each.value,
            "seconds": duration_of(each.candidate),
        }
        for each in ranking
    ]


def _table(ranking: Ranking, top: int) -> Table:
    from rich.markup import escape
    from rich.table import Table

    from bcppl.inference.planning.motions import pressing_force
    from bcppl.sensors.candidates import duration_of, motion_of, name_of

    table = Table(
        title=f"entropy now: {ranking.entropy:.2f} nats", title_justify="left", box=None, pad_edge=False
    )
    columns = ("rank", "what", "gain (nats)", "error", "cost (nats)", "value", "time (s)", "press (N)")
    for k, name in enumerate(columns):
        table.add_column(name, justify="left" if k == 1 else "right", no_wrap=True)
    for k, each in enumerate(ranking[:top]):
        what = each.candidate
        cells = (each.information_gain, each.standard_error, each.cost, each.value, duration_of(what))
        numbers = [f"{value:.2f}" for value in cells]
        numbers[1] = f"± {numbers[1]}"
        motion = motion_of(what)
        press = "" if motion is None else f"{pressing_force(motion):.1f}"
        table.add_row(str(k + 1), escape(visible(name_of(what))), *numbers, press)
    return table
