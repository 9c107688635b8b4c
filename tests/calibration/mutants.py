"""Cases by name, and what breaks them: each mutant must fail the test that its case passes, with its draws.

A mutant changes inference alone. The data are drawn before it comes into force, so they are the same. The
smallest p-value times the number of quantities, each p at least 2e-5:

    case, and how it is broken                           rounds    p       where it shows
    depth, six axes: sound                                  300    1
    depth, planar: sound                                    300    1
    depth, upright: sound                                   300    0.06
    touch: sound                                            300    0.04    turn y (see below)
    depth, aligned: sound                                    60    0.09
    depth, planar: sign flipped                              30    0.0001  log-likelihood
    touch: sign flipped                                      16    0.0001  log-likelihood
    depth, six axes: Jacobian of rotations dropped          300    0.002   angle, turn x
    depth, upright: noise 1.5 times as wide                 150    0.0001  log-likelihood
    depth, aligned: reverse move left out                    16    0.0001  x, log-likelihood
    depth, planar: reverse move left out                     20    0.0001  log-likelihood
    depth, planar: fitted on the particle it moves          100    0.0001  log-likelihood
    depth, planar: never moved                               20    0.0001  all

The touch's 300 truths lie unevenly in turn y by themselves: ranked in the prior, without data, p is 0.03.
The Jacobian of rotations is 0.4 to 1 over all of them: even with no data, dropping it moves the angle's mean
rank by no more than 0.07, four standard errors of 300 rounds. What these rounds do not find: a kernel density
fitted to 50 particles of which the moved one is one (40 rounds, p 0.2), whose bias falls as 1/N; and, in the
touch, a noise 1.5 times as wide (300 rounds, p 0.02), for there most is learned from when contact is felt.
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
    "depth, upright": depth.upright,
    "depth, aligned": depth.aligned,
    "depth, quick": depth.quick,
    "touch": touch.touched,
}
NOISE = {"depth, six axes": 0.04, "depth, planar": 0.015, "depth, upright": 0.015, "touch": 0.001}


def flipped(kernel: Kernel) -> Kernel:
    """A kernel of a target in which the likelihood has the wrong sign."""

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


def reverse_move_left_out(name: str) -> Case:
    """The density of the reverse move is left out."""

    def nothing(program: object, args: object, choices: object, particles: int) -> Tensor:
        return torch.zeros(particles, dtype=torch.float64)

    return replace(CASES[name](), patched=partial(patch, "bcppl.inference.kernels.hastings.assess", nothing))


def taught_by_itself(name: str) -> Case:
    """Steps as long as the moved particle is far from the centre, and as long in the reverse move."""
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
    "reverse move left out": reverse_move_left_out,
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
    truth, seen = case.simulate_once()
    belief = case.infer(seen).belief("pose")
    inside = [bool(belief.credible_region(mass).contains(truth)) for mass in (0.5, 0.9)]
    return inside[0], inside[1]
