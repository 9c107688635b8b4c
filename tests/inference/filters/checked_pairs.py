"""Guided SMC in which the backward kernel has to lead back from every move of the forward kernel."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

from bcppl.inference.approximations.gaussian import GaussianApproximation
from bcppl.inference.filters.guided_smc import gaussian_pair, gaussian_proposals, guided, kernel
from bcppl.inference.filters.smc import Step, smc
from bcppl.inference.filters.smcp3 import Pair
from bcppl.traces import Model


def checked_pair(before: Any, after: Any, action: Any) -> Pair:
    """The kernels of a Gaussian approximation, with `check`."""
    return replace(gaussian_pair(before, after, action), check=True)


def run_checked(model: Model, recording: Any, particles: int) -> list[Step]:
    """The steps of a run whose kernels are checked."""
    step = guided(
        partial(GaussianApproximation, model.pose), checked_pair, kernel(model.pose, gaussian_proposals)
    )
    return list(smc(model, recording, step=step, particles=particles, seed=0))
