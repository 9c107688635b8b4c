"""NAME: an inference program with a proposal of your own. Edit it, then run it.

    bcppl run point_probe_10_pushes --inference NAME.py

A proposal is a program that samples new values given a trace. Metropolis-Hastings runs it forward to propose,
and assesses it at the values that it would have to undo: no acceptance ratio is derived by hand.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pyro
import torch

from bcppl import Model, Trace
from bcppl.distributions.poses import NormalPose
from bcppl.inference import Step, smc, tempered
from bcppl.inference.kernels import cycle, metropolis_hastings
from bcppl.inference.proposals import drift


def proposal(pose: str) -> Callable[[Trace], None]:
    """A step of 1 mm and 1 mrad, whatever the particles are: say here what you know of the posterior."""

    def propose(trace: Trace) -> None:
        freedom = trace.distributions[pose].freedom  # the axes that the prior leaves free
        covariance = 1e-6 * torch.eye(freedom.dimension, dtype=torch.float64)
        pyro.sample(pose, NormalPose(trace[pose], covariance, freedom))

    return propose


def infer(model: Model, recording: Any, *, sweeps: int = 8, **settings: Any) -> Iterator[Step]:
    """Beliefs over a recording; `settings` are particles, seed, scene and start, as of `bcppl run`."""
    kernel = cycle(metropolis_hastings(drift(model.pose)), metropolis_hastings(proposal(model.pose)))
    return smc(model, recording, step=tempered(kernel, sweeps=sweeps), **settings)
