"""BayesContact's own filter, as a baseline: a random walk before each measurement, and importance weights.

    from itertools import islice

    from bcppl.inference import bayes_contact
    from bcppl.models import load_recording
    from bcppl.models.point_probe import model

    recording = load_recording("point_probe_10_pushes")
    for belief, info in islice(bayes_contact.infer(model, recording, particles=50), 3):
        print(info.label, info.effective_sample_size)

The paper weights a moved particle by w p(o | q) p(q) / pi, which is right for the first measurement only:
the pose does not move, so the measurements before belong in the weight too. The weight used here is that of
the SMC sampler with the drift as its forward and its backward kernel (Del Moral, Doucet and Jasra, JRSS B 68,
2006, eq. 12), p(q') p(o_1..o_t | q') / (p(q) p(o_1..o_{t-1} | q)) times backward over forward. There is no
tempering and no accept-reject step.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from bcppl.inference.filters.smc import Step, smc
from bcppl.inference.filters.smcp3 import Pair, smcp3
from bcppl.inference.proposals import drift
from bcppl.traces import Model


def infer(
    model: Model,
    recording: Any,
    *,
    particles: int = 75,
    seed: int = 0,
    scale: float = 0.2,
    scene: Any = None,
    start: Step | None = None,
) -> Iterator[Step]:
    """Beliefs over a recording: first the prior's, then one step for each measurement.

    Args:
        model: what explains the recording.
        recording: a `bcppl.recordings.Recording`.
        particles: how many; the paper uses 75.
        seed: same seed, same beliefs.
        scale: the drift, as a share of 2.38 / sqrt(d) times the particles' spread.
        scene: `model.prepare(recording)` unless given.
        start: a step to resume from, as for `bcppl.inference.smc`.
    """
    walk = drift(model.pose, (scale, scale * 1.0001))
    step = smcp3(Pair(walk, walk))
    return smc(model, recording, step=step, particles=particles, seed=seed, scene=scene, start=start)
