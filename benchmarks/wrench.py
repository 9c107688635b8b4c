"""Accuracy on the simulated 6 s probe, with and without a likelihood of the wrench beside contacts."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pyro
import torch
from jobs import each
from report import Row, finish, options, show
from torch import Tensor

from bcppl import poses
from bcppl.contact.mujoco_model import ContactParameters
from bcppl.distributions.contact import ChamferContacts, PegPose, Wrench
from bcppl.inference.filters.tempered_smc import infer
from bcppl.models import peg_in_hole
from bcppl.models.worlds.peg_in_hole import simulate_recording
from bcppl.robot.motion import ProbeWindow
from bcppl.sensors import Recording
from bcppl.sensors.likelihoods.simulated_probe import CONTACT, ProbeSettings, SimulatedProbe
from bcppl.sensors.scene import Numbered, Scene

PARTICLES = 75
WORLD = ContactParameters(time_step=0.0015, friction=0.2, time_constant=0.003)  # the world's own friction


@dataclass(frozen=True)
class Variant:
    """Which sites a window has.

    Attributes:
        contacts: whether it has `contacts_*`, by Chamfer.
        scales: of the wrench's force (N) and torque (N m), and the share of both; None for no `wrench_*`.
        contact: parameters of the physics.
    """

    contacts: bool = True
    scales: tuple[float, float, float] | None = None
    contact: ContactParameters = CONTACT

    def prepare(self, recording: Recording) -> Scene:
        """The scene of `peg_in_hole` with another likelihood of windows."""
        scene = peg_in_hole.prepare(recording, contact=self.contact)
        probe = WrenchProbe(recording, scene.likelihoods["window"].settings, self)
        return replace(scene, likelihoods={**scene.likelihoods, "window": probe})


class WrenchProbe(SimulatedProbe):
    """Windows of a simulated probe with the sites of a variant."""

    def __init__(self, recording: Recording, settings: ProbeSettings, variant: Variant) -> None:
        super().__init__(recording, settings)
        self.variant = variant

    def observe(self, number: int, action: ProbeWindow, world_from_part: Tensor) -> None:
        """Sample the variant's sites."""
        settings, variant = self.settings, self.variant
        window = (self.rollout(action, world_from_part), action.first, action.last)
        if variant.contacts:
            contacts = ChamferContacts(*window, settings.contact_scale, settings.one_empty)
            pyro.sample(f"contacts_{number}", contacts)
        scales = settings.translation_scale, settings.rotation_scale
        pyro.sample(f"peg_{number}", PegPose(*window, *scales, every=settings.pose_every))
        if variant.scales is not None:
            pyro.sample(f"wrench_{number}", Wrench(*window, *variant.scales, every=settings.pose_every))

    def observed(self, measurements: Sequence[Numbered]) -> Mapping[str, Tensor]:
        """Contact locations, peg poses and tared wrenches, by address, as far as the variant has them."""
        values = dict(super().observed(measurements))
        if self.variant.scales is not None:
            tared = self.sensing.tared([measurement.observation for _, measurement in measurements])
            values |= {f"wrench_{n}": wrench for (n, _), wrench in zip(measurements, tared, strict=True)}
        return {a: v for a, v in values.items() if self.variant.contacts or not a.startswith("contacts_")}


TIGHT, LOOSE = (0.3, 0.02, 0.15), (4.0, 0.2, 0.3)
VARIANTS = {
    "contacts and pose": Variant(),
    "and wrench": Variant(scales=TIGHT),
    "and wrench, loose": Variant(scales=LOOSE),
    "wrench and pose, loose": Variant(contacts=False, scales=LOOSE),
    "contacts and pose, the world's friction": Variant(contact=WORLD),
    "and wrench, the world's friction": Variant(scales=TIGHT, contact=WORLD),
}


def run(task: tuple[str, int]) -> tuple[float, ...]:
    """The error and the spread of a variant's belief over the hole of a seed, and its cost."""
    name, seed = task
    model = replace(peg_in_hole.model, prepare=VARIANTS[name].prepare)
    recording = simulate_recording(seed)
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
    show(f"simulated probe, {PARTICLES} particles", ["", *COLUMNS], lines)
    finish(rows, arguments.json)


if __name__ == "__main__":
    main()
