"""`bcppl probe`: where to touch or look next, from a recording or a belief."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from bcppl import poses
from bcppl.arguments import number_within, whole_number
from bcppl.beliefs import Belief
from bcppl.cli import loading
from bcppl.cli.known import Known, known
from bcppl.errors import InputError
from bcppl.figures import action_in_3d
from bcppl.geometry.gap import PegGap
from bcppl.inference.design.ranking import Ranking
from bcppl.inference.design.rules import Rank, by_information, by_reweighing, can_be_linearised
from bcppl.inference.planning.candidate_list import MIXED, candidates, refuse_settled
from bcppl.inference.planning.filters import (
    Candidates,
    Filter,
    Mounted,
    clear_of_part,
    clear_of_table,
    filtered,
    from_within,
    no_harder_than,
    no_longer_than,
    pressing_force,
    refuse_none,
    within_reach,
)
from bcppl.inference.planning.kinds import SOURCES, kinds
from bcppl.models.robots import load_robot
from bcppl.recordings import Recording
from bcppl.recordings.action_file import SUFFIXES, load_actions, save_actions
from bcppl.robot.plan import Plan
from bcppl.sensors import View, sensor_of
from bcppl.sensors.candidates import (
    Candidate,
    duration_of,
    motion_of,
    name_of,
    named_apart,
    planner_of,
    with_candidates,
)

DEFAULT = ",".join(f"{kind}:{count}" for kind, count in MIXED.items())
WAYS = ("linearised", "reweighing")
COUNT = 8  # of a kind that is named without a number
MOST = 10_000  # of a kind: more fit no memory, and are ranked in hours
NUMBERS = "x y z qw qx qy qz"
STILL = "0 0 0 1 0 0 0"


def probe(
    recording: Annotated[
        str,
        typer.Argument(
            help="A recording (.h5), a shipped one's name, or a belief that `bcppl run` wrote (belief_*.h5)."
        ),
    ],
    candidates: Annotated[
        str,
        typer.Option(
            help="A file of plans and views, or kinds and how many of each: touch (one place of the "
            "surface), slide (a touch led on along it), pair (two faces in turn), search (a spiral over the "
            "hole), attempt (straight into it), view (a depth image). Faces are named by where they look to "
            "in the part's frame."
        ),
    ] = DEFAULT,
    top: Annotated[int, typer.Option(help="How many of the best are shown.")] = 5,
    output: Annotated[
        Path | None,
        typer.Option(help="File for the best action (.h5 or .json); a picture goes beside it (.png)."),
    ] = None,
    of: Annotated[str | None, typer.Option(help="The recording that a belief is of.")] = None,
    model: Annotated[str | None, typer.Option(help="A model's name or file, as for `bcppl run`.")] = None,
    inference: Annotated[
        str | None, typer.Option(help="An inference program's name or file, as for `bcppl run`.")
    ] = None,
    particles: Annotated[int, typer.Option(help="How many particles; a belief has its own.")] = 75,
    seed: Annotated[int, typer.Option(help="Same seed, same ranking.")] = 0,
    hypotheses: Annotated[
        int | None, typer.Option(help="How many particles play the truth; all by default.")
    ] = None,
    by: Annotated[
        str | None,
        typer.Option(
            help="How gains are foretold: linearised (default for look_and_touch) or reweighing (others)."
        ),
    ] = None,
    rate: Annotated[float, typer.Option(help="Nats that a second of the arm's time costs.")] = 0.0,
    depth: Annotated[int, typer.Option(help="1, or 2: the best probe after it counts as well.")] = 1,
    force: Annotated[float | None, typer.Option(help="N; plans that press harder are left out.")] = None,
    seconds: Annotated[float | None, typer.Option(help="Plans that last longer are left out.")] = None,
    table: Annotated[
        float | None, typer.Option(help="Height (m) of a table that no plan may lead into.")
    ] = None,
    above: Annotated[
        float | None,
        typer.Option(help="Degrees; only touches and views from so near to straight above are kept."),
    ] = None,
    robot: Annotated[
        str | None,
        typer.Option(help="An arm (panda, iiwa or a URDF file): what it does not reach is left out."),
    ] = None,
    link: Annotated[str | None, typer.Option(help="The arm's link that holds the peg.")] = None,
    link_from_peg: Annotated[
        str | None,
        typer.Option(
            help=f"The peg's frame (its tip at the lowest z) in the link's: {NUMBERS}; panda_hand, whose z "
            "leads along the fingers, holds it at about 0 0 0.1 0 1 0 0."
        ),
    ] = None,
    world_from_base: Annotated[
        str | None, typer.Option(help=f"Where the arm stands: {NUMBERS}; at the world's origin by default.")
    ] = None,
) -> None:
    """Say where to touch or look next: candidates by the nats that each is expected to tell."""
    whole_number("--top is {}", top)
    whole_number("--particles is {}", particles, least=2)
    loading.refuse_seed(seed)
    number_within("--rate is {}", rate, least=0.0)
    whole_number("--depth is {}", depth, most=2)
    if by not in (None, *WAYS):
        raise InputError(f"--by is {by!r}; give one of {', '.join(WAYS)}.")
    output = Path(f"{Path(recording).stem}_next.json") if output is None else output
    picture = _picture(output, [recording, candidates, *filter(None, (of, model, inference))])
    if hypotheses is not None:
        whole_number("--hypotheses is {}", hypotheses, least=2)
    if table is not None:
        number_within("--table is {}", table)
    own = load_actions(candidates) if _is_file(candidates) else None
    kinds = _kinds(candidates) if own is None else {}
    filters = [] if seconds is None else [no_longer_than(seconds)]
    filters += _filters(force, above, robot, link, link_from_peg, world_from_base, seed)
    console = Console(highlight=False)
    pegless = _pegless(own, kinds)
    before = known(recording, of, model, inference, particles, seed, console, pegless)
    found = _found(before, own, kinds, [*_table(before, table), *filters], seed)
    console.print(escape(str(found)), soft_wrap=True)
    scene = before.model.prepare(with_candidates(before.recording, found))
    with console.status("ranking"):
        settings = {"hypotheses": hypotheses, "cost": duration_of, "rate": rate, "depth": depth, "seed": seed}
        rank = _rank(by, before, scene, found, settings)
        try:
            ranking = rank(before.population, found, scene)
        except (AttributeError, KeyError, TypeError) as error:
            raise InputError(
                f"model {model or before.recording.model} cannot foretell what views and plans of a peg "
                "would observe; run a model of depth images and of a peg's touches, such as look_and_touch; "
                "pushes of a point finger are ranked from Python, with expected_information_gain."
            ) from error
    console.width = max(console.width, 100)  # no number is cut, also where the output is no terminal
    console.print(_shown(ranking, top))
    best = named_apart(ranking.best.candidate, before.recording)
    save_actions([best], output)
    _draw(before, best, found).savefig(picture, dpi=150)
    console.print(f"the best is in {output}, its picture in {picture}", soft_wrap=True)


def _picture(output: Path, given: Sequence[str]) -> Path:
    """Where the picture goes; refuses what cannot be written, or would overwrite what is read."""
    if output.suffix not in SUFFIXES:
        raise InputError(f"--output is {output}; give a file that ends in {' or '.join(SUFFIXES)}.")
    if not output.parent.is_dir():
        raise InputError(f"there is no folder {output.parent} to write {output.name} into; make it first.")
    picture = output.with_suffix(".png")
    for file in (output, picture):
        if file.is_dir():
            raise InputError(f"{file} is a folder; give another name for the best action with --output.")
        for name in given:
            if file.exists() and Path(name).exists() and file.samefile(name):
                raise InputError(
                    f"--output would overwrite {name}, which is read; give another name for the best action."
                )
    return picture


def _rank(
    by: str | None, before: Known, scene: Any, found: Sequence[Candidate], settings: dict[str, Any]
) -> Rank:
    """By linearised likelihoods where the model's sensors have them, else by reweighing."""
    if by == "reweighing" or (by is None and not can_be_linearised(scene, found)):
        return by_reweighing(before.model.pose, **settings)
    return by_information(before.model.pose, **settings)


