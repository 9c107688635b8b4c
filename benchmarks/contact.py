"""Contact physics beside a bare MuJoCo rollout, and what shared free motion and nuisance parameters cost.

Beside it stands the lower bound: sharing all free motion would leave the particles that are in contact.
"""

from __future__ import annotations

import itertools
import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import mujoco
import mujoco.rollout
import numpy as np
import torch
from report import Row, cores, finish, options, show
from torch import Tensor

from bcppl import poses
from bcppl.contact.mujoco_model import build_model, rollout_controls, set_controller
from bcppl.contact.nuisances import Nuisances
from bcppl.contact.particle_models import ParticleModels
from bcppl.contact.physics import PegPhysics
from bcppl.contact.sensing.location import ContactSensing
from bcppl.contact.stepping import WRENCH
from bcppl.distributions.poses import prior_from_guess
from bcppl.inference.filters.tempered_smc import infer
from bcppl.models.peg_in_hole import model
from bcppl.models.worlds.peg_in_hole import simulate_recording
from bcppl.recordings import Recording
from bcppl.robot.motion import Probe, ProbeWindow
from bcppl.sensors.likelihoods.simulated_probe import CONTACT

PARTICLES = 75
TOUCHING = 0.1  # N more or less than in free motion: what a wrist sensor's noise is
STRETCH = 10  # stamps
CONTROL = int(
    mujoco.mjtState.mjSTATE_CTRL | mujoco.mjtState.mjSTATE_MOCAP_POS | mujoco.mjtState.mjSTATE_MOCAP_QUAT
)


def timed(runs: Mapping[str, Callable[[], Any]], repeats: int) -> dict[str, float]:
    """Seconds of each run, medians over repeats in which they take turns, after one that is not counted."""
    spent: dict[str, list[float]] = {name: [] for name in runs}
    for repeat in range(repeats + 1):
        for name, run in runs.items():
            begun = time.perf_counter()
            run()
            if repeat:
                spent[name].append(time.perf_counter() - begun)
    return {name: statistics.median(each) for name, each in spent.items()}


