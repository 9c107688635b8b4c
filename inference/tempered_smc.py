"""The default inference program: SMC with tempering and random walks shaped by the particles' own spread.

Each measurement is let in by steps that keep half of the conditional effective sample size; after each
resampling every particle makes several moves, fewer of them where each one costs a simulation. Copy this file
to write your own: `bcppl run RECORDING --inference FILE.py` takes any file that defines `infer`.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from bcppl.inference.kernels import Kernel, metropolis_hastings
from bcppl.inference.proposals import drift
from bcppl.inference.resampling import adaptive, systematic
from bcppl.inference.smc import Step, smc, tempered
from bcppl.traces import Model, Trace


def kernel(pose: str) -> Kernel:
    """How particles are moved: a random walk on the pose at an address."""
    return metropolis_hastings(drift(pose, (0.2, 1.2)))


def infer(
    model: Model,
    recording: Any,
    *,
    particles: int = 75,
    seed: int = 0,
    sweeps: int = 8,
    physics_sweeps: int = 3,
    scene: Any = None,
) -> Iterator[Step]:
    """Beliefs over a recording, one step for each measurement, the prior first.

    Args:
        model: what explains the recording.
        recording: a `bcppl.recordings.Recording`.
        particles: how many.
        seed: same seed, same beliefs.
        sweeps: moves of every particle after each resampling.
        physics_sweeps: the same once physics has to be simulated for every move.
        scene: what `model.prepare(recording)` gives, if it is at hand.
    """

    def affordable(trace: Trace) -> int:
        costs = [getattr(trace.distributions[address], "cost", 0) for address in trace.observations]
        return physics_sweeps if max(costs, default=0) >= 2 else sweeps

    assimilate = tempered(
        kernel(model.pose), sweeps=affordable, resample=adaptive(systematic, 0.5), share=0.5
    )
    return smc(model, recording, assimilate=assimilate, particles=particles, seed=seed, scene=scene)
