"""`bcppl insert`: a compliant insertion at a belief, its chance, and the file of its plans."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from bcppl.arguments import LARGEST_SEED
from bcppl.cli.options import (
    AsJson,
    Given,
    InferenceName,
    Inside,
    Link,
    LinkFromPeg,
    ModelName,
    Of,
    Particles,
    Settings,
    WorldFromBase,
)
from bcppl.cli.outputs import files_of_run, refuse_overwriting
from bcppl.errors import InputError

if TYPE_CHECKING:
    from torch import Tensor

    from bcppl.arrays import Array
    from bcppl.geometry.parts import Part
    from bcppl.inference.planning.constraints import Constraint
    from bcppl.recordings import Recording
    from bcppl.robot.plan import InsertionPlan, Plan

SIX = "x0 y0 z0 x1 y1 z1"
SURE = 0.95  # a mode with less of the belief's weight is one of several


def insert(
    recording: Given,
    output: Annotated[
        Path, typer.Option("--output", "-o", dir_okay=False, help="File for the plans (.json or .h5).")
    ] = Path("insertion.json"),
    speed: Annotated[
        float, typer.Option(min=0.0001, max=0.1, help="m/s at most, where contact is expected.")
    ] = 0.02,
    force: Annotated[float, typer.Option(min=0.1, max=200.0, help="N; ends the push.")] = 20.0,
    contact_force: Annotated[
        float, typer.Option(min=0.1, max=50.0, help="N; ends the descent: above the noise of the sensor.")
    ] = 0.7,
    workspace: Annotated[
        str | None,
        typer.Option(help=f"Corners of the box (m, in the world) that the peg's tip may not leave: {SIX}."),
    ] = None,
    inside: Inside = None,
    simulations: Annotated[
        int, typer.Option(min=0, help="How many particles the chance is simulated for; 0 for none.")
    ] = 24,
    of: Of = None,
    model: ModelName = None,
    set_: Settings = None,
    inference: InferenceName = None,
    particles: Particles = 75,
    seed: Annotated[int, typer.Option(min=0, max=LARGEST_SEED, help="Same seed, same plan.")] = 0,
    robot: Annotated[
        str | None,
        typer.Option(help="An arm (panda, iiwa or a URDF file): what it cannot follow is refused."),
    ] = None,
    link: Link = None,
    link_from_peg: LinkFromPeg = None,
    world_from_base: WorldFromBase = None,
    as_json: AsJson = False,
) -> None:
    """Plan an insertion where the hole is believed to be, and say how probable it is to succeed."""
    from rich.console import Console

    from bcppl.cli import loading
    from bcppl.cli.candidates import point_inside, reach
    from bcppl.cli.posterior import posterior
    from bcppl.contact.physics import PegPhysics
    from bcppl.geometry.holes import fit_in, hole_of
    from bcppl.inference.planning.insertion import InsertionParameters, hole_estimate, insertion_plan
    from bcppl.inference.planning.success import success_probability
    from bcppl.recordings.action_file import SUFFIXES, save_actions

    if output.suffix not in SUFFIXES:
        raise InputError(f"--output is {output}; give a file that ends in {' or '.join(SUFFIXES)}.")
    refuse_overwriting("--output", output, recording, of, model, inference, *files_of_run(recording))
    box = None if workspace is None else _box(workspace)
    point = point_inside(inside)
    constraints = reach(robot, link, link_from_peg, world_from_base, seed)
    console = Console(highlight=False, stderr=as_json)
    found: dict[str, Any] = {"output": str(output)}
    now = posterior(
        recording, of, model, loading.settings(set_ or []), inference, particles, seed, console, _refuse
    )
    belief, part, peg = now.population.belief(now.model.pose), now.recording.part, now.recording.peg
    assert peg is not None
    usual = InsertionParameters()
    careful = usual._replace(
        landing_speed=min(usual.landing_speed, 0.5 * speed),  # the press before the search is twice as fast
        search_speed=min(usual.search_speed, speed),
        push_speed=min(usual.push_speed, speed),
        push_force=force,
        contact_force=min(contact_force, force),
    )
    hole = hole_of(part, point, peg)
    plan = insertion_plan(belief, part, peg, hole, careful)
    if box is not None:
        _refuse_outside(plan, peg, box)
    _refuse_out_of_reach(plan, constraints)
    save_actions([plan.search, plan.push], output)
    mass, world_from_hole, covariance = hole_estimate(belief, hole, fit_in(hole, peg))
    place, deviation = 1e3 * world_from_hole[:3], _deviation(covariance)
    found |= {"world_from_hole": world_from_hole.tolist(), "deviation_mm": deviation, "mass": mass}
    found |= {"depth": plan.depth, "chamfer": plan.chamfer}
    console.print(
        f"the hole is at {place[0]:.2f} {place[1]:.2f} {place[2]:.2f} mm, sure to {deviation[0]:.2f} mm "
        f"across and {deviation[1]:.2f} mm along its axis (standard deviations, relative to the peg)."
    )
    if mass < SURE:
        console.print(
            f"this is the heaviest of several modes of the belief, with {100.0 * mass:.0f} % of its weight; "
            "touch or look once more before you try it (bcppl probe)."
        )
    seconds = sum(float(each.times[-1] - each.times[0]) for each in (plan.search, plan.push))
    found |= {"reach_mm": (reached := _reach(plan.search))}
    console.print(
        f"search and push take {seconds:.1f} s at most; the search goes {reached:.2f} mm far, and a push of "
        f"{force:g} N ends it."
    )
    if simulations:
        with console.status("simulating"):
            chance = success_probability(
                belief, plan, PegPhysics(part, peg), hole, particles=simulations, seed=seed
            )
        found |= chance._asdict()
        console.print(
            f"of {simulations} simulated insertions {100.0 * chance.success:.0f} % end in the hole (standard "
            f"error {100.0 * chance.standard_error:.0f} %); the search finds it in "
            f"{100.0 * chance.hole_found:.0f} %."
        )
    console.print(f"the plans are in {output}: search, then push from where the search ends.", markup=False)
    if as_json:
        print(json.dumps(found))


def _refuse(recording: Recording) -> None:
    if recording.peg is None:
        raise InputError("the recording holds no peg to insert; add the peg that is held.")


def _box(words: str) -> Array:
    """The lowest and the highest corner (2, 3) of a box, m."""
    from bcppl.cli.candidates import numbers

    corners = numbers("--workspace", words, "six", SIX).reshape(2, 3)
    if not (corners[0] < corners[1]).all():
        raise InputError(f"--workspace is {words[:60]!r}; give the lowest corner, then the highest: {SIX}.")
    return corners


def _refuse_outside(plan: InsertionPlan, peg: Part, box: Array) -> None:
    """Refuse a plan whose tip leaves a box."""
    import torch

    from bcppl import poses
    from bcppl.inference.planning.waypoints import tip_of

    tip = torch.tensor([[0.0, 0.0, tip_of(peg)]], dtype=torch.float64)
    for each in (plan.search, plan.push):
        tips = poses.transform(torch.from_numpy(each.world_from_peg), tip)
        outside = ((tips[:, 0].numpy() < box[0]) | (tips[:, 0].numpy() > box[1])).any(axis=1)
        if outside.any():
            where = " ".join(f"{number:.3f}" for number in tips[int(outside.argmax()), 0].tolist())
            raise InputError(
                f"the {each.name} leads the peg's tip to {where} m, outside --workspace; give a larger box, "
                "or check the belief."
            )


def _refuse_out_of_reach(plan: InsertionPlan, constraints: list[Constraint]) -> None:
    """Refuse a plan that an arm cannot follow without changing its configuration."""
    for each in (plan.search, plan.push):
        for constraint in constraints:
            if not constraint.satisfied([each])[0]:
                raise InputError(
                    f"poses of the {each.name} {constraint.violation}; move the part or the arm's base, or "
                    "check --link-from-peg and --world-from-base."
                )


def _reach(search: Plan) -> float:
    """How far from the expected place a search goes, mm."""
    import numpy as np

    path = search.world_from_peg[search.manners.index("searching") :, :3]
    return 1e3 * float(np.linalg.norm(path - path[0], axis=1).max())


def _deviation(covariance: Tensor) -> tuple[float, float]:
    """Standard deviations of the hole's position, mm: the larger across its axis, and along it."""
    import torch

    across = torch.linalg.eigvalsh(covariance[:2, :2]).max()
    return 1e3 * float(across.sqrt()), 1e3 * float(covariance[2, 2].sqrt())
