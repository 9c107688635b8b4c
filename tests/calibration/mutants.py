"""Cases by name, and what breaks them: each mutant must fail the test that its case passes, with its draws.

A mutant changes inference alone. The data are drawn before it comes into force, so they are the same.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from unittest.mock import patch

import pyro
import torch
from torch import Tensor

from bcppl import poses
from bcppl.distributions.poses import NormalPose
from bcppl.inference.kernels import Kernel, Move, metropolis_hastings
from bcppl.inference.population import Population
from bcppl.inference.targets import Target
from bcppl.poses import Freedom
from bcppl.traces import Trace
from tests.calibration import depth, touch
from tests.calibration.case import Case, Drawn, draw

CASES: dict[str, Callable[..., Case]] = {
    "depth, six axes": depth.six_axes,
    "depth, planar": depth.planar,
    "depth, aligned": depth.aligned,
    "depth, quick": depth.quick,
    "touch": touch.touched,
}
NOISE = {"depth, six axes": 0.04, "depth, planar": 0.015, "touch": 0.001}


def flipped(kernel: Kernel) -> Kernel:
    """A kernel that is told that what explains the data badly explains it well."""

    def fitted(population: Population) -> Move:
        move = kernel(population)

        def moved(trace: Trace, target: Target) -> tuple[Trace, Tensor]:
            latent = list(trace.choices)
            return move(trace, lambda t: 2.0 * t.log_prob(*latent) - target(t))

        return moved

    return fitted


def sign_flipped(name: str) -> Case:
    """The likelihood's sign in the target of the moves."""
    case = CASES[name]()
    assert case.kernel is not None
    return replace(case, kernel=flipped(case.kernel))


def jacobian_dropped(name: str) -> Case:
    """Densities of rotations with respect to Lebesgue measure of rotation vectors."""
    none = partial(patch.object, Freedom, "log_base_density", lambda self, angle: torch.zeros_like(angle))
    return replace(CASES[name](), patched=none)


def noise_wrong(name: str) -> Case:
    """Inference believes that the noise is 1.5 times as wide as it is."""
    return CASES[name](believed=1.5 * NOISE[name])


def way_back_forgotten(name: str) -> Case:
    """Proposals are weighed by the way there alone."""

    def nothing(program: object, args: object, choices: object, particles: int) -> Tensor:
        return torch.zeros(particles, dtype=torch.float64)

    return replace(CASES[name](), patched=partial(patch, "bcppl.inference.kernels.hastings.assess", nothing))


def taught_by_itself(name: str) -> Case:
    """Steps as long as the moved particle is far from the centre, and as long on the way back."""
    case = CASES[name]()

    def fitted(population: Population) -> Move:
        def move(trace: Trace, target: Target) -> tuple[Trace, Tensor]:
            own = case.freedom.coordinates(poses.local(case.center, trace["pose"]))
            covariance = torch.diag_embed((0.7 * own.abs() + 0.05 * own.std(dim=0)) ** 2)

            def walk(at: Trace) -> None:
                pyro.sample("pose", NormalPose(at["pose"], covariance, case.freedom))

            return metropolis_hastings(walk)(population)(trace, target)

        return move

    return replace(case, kernel=fitted)


def never_moved(name: str) -> Case:
    """Not a mutant but poor sampling: particles are resampled and stay copies of one another."""
    return replace(CASES[name](), kernel=None)


MUTANTS: dict[str, Callable[[str], Case]] = {
    "sign flipped": sign_flipped,
    "Jacobian of rotations dropped": jacobian_dropped,
    "noise 1.5 times as wide": noise_wrong,
    "way back forgotten": way_back_forgotten,
    "fitted on the particle it moves": taught_by_itself,
    "never moved": never_moved,
}


def case_of(name: str, mutant: str | None = None) -> Case:
    """A case by name, broken or whole."""
    return CASES[name]() if mutant is None else MUTANTS[mutant](name)


def rank(name: str, mutant: str | None, seed: int) -> Drawn:
    """One round of a case by name."""
    return draw(case_of(name, mutant), seed)


def covered(seed: int) -> tuple[bool, bool]:
    """Whether regions of mass 0.5 and 0.9 by the Chamfer surrogate hold the truth, in one round."""
    torch.manual_seed(seed)
    case = touch.surrogate()
    truth, seen = case.invent()
    belief = case.infer(seen).belief("pose")
    inside = [bool(belief.credible_region(mass).contains(truth)) for mass in (0.5, 0.9)]
    return inside[0], inside[1]
