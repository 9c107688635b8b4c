"""The default inference program: SMC with tempering and random walks shaped by the particles' own spread.

Each measurement is let in by steps that keep half of the conditional effective sample size; after each
resampling every particle makes several moves, their scale drawn anew between a twentieth of the belief's
width and its whole, so that narrow and wide beliefs are both stirred. Copy this file to write your own:
`bcppl run RECORDING --inference FILE.py` takes any file that defines `infer`.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from bcppl.inference.kernels import Kernel, metropolis_hastings
from bcppl.inference.proposals import drift
from bcppl.inference.resampling import adaptive, systematic
from bcppl.inference.smc import Step, smc, tempered
from bcppl.traces import Model


def kernel(pose: str) -> Kernel:
    """How particles are moved: a random walk on the pose at an address."""
    return metropolis_hastings(drift(pose, (0.1, 1.0)))


def infer(
    model: Model, recording: Any, *, particles: int = 75, seed: int = 0, sweeps: int = 8, scene: Any = None
) -> Iterator[Step]:
    """Beliefs over a recording, one step for each measurement, the prior first.

    Args:
        model: what explains the recording.
        recording: a `bcppl.recordings.Recording`.
        particles: how many.
        seed: same seed, same beliefs.
        sweeps: moves of every particle after each resampling.
        scene: what `model.prepare(recording)` gives, if it is at hand.
    """
    assimilate = tempered(kernel(model.pose), sweeps=sweeps, resample=adaptive(systematic, 0.5), share=0.5)
    return smc(model, recording, assimilate=assimilate, particles=particles, seed=seed, scene=scene)