def _pegless(own: Sequence[Plan | View] | None, kinds: dict[str, int]) -> Callable[[Recording], None]:
    """Refuses a recording without a peg where one is needed, before anything is run."""
    asked = [name_of(each) for each in own or () if planner_of(each).needs_peg] or [
        kind for kind, count in kinds.items() if count and kind in SOURCES
    ]

    def check(recording: Recording) -> None:
        if asked and recording.peg is None:
            raise InputError(
                f"the recording holds no peg to carry out {asked[0]!r} with; add the peg, or where the model "
                "explains depth images ask for views (--candidates view:8)."
            )

    return check


def _is_file(words: str) -> bool:
    return Path(words).suffix in SUFFIXES or "/" in words


def _kinds(words: str) -> dict[str, int]:
    """Numbers by kind, of words such as touch:20,slide."""
    found: dict[str, int] = {}
    for word in filter(None, (each.strip() for each in words.split(","))):
        kind, _, count = word.partition(":")
        if kind not in kinds() or (count and not count.isdecimal()):
            raise InputError(
                f"--candidates has {word!r}; give kinds ({', '.join(kinds())}), each with a number if you "
                "like (touch:20,slide:12), or a file that ends in .h5 or .json."
            )
        if len(count) > len(str(MOST)) or int(count or COUNT) > MOST:
            raise InputError(f"--candidates asks for {count[:20]} of {kind}; give {MOST} at most.")
        found[kind] = found.get(kind, 0) + int(count or COUNT)
    if not any(found.values()):
        raise InputError(
            f"there are no candidates: --candidates is {words!r}; give kinds such as touch:20,slide:12, or a "
            "file of plans."
        )
    return found


