"""Simulation-based calibration: poses drawn from the prior, what is measured there, and inference's answer.

Where the truth is a draw from the prior and the data are drawn at it, the truth and draws from the posterior
are exchangeable, so the truth's rank among L of them is uniform on 0 to L: Talts et al., Validating Bayesian
inference algorithms with simulation-based calibration, 2018, theorem 1. It holds for every quantity of pose
and data; the log-likelihood is one that finds errors which no coordinate shows (Modrak et al.,
Simulation-based calibration checking for Bayesian computation: the choice of test quantities shapes
sensitivity, 2023).
"""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from bcppl import poses
from bcppl.inference.calibration.ranks import ranks
from bcppl.inference.calibration.rounds import gathered
from bcppl.inference.filters.step import Observed
from bcppl.inference.filters.tempering import tempered
from bcppl.inference.kernels import Kernel, moved_by
from bcppl.inference.population import Population
from bcppl.inference.resampling import adaptive, systematic
from bcppl.inference.targets import POSTERIOR
from bcppl.poses import Freedom
from bcppl.traces import extend, generate, simulate

AXES = ("x", "y", "z", "turn x", "turn y", "turn z")
DRAWS = 49  # L: of N particles, so that those that are taken are nearly independent


@dataclass(frozen=True)
class Case:
    """A model that can be sampled, and how it is inferred.

    Attributes:
        program: `program(count)` draws "pose", and "seen" where count is 1. Data are drawn from it.
        center: (7,) where the coordinates are taken, which must not depend on particles or data.
        freedom: the free axes of the pose.
        kernel: moves the particles.
        believed: the program that inference runs; the same as `program` in all but mutants.
        sweeps, share, particles: as in `tempered`.
        settling: moves of every particle at the end, until it is far from the one that it was copied from.
        patched: what is in force while inference runs; nothing in all but mutants.
    """

    program: Callable[[int], Any]
    center: Tensor
    freedom: Freedom
    kernel: Kernel | None
    believed: Callable[[int], Any]
    sweeps: int = 10
    share: float = 0.7
    particles: int = 100
    settling: int = 0
    patched: Callable[[], AbstractContextManager[Any]] = nullcontext

    @property
    def quantities(self) -> list[str]:
        """What is ranked."""
        turning = ["angle"] if self.freedom.rotation == "all" else []
        return [AXES[k] for k in self.freedom.axes] + turning + ["log-likelihood"]

    def measure(self, pose: Tensor, seen: Tensor) -> Tensor:
        """The quantities (N, Q) at poses (N, 7), given the data."""
        tangent = poses.local(self.center, pose)
        columns = [self.freedom.coordinates(tangent)]
        if self.freedom.rotation == "all":
            columns.append(tangent[:, 3:].norm(dim=-1, keepdim=True))
        trace, _ = generate(self.program, (0,), {}, len(pose))
        _, log_likelihood = extend(trace.at({"pose": pose}), (1,), {"seen": seen})
        return torch.cat([*columns, log_likelihood[:, None]], dim=1)

    def infer(self, seen: Tensor) -> Population:
        """Particles given the data."""
        resample = adaptive(systematic, self.share)
        step = tempered(self.kernel, sweeps=self.sweeps, resample=resample, share=self.share)
        trace, log_weights = generate(self.believed, (0,), {}, self.particles)
        population = step(Population(trace, log_weights), Observed((1,), {"seen": seen})).population
        if self.kernel is None or self.settling == 0:
            return population
        return moved_by(population, self.kernel, POSTERIOR, self.settling).population

    def simulate_once(self) -> tuple[Tensor, Tensor]:
        """A pose (7,) from the prior, and data drawn there."""
        world = simulate(self.program, (1,), 1)
        return world["pose"][0], world["seen"][0]


class Drawn(NamedTuple):
    """Of one truth: its ranks (Q,), and how many particles of the population were distinct."""

    ranks: Tensor
    distinct: int


def draw(case: Case, seed: int) -> Drawn:
    """One round: draw, infer, rank."""
    torch.manual_seed(seed)
    truth, seen = case.simulate_once()
    with case.patched():
        population = case.infer(seen)
    chosen = systematic(population.log_weights)[torch.randperm(len(population))[:DRAWS]]
    pose = torch.cat([truth[None], population.trace["pose"][chosen]])
    measured = case.measure(pose, seen)
    return Drawn(ranks(measured[0], measured[1:]), population.belief("pose").distinct)


Job = Callable[[int], Any]


def gather(job: Job, rounds: int, seed: int, processes: int = 1) -> list[Any]:
    """`job(seed + k)` for k below `rounds`; with several processes the job must be picklable."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    done = dict(gathered(job, range(seed, seed + rounds), processes, progress=False))
    return [done[number] for number in range(rounds)]
