"""What the wrench itself adds to contact locations on the simulated 6 s probe: runs with and without it."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import pyro
import torch
from jobs import each
from report import Row, finish, options, show
from torch import Tensor

from bcppl import poses
from bcppl.contact.peg_model import ContactParameters
from bcppl.contact.touch import Touch
from bcppl.contact.track import ContactTrack
from bcppl.distributions.contact import ChamferContacts, PegPose, Wrench
from bcppl.distributions.depth import RobustDepth
from bcppl.inference.filters.tempered_smc import infer
from bcppl.models import peg_in_hole
from bcppl.models.worlds.peg_in_hole import record
from bcppl.robot.motion import ProbeWindow
from bcppl.sensors import Measurement, View
from bcppl.traces import Model, carried

PARTICLES = 75
# What inference believes of the contact when it is told what the world's is; the shipped model is not.
TOLD = ContactParameters(time_step=0.0015, friction=0.2, time_constant=0.003)


@dataclass(frozen=True)
class Feeling:
    """The shipped program with a choice of what is made of a window.

    Attributes:
        contacts: whether contact locations count, by Chamfer.
        scales: of the wrench's force (N) and torque (N m), and the share of both; None where it is not used.
        contact: what inference believes of the contact.
    """

    contacts: bool = True
    scales: tuple[float, float, float] | None = None
    contact: ContactParameters = peg_in_hole.CONTACT

    def __call__(self, scene: Any, actions: Sequence[View | ProbeWindow]) -> None:
        """The program."""
        settings = scene.settings
        hole = pyro.sample("hole", scene.prior)
        for k, action in enumerate(actions):
            if isinstance(action, View):
                depth = RobustDepth(
                    scene.renderer,
                    action.camera,
                    hole,
                    scale=settings.depth_scale,
                    outlier=settings.outlier,
                    background=scene.background.get(action.camera.name),
                    effective_pixels=settings.effective_pixels,
                )
                pyro.sample(f"depth_{k}", depth)
                continue
            begin = partial(ContactTrack.start, scene.physics, scene.sensing, hole, action.probe)
            window = (carried(f"probe {action.probe.name}", begin), action.first, action.last)
            if self.contacts:
                felt = ChamferContacts(*window, settings.contact_scale, settings.one_empty)
                pyro.sample(f"contacts_{k}", felt)
            scales = settings.translation_scale, settings.rotation_scale
            pyro.sample(f"peg_{k}", PegPose(*window, *scales, every=settings.pose_every))
            if self.scales is not None:
                pyro.sample(f"wrench_{k}", Wrench(*window, *self.scales, every=settings.pose_every))

    def observe(self, scene: Any, measurements: Sequence[Measurement]) -> Mapping[str, Tensor]:
        """What the shipped model observes, and the tared wrench."""
        values = dict(peg_in_hole.observe(scene, measurements))
        touches = [(k, m.observation) for k, m in enumerate(measurements) if isinstance(m.observation, Touch)]
        if touches and self.scales is not None:
            tared = scene.sensing.tared([touch for _, touch in touches])
            values |= {f"wrench_{k}": wrench for (k, _), wrench in zip(touches, tared, strict=True)}
        return {a: v for a, v in values.items() if self.contacts or not a.startswith("contacts_")}


TIGHT, LOOSE = (0.3, 0.02, 0.15), (4.0, 0.2, 0.3)
VARIANTS = {
    "contacts and pose": Feeling(),
    "and wrench": Feeling(scales=TIGHT),
    "and wrench, loose": Feeling(scales=LOOSE),
    "wrench and pose, loose": Feeling(contacts=False, scales=LOOSE),
    "contacts and pose, contact told": Feeling(contact=TOLD),
    "and wrench, contact told": Feeling(scales=TIGHT, contact=TOLD),
}


def run(task: tuple[str, int]) -> tuple[float, ...]:
    """Finds the hole of a seed with what a variant makes of the touches."""
    name, seed = task
    program = VARIANTS[name]
    prepare = partial(peg_in_hole.prepare, contact=program.contact)
    model = Model(program=program, prepare=prepare, observe=program.observe, pose="hole")
    recording = record(seed)
    begun = time.perf_counter()
    *_, last = infer(model, recording, particles=PARTICLES, seed=seed)
    wall = time.perf_counter() - begun
    belief = last.belief
    error = poses.local(belief.mean, torch.from_numpy(recording.truth))
    covariance = belief.covariance + 1e-12 * torch.eye(6, dtype=torch.float64)
    spread = covariance.diagonal()
    return (
        1e3 * belief.weighted_add(recording.part.surface_points(), recording.truth),
        1e3 * float(error[:3].norm()),
        float(torch.rad2deg(error[3:].norm())),
        1e3 * float(spread[:3].sum().sqrt()),
        float(torch.rad2deg(spread[3:].sum().sqrt())),
        float((error @ torch.linalg.solve(covariance, error)).sqrt()) / 6**0.5,
        last.info.truth_gap,
        last.info.effective_sample_size,
        wall,
    )


COLUMNS = (
    "ADD mm",
    "error mm",
    "error deg",
    "spread mm",
    "spread deg",
    "error/spread",
    "truth gap",
    "ESS",
    "wall s",
)


def main() -> None:
    parser = options(__doc__ or "")
    parser.add_argument(
        "--jobs", type=int, default=1, help="runs at a time; with more than one, times mean nothing"
    )
    parser.add_argument("--runs", type=int, default=5, help="seeds of each variant")
    parser.add_argument("--variants", nargs="*", choices=list(VARIANTS), default=list(VARIANTS))
    arguments = parser.parse_args()
    seeds = range(arguments.seed, arguments.seed + (1 if arguments.quick else arguments.runs))
    tasks = [(name, seed) for seed in seeds for name in arguments.variants]
    found = dict(zip(tasks, each(run, tasks, arguments.jobs), strict=True))
    lines, rows = [], []
    for name in arguments.variants:
        lines += [[f"{name}, seed {seed}", *found[name, seed]] for seed in seeds]
        median = np.median([found[name, seed] for seed in seeds], axis=0)
        lines.append([f"{name}, median", *[float(value) for value in median]])
        for column, value in zip(COLUMNS, median, strict=True):
            *what, unit = column.rpartition(" ") if " " in column else (column, "", "")
            rows.append(Row(f"{name}: {''.join(what).strip()}, median", float(value), unit))
    show(f"simulated probe, {PARTICLES} particles, what is made of the touches", ["", *COLUMNS], lines)
    finish(rows, arguments.json)


if __name__ == "__main__":
    main()