def _filters(
    force: float | None,
    above: float | None,
    robot: str | None,
    link: str | None,
    link_from_peg: str | None,
    world_from_base: str | None,
    seed: int,
) -> list[Filter]:
    found = [] if force is None else [no_harder_than(force)]
    if above is not None:
        number_within("--above is {}", above, least=0.0, most=180.0)
        says = f"come from more than {above:g}° beside straight above"
        found.append(from_within((0.0, 0.0, -1.0), math.radians(above), says))
    if robot is not None:
        if link is None:
            raise InputError("--robot is given without --link; say which link of the arm holds the peg.")
        arm = load_robot(robot, tip=link)
        if link_from_peg is None:
            raise InputError(
                "--robot is given without --link-from-peg; say how the link holds the peg (panda_hand, whose "
                'z leads along the fingers, at about "0 0 0.1 0 1 0 0").'
            )
        held, stands = (
            _pose("--link-from-peg", link_from_peg),
            _pose("--world-from-base", world_from_base or STILL),
        )
        found.append(within_reach(Mounted(arm, link, held, stands), seed=seed))
    elif (link, link_from_peg, world_from_base) != (None, None, None):
        raise InputError("--link, --link-from-peg and --world-from-base are of an arm; give it with --robot.")
    return found


def _pose(option: str, words: str) -> Any:
    try:
        numbers = np.array([float(word) for word in words.replace(",", " ").split()])
    except ValueError:
        raise InputError(f"{option} is {words!r}; give seven numbers, {NUMBERS}, in metres.") from None
    if numbers.shape != (7,):
        raise InputError(f"{option} has {numbers.size} numbers; give seven, {NUMBERS}, in metres.")
    return poses.as_pose(numbers, option).numpy()


def _table(before: Known, height: float | None) -> list[Filter]:
    if height is None or before.recording.peg is None:
        return []
    return [clear_of_table(before.recording.peg, height)]


def _found(
    before: Known,
    own: Sequence[Plan | View] | None,
    kinds: dict[str, int],
    filters: Sequence[Filter],
    seed: int,
) -> Candidates:
    """A user's own list, or candidates of kinds."""
    belief = _belief(before)
    if own is not None:
        refuse_none(Candidates(tuple(own)))
        names = [name_of(each) for each in own]
        if len(set(names)) < len(names):
            twice = next(name for name in names if names.count(name) > 1)
            raise InputError(f"two candidates are called {twice!r}; give each a name of its own.")
        if before.recording.peg is not None and any(planner_of(each).needs_peg for each in own):
            gap = PegGap(before.recording.part, before.recording.peg)
            filters = [clear_of_part(gap, belief.mean), *filters]
        return filtered(own, filters)
    recording = before.recording
    return candidates(
        belief,
        recording.part,
        recording.peg,
        kinds,
        filters=filters,
        like=[m.action for m in recording.measurements],
        seed=seed,
    )


def _belief(before: Known) -> Belief:
    belief = before.population.belief(before.model.pose)
    refuse_settled(belief)
    return belief


def _shown(ranking: Ranking, top: int) -> Table:
    shown = Table(
        title=f"entropy now: {ranking.entropy:.2f} nats", title_justify="left", box=None, pad_edge=False
    )
    columns = ("rank", "what", "gain (nats)", "error", "cost (nats)", "value", "time (s)", "press (N)")
    for k, name in enumerate(columns):
        shown.add_column(name, justify="left" if k == 1 else "right", no_wrap=True)
    for k, each in enumerate(ranking[:top]):
        what = each.candidate
        cells = (each.information_gain, each.standard_error, each.cost, each.value, duration_of(what))
        numbers = [f"{value:.2f}" for value in cells]
        numbers[1] = f"± {numbers[1]}"
        motion = motion_of(what)
        press = "" if motion is None else f"{pressing_force(motion):.1f}"
        shown.add_row(str(k + 1), escape(name_of(what)), *numbers, press)
    return shown


def _draw(before: Known, best: Candidate, found: Sequence[Candidate]) -> Any:
    belief = _belief(before)
    shown = f"next: {name_of(best)}", belief.world_from_part.numpy(), belief.log_weights.numpy()
    others = [c for c in found if sensor_of(c) is sensor_of(best)] if planner_of(best).needs_peg else []
    return action_in_3d(before.recording.part, shown, best, before.recording.peg, others)