def bare(recording: Recording, probe: Probe, world_from_part: Tensor) -> tuple[Callable[[], Any], int]:
    """MuJoCo's own rollout of the same model, controls and steps, all arrays ready-made; and its steps."""
    assert recording.peg is not None
    chosen = build_model(recording.part, recording.peg, CONTACT)
    set_controller(chosen, probe)
    steps = 1 + round((probe.stamps[-1] - probe.command_times[0]) / CONTACT.time_step)
    commanded = rollout_controls(probe, probe.command_times[0] + CONTACT.time_step * np.arange(steps))
    part = world_from_part.numpy()
    control = np.empty((len(part), steps, 20))
    control[..., :9], control[..., 12:16] = commanded[:, :9], commanded[:, 9:]
    control[..., 9:12], control[..., 16:] = part[:, None, :3], part[:, None, 3:]
    size = mujoco.mj_stateSize(chosen, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    state = np.zeros((len(part), size))
    state[:, 1:8] = commanded[0, 6:]
    pool = mujoco.rollout.Rollout(nthread=cores())
    data = [mujoco.MjData(chosen) for _ in range(cores())]
    return lambda: pool.rollout(chosen, data, state, control, control_spec=CONTROL), steps


def after_vision(recording: Recording, particles: int) -> Tensor:
    """Equally weighted poses (N, 7) of the belief after the depth images."""
    views = [m for m in recording.measurements if m.kind == "view"]
    *_, last = infer(model, replace(recording, measurements=views), particles=particles, seed=1)
    chosen = torch.multinomial(last.belief.weights, particles, replacement=True)
    return last.belief.world_from_part[chosen]


def least(physics: PegPhysics, pose: Tensor, probe: Probe, repeats: int) -> tuple[float, float]:
    """What sharing all free motion would leave: shares of the steps and of the time spent in contact.

    In every tenth of a second only the particles that are in contact then are simulated, from states that are
    given; the time is compared with that of all particles in the same stretches. No skip leaves fewer steps;
    short runs of few particles cost more for each step, so that a skip that runs longer ones may take less
    time than this.
    """
    simulation = physics.start(pose, probe).simulation
    stepper, free, part = simulation.steppers[0], simulation.free_motion.rows, pose.numpy()
    ends = list(range(0, len(probe.stamps) + 1, STRETCH))
    state, stretches = stepper.at_rest(len(part)), []
    for first, last in itertools.pairwise(ends):
        rows, moved = stepper.run(state, part, {}, first, last)
        felt = (
            np.linalg.norm(rows[..., WRENCH][..., :3] - free[first:last, WRENCH][..., :3], axis=-1) > TOUCHING
        )
        stretches.append((first, last, state, felt))
        state = moved

    def spent(only: bool) -> None:
        for first, last, before, felt in stretches:
            some = felt.any(axis=1) if only else np.ones(len(part), dtype=bool)
            if some.any():
                stepper.run(before[some], part[some], {}, first, last)

    found = timed({"touching": lambda: spent(True), "all": lambda: spent(False)}, repeats)
    share = float(np.mean([felt for *_, felt in stretches]))
    return share, found["touching"] / found["all"]


def nuisances(particles: int) -> dict[str, Nuisances]:
    """Nuisance parameters, as a model would sample them."""
    one = torch.ones(particles, dtype=torch.float64)
    spread = torch.rand(particles, dtype=torch.float64)
    offset = torch.randn(particles, 6, dtype=torch.float64) * torch.tensor([0.001] * 3 + [0.02] * 3)
    shared = {
        "friction": 0.2 + 0.2 * spread,
        "grip_from_peg": poses.retract(poses.identity(particles), offset),
    }
    return {
        "friction": Nuisances(friction=shared["friction"]),
        "friction and the peg in the hand": Nuisances(**shared),
        "controller's stiffness": Nuisances(stiffness=0.8 + 0.4 * spread),
        "grasp's compliance": Nuisances(grasp_compliance=1e-5 * spread[:, None] * one[:, None].expand(-1, 6)),
    }


def main() -> None:
    arguments = options(__doc__ or "").parse_args()
    torch.manual_seed(arguments.seed)
    particles, repeats = (25, 2) if arguments.quick else (PARTICLES, 9)
    recording = simulate_recording(arguments.seed)
    assert recording.peg is not None and recording.truth is not None
    peg = recording.peg
    probe = next(m.action.probe for m in recording.measurements if isinstance(m.action, ProbeWindow))
    stamps = len(probe.stamps)
    beliefs = {
        "prior": prior_from_guess(recording.guess).sample((particles,)),
        "after vision": after_vision(recording, particles),
    }
    whole, skipping = (
        PegPhysics(recording.part, peg, CONTACT, share_free_motion=skip) for skip in (False, True)
    )
    sensing = ContactSensing(peg, rate=(stamps - 1) / (probe.stamps[-1] - probe.stamps[0]))
    rows: list[Row] = []

    def run(physics: PegPhysics, pose: Tensor, given: Nuisances | None = None) -> Callable[[], Any]:
        return lambda: physics.start(pose, probe, given).advance(stamps)

    lines = []
    for name, pose in beliefs.items():
        alone, steps = bare(recording, probe, pose)
        wrench = whole.start(pose, probe).advance(stamps).wrench
        found = timed(
            {
                "bare": alone,
                "ours": run(whole, pose),
                "skipping": run(skipping, pose),
                "sensing": lambda wrench=wrench: sensing.contacts(wrench, sensing.start(particles)),
            },
            repeats,
        )
        before = skipping.effort.copy()
        run(skipping, pose)()
        share = skipping.effort.since(before).amount / (particles * steps * CONTACT.time_step)
        ratio, saved = found["ours"] / found["bare"], found["skipping"] / found["ours"]
        rate = particles * steps / found["ours"]
        touching, at_least = least(whole, pose, probe, repeats)
        times = (1e3 * found[k] for k in found)
        lines.append([name, *times, ratio, saved, at_least, share, touching, rate / 1e3])
        rows += [
            Row(f"{name}: whole rollout / bare mujoco.rollout", ratio, "", 1.3),
            Row(f"{name}: with skip / without, time", saved, "", 0.5),
            Row(f"{name}: with skip / without, steps", share, ""),
            Row(f"{name}: steps per second", rate, "1/s"),
            Row(f"{name}: in contact, share of the steps", touching, ""),
            Row(f"{name}: only what is in contact, in stretches of 0.1 s, time", at_least, ""),
            Row(f"{name}: sensing / whole rollout", found["sensing"] / found["ours"], ""),
        ]
    show(
        f"{particles} particles x {probe.stamps[-1]:.2f} s, steps of {1e3 * CONTACT.time_step:g} ms",
        [
            "",
            "bare ms",
            "whole ms",
            "skipping ms",
            "sensing ms",
            "whole/bare",
            "skip/whole",
            "only touching",
            "steps",
            "touching",
            "1000 steps/s",
        ],
        lines,
    )

    pose, given = beliefs["after vision"], nuisances(particles)
    found = timed(
        {
            f"{name}, {kind}": run(physics, pose, each)
            for name, each in {"nothing": None, **given}.items()
            for kind, physics in (("whole", whole), ("skipping", skipping))
        },
        max(2, repeats // 2),
    )
    lines = []
    for name in ("nothing", *given):
        one, two = found[f"{name}, whole"], found[f"{name}, skipping"]
        lines.append(
            [name, 1e3 * one, one / found["nothing, whole"], 1e3 * two, two / found["nothing, skipping"]]
        )
        rows.append(Row(f"unknown {name}: whole rollout / with nothing unknown", lines[-1][2], ""))
        rows.append(Row(f"unknown {name}: with skip / with nothing unknown", lines[-1][4], ""))
    show("unknown, after vision", ["", "whole ms", "of nothing's", "skipping ms", "of nothing's"], lines)

    lines = []
    for count in (PARTICLES, 1000):
        copies, values = (
            ParticleModels(whole.model),
            nuisances(count)["friction and the peg in the hand"].rows(count),
        )
        begun = time.perf_counter()
        copies.given(values)
        made = time.perf_counter() - begun
        again = timed({"again": lambda copies=copies, values=values: copies.given(values)}, 5)["again"]
        lines.append([f"{count} models", 1e3 * made, 1e3 * again])
        rows += [
            Row(f"{count} models copied and set", 1e3 * made, "ms"),
            Row(f"{count} models set again", 1e3 * again, "ms"),
        ]
    show("models for nuisance parameters", ["", "copied and set ms", "set again ms"], lines)

    if not arguments.quick:
        spent = {}
        for name, physics in (("whole", whole), ("skipping", skipping)):
            scene = model.prepare(recording)
            scene.likelihoods["window"].physics = physics
            before = physics.effort.copy()
            for _ in infer(model, recording, particles=particles, seed=arguments.seed, scene=scene):
                pass
            spent[name] = physics.effort.since(before)
        saved = spent["skipping"].seconds / spent["whole"].seconds
        show(
            "physics of a whole inference over the probe",
            ["", "s", "seconds simulated", "rollouts"],
            [[name, each.seconds, each.amount, each.items] for name, each in spent.items()],
        )
        rows.append(Row("whole inference: with skip / without, time", saved, "", 0.5))
    finish(rows, arguments.json)


if __name__ == "__main__":
    main()
