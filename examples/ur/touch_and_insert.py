"""Look, choose, touch, update, insert with a UR arm: the whole loop while the arm moves.

    python touch_and_insert.py look.h5 --host 192.168.0.2 --probes 2

`look.h5` is a recording of part, guess, peg and depth images, as `bcppl import bench` makes one.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Callable
from dataclasses import replace

import torch
from arm import Reading, URArm

import bcppl
from bcppl import poses
from bcppl.inference.live import Filter, Sampler
from bcppl.robot.execution import Executor, Limits
from bcppl.robot.plan import Plan
from bcppl.sensors.candidates import named_apart

LIMITS = Limits(force=60.0, speed=0.06, free_speed=0.25)
AHEAD = 0.008  # s: a command reaches the arm as late as this


def execute(
    arm: URArm, plan: Plan, heard: Callable[[Reading], None], tare: object = None, stop_at_hole: bool = False
) -> tuple[Executor, Reading]:
    """Execute a plan from the arm's newest stamp on; `heard` is given every reading."""
    reading = arm.read()
    plan = replace(plan, times=plan.times - plan.times[0] + reading.stamp + 0.02)
    executor = Executor(plan, tare=tare, stop_at_hole=stop_at_hole, limits=LIMITS)  # type: ignore[arg-type]
    stamps = executor.probe.stamps
    while executor.state == "moving":
        heard(reading)
        while executor.state == "moving" and reading.stamp >= stamps[executor.taken] - 1e-6:
            executor.sample(reading.wrench[:3], lambda reading=reading: reading.world_from_peg)
        arm.command(executor.commanded(reading.stamp + AHEAD), plan.stiffness)
        reading = arm.read()
    heard(reading)  # after the last stamp: what is between it and the one before is known
    if executor.state == "aborted":
        raise SystemExit(executor.reason)
    return executor, reading


def move_to(arm: URArm, world_from_peg: object, like: Plan, height: float) -> None:
    """Go to a pose over a point high above all, at 0.1 m/s."""
    here = arm.read().world_from_peg
    there = torch.as_tensor(world_from_peg).numpy()
    knots = [here, here, there, there]
    knots = [each.copy() for each in knots]
    knots[1][2] = knots[2][2] = max(height, here[2], there[2])
    times = [0.0]
    for one, other in itertools.pairwise(knots):
        times.append(times[-1] + max(0.3, float(((one - other)[:3] ** 2).sum() ** 0.5) / 0.1))
    plan = replace(like, name="on the way", times=times, world_from_peg=knots, manners=("free",) * 3)
    execute(arm, plan, lambda reading: None)


def touch(arm: URArm, live: Filter, plan: Plan) -> None:
    """Execute a plan, and give its windows to the filter while it is executed."""
    sampler: list[Sampler] = []

    def heard(reading: Reading) -> None:
        if not sampler:
            first = replace(plan, times=plan.times - plan.times[0] + reading.stamp + 0.02)
            sampler.append(Sampler(bcppl.robot.plan.probe_of(first)))
        windows = sampler[0].wrench(reading.stamp, reading.wrench)
        for each in [*windows, *sampler[0].pose(reading.stamp, reading.world_from_peg)]:
            live.observe(each.action, each.observation)

    execute(arm, plan, heard)
    for each in sampler[0].finish():
        live.observe(each.action, each.observation)


def main() -> None:
    """Touch, and insert."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("look", help="the recording to begin from")
    parser.add_argument("--host", default="127.0.0.1")
    parser.add_argument("--probes", type=int, default=2)
    parser.add_argument("--profile", default="ur5e", help="of the bench, or a file")
    arguments = parser.parse_args()
    recording = bcppl.load(arguments.look)
    model = bcppl.models.look_and_touch.model.with_settings(profile=arguments.profile)
    high = float(recording.guess.world_from_part[2]) + 0.1 - float(recording.peg.vertices[:, 2].min())
    arm = URArm(arguments.host)
    with Filter(model, recording) as live:
        live.settle()
        for _ in range(arguments.probes):
            best = live.next_probe().best
            plan = named_apart(best.candidate, live.recording)
            print(f"{plan.name}: {best.information_gain:.2f} nats expected", flush=True)
            move_to(arm, plan.world_from_peg[0], plan, high)
            touch(arm, live, plan)
            spread = 1e3 * live.settle().belief.spread[:3]
            print(f"  spread {' '.join(f'{each:.3f}' for each in spread.tolist())} mm", flush=True)
        insertion = live.insertion()
        move_to(arm, insertion.search.world_from_peg[0], insertion.search, high)
        _, last = execute(arm, insertion.search, lambda reading: None, stop_at_hole=True)
        push = insertion.push_from(last.world_from_peg)
        execute(arm, push, lambda reading: None)
        hole = torch.from_numpy(insertion.world_from_hole)
        tip = torch.tensor([[0.0, 0.0, float(recording.peg.vertices[:, 2].min())]], dtype=torch.float64)
        at = poses.transform(torch.from_numpy(arm.read().world_from_peg), tip)
        depth = -float(poses.transform(poses.inverse(hole), at)[0, 2])
        ended = "inserted" if depth > insertion.deep_enough else "NOT inserted"
        print(f"{ended}: the tip is {1e3 * depth:.1f} mm deep", flush=True)
    arm.close()


if __name__ == "__main__":
    main()
