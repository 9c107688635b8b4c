"""Guided SMC in which the backward kernel has to lead back from every move of the forward kernel."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

from bcppl.inference.approximations.gaussian import GaussianApproximation
from bcppl.inference.filters.guided_smc import GaussianPrograms, guided, kernel
from bcppl.inference.filters.smc import Step, smc
from bcppl.inference.filters.smcp3 import Pair
from bcppl.traces import Model


class CheckedPrograms(GaussianPrograms):
    """The proposals of a Gaussian approximation, with `check`."""

    def pair(self, before: Any, after: Any, action: Any) -> Pair:
        return replace(super().pair(before, after, action), check=True)


def run_checked(model: Model, recording: Any, particles: int) -> list[Step]:
    """The steps of a run whose kernels are checked."""
    programs = CheckedPrograms()
    step = guided(
        partial(GaussianApproximation, model.pose), programs, kernel(model.pose, programs.proposals)
    )
    return list(smc(model, recording, step=step, particles=particles, seed=0))
