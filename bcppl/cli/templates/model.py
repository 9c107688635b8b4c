"""NAME: what is measured, as a program. Edit it, then run it.

bcppl run point_probe_10_pushes --model NAME.py
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pyro

from bcppl import Model, Recording
from bcppl.distributions.poses import prior_from_guess
from bcppl.models import point_probe
from bcppl.sensors.scene import Scene


def program(scene: Scene, actions: Sequence[Any]) -> None:
    """The program: it is given what the robot did, never what it measured.

    All particles run at once: a sampled value has shape (N, ...).
    """
    part = pyro.sample("part", scene.prior)  # (N, 7) world_from_part
    # A further latent value is one line, and whatever depends on it may take it as an argument:
    # friction = pyro.sample("friction", dist.Uniform(0.1, 0.6))
    for number, action in enumerate(actions):
        scene.sensor(action).observe(number, action, part)  # samples touch_0, touch_1, ...


def prepare(recording: Recording, spread: float = 0.0004) -> Scene:
    """What stays the same over a run; further arguments are settings: --set spread=0.001 (m)."""
    scene = point_probe.prepare(recording, spread=spread)  # the likelihoods of the model to begin from
    return Scene(prior_from_guess(recording.guess), scene.likelihoods, "NAME")


model = Model(
    program=program,
    prepare=prepare,
    observe=Scene.observed,  # the observed values by address
    pose="part",  # the address of the sought pose
    inference=("tempered_smc", {}),  # or guided_smc, or a file of your own by --inference
)
