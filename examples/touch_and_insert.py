"""Choose, touch, update, insert: the whole loop while an arm moves, from images that were taken before.

    python touch_and_insert.py look.h5 --robot ur --host 192.168.0.2 --probes 2

`look.h5` is a recording of part, guess, peg and depth images, as `bcppl import bench` makes one of a
configuration without a wrench.
"""

from __future__ import annotations

import argparse
import importlib
import itertools
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from readings import Arm, Reading

import bcppl
from bcppl import poses
from bcppl.arrays import Array
from bcppl.inference.live import Filter, Sampler
from bcppl.inference.planning.constraints import Constraint
from bcppl.inference.planning.motion_constraints import above_table
from bcppl.robot.execution import Executor, Limits
from bcppl.robot.plan import Plan, probe_of

LIMITS = Limits(force=60.0, speed=0.06, free_speed=0.25)
LEAD = 0.02  # s from the newest reading to the first stamp of a plan
ARMS = {"ur": ("ur.arm", "URArm"), "franka": ("franka.arm", "FrankaArm")}


def unheard(reading: Reading) -> None:
    """Ignore a reading: the arm is on its way."""


def announced(plan: Plan, gain: float) -> None:
    """Print which probe is next."""
    print(f"{plan.name}: {gain:.2f} nats expected", flush=True)


def take(executor: Executor, reading: Reading) -> None:
    """Give a reading to the executor, for each of the plan's stamps that it has come to."""
    while executor.state == "moving" and reading.stamp >= executor.probe.stamps[executor.taken] - 1e-6:
        executor.sample(reading.wrench[:3], lambda: reading.world_from_peg)


def execute(
    arm: Arm,
    plan: Plan,
    heard: Callable[[Reading], None] = unheard,
    stop_at_hole: bool = False,
    tare: Array | None = None,
) -> tuple[Executor, Reading]:
    """Execute a plan from the arm's newest stamp on; `heard` is given every reading.

    The arguments after it are those of `Executor`. The program ends where the plan is aborted, or a search
    for a hole feels no contact.
    """
    readings = arm.read()[-1:]
    # The clock of a plan begins when the arm is ready to follow it, or it would have to catch up.
    ready = readings[0].stamp + arm.settles
    while readings[-1].stamp < ready:
        arm.command(plan.world_from_peg[0], plan.stiffness)
        readings = arm.read()
    readings = readings[-1:]
    plan = replace(plan, times=plan.times - plan.times[0] + readings[0].stamp + LEAD)
    executor = Executor(plan, tare=tare, stop_at_hole=stop_at_hole, limits=LIMITS)
    while executor.state == "moving":
        for reading in readings:
            heard(reading)
            take(executor, reading)
        arm.command(executor.commanded(reading.stamp + arm.ahead), plan.stiffness)
        readings = arm.read()
    if executor.state in ("aborted", "no contact"):
        raise SystemExit(executor.reason)
    # Up to after the last stamp, by both streams: what is between it and the one before is known.
    until = executor.probe.stamps[executor.taken - 1]
    while True:
        for reading in readings:
            heard(reading)
        if min(reading.stamp, reading.posed) >= until:
            return executor, reading
        readings = arm.read()


def move_to(arm: Arm, world_from_peg: Array, like: Plan, height: float) -> None:
    """Go to a pose over a point high above all, at 0.1 m/s and 1 rad/s at most."""
    here, there = arm.read()[-1].world_from_peg, np.asarray(world_from_peg)
    knots = [each.copy() for each in (here, here, there, there)]
    knots[1][2] = knots[2][2] = max(height, here[2], there[2])
    times = [0.0]
    for one, other in itertools.pairwise(knots):
        turn = 2.0 * np.arccos(min(1.0, abs(float(one[3:] @ other[3:]))))
        times.append(times[-1] + max(0.3, float(np.linalg.norm((one - other)[:3])) / 0.1, turn))
    plan = replace(
        like,
        name="on the way",
        times=np.array(times),
        world_from_peg=np.array(knots),
        manners=("free",) * 3,
    )
    execute(arm, plan)


def touch(arm: Arm, live: Filter, plan: Plan) -> Executor:
    """Execute a plan, and give its windows to the filter while it is executed."""
    sampler: list[Sampler] = []

    def heard(reading: Reading) -> None:
        if not sampler:
            first = replace(plan, times=plan.times - plan.times[0] + reading.stamp + LEAD)
            sampler.append(Sampler(probe_of(first)))
        windows = sampler[0].wrench(reading.stamp, reading.wrench)
        for each in [*windows, *sampler[0].pose(reading.posed, reading.world_from_peg)]:
            live.observe(each.action, each.observation)

    executor, _ = execute(arm, plan, heard)
    for each in sampler[0].finish():
        live.observe(each.action, each.observation)
    return executor


def touch_and_insert(
    arm: Arm, live: Filter, probes: int, announce: Callable[[Plan, float], None] = announced
) -> float:
    """How deep (m) the peg's tip is in the hole after so many probes and an insertion."""
    recording = live.recording
    assert recording.peg is not None
    tip = float(recording.peg.vertices[:, 2].min())
    high = float(recording.guess.world_from_part[2]) + 0.1 - tip
    live.settle()
    for _ in range(probes):
        best = live.next_probe().best
        plan = live.named_apart(best.candidate)
        announce(plan, best.information_gain)
        move_to(arm, plan.world_from_peg[0], plan, high)
        touch(arm, live, plan)
        spread = 1e3 * live.settle().belief.spread[:3]
        print(f"  spread {' '.join(f'{each:.3f}' for each in spread.tolist())} mm", flush=True)
    insertion = live.insertion()
    move_to(arm, insertion.search.world_from_peg[0], insertion.search, high)
    search, last = execute(arm, insertion.search, stop_at_hole=True)
    execute(arm, insertion.push_from(last.world_from_peg), tare=search.tare)
    hole = poses.inverse(torch.from_numpy(insertion.world_from_hole))
    lowest = torch.tensor([[0.0, 0.0, tip]], dtype=torch.float64)
    at = poses.transform(torch.from_numpy(arm.read()[-1].world_from_peg), lowest)
    depth = -float(poses.transform(hole, at)[0, 2])
    ended = "inserted" if depth > insertion.deep_enough else "NOT inserted"
    print(f"{ended}: the tip is {1e3 * depth:.1f} mm deep", flush=True)
    return depth


def options(description: str | None) -> argparse.ArgumentParser:
    """The options that all programs have."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("look", help="the recording to begin from")
    parser.add_argument("--probes", type=int, default=2)
    parser.add_argument("--profile", default="ur5e", help="of the bench, or a file")
    parser.add_argument("--table", type=float, help="height (m) of a table that no touch may lead into")
    return parser


def limits(recording: bcppl.Recording, table: float | None) -> list[Constraint]:
    """What touches may not do."""
    return [] if table is None else [above_table(recording.peg, table)]


def main() -> None:
    """Touch, and insert."""
    parser = options(__doc__)
    parser.add_argument("--robot", choices=ARMS, default="ur")
    parser.add_argument("--host", default="127.0.0.1")
    arguments = parser.parse_args()
    recording = bcppl.load(arguments.look)
    model = bcppl.models.look_and_touch.model.with_settings(profile=arguments.profile)
    module, name = ARMS[arguments.robot]
    arm: Arm = getattr(importlib.import_module(module), name)(arguments.host)
    with Filter(model, recording, constraints=limits(recording, arguments.table)) as live:
        touch_and_insert(arm, live, arguments.probes)
    arm.close()


if __name__ == "__main__":
    main()
