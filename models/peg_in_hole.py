"""BayesContact's program: a hole is seen by depth cameras, then touched with a peg on a compliant arm.

The part's pose is drawn from the prior. Images are explained as by `look_and_touch` (`ErringCamera`), the
windows of a probe by contact physics (`ScreenedProbe`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import pyro

from bcppl.distributions.poses import prior_from_guess
from bcppl.geometry.parts import Part
from bcppl.models.look_and_touch import CAMERAS
from bcppl.models.shipped import simulated_in
from bcppl.rendering.part_renderer import PartRenderer
from bcppl.rendering.rasterisation import renderer_for
from bcppl.sensors.likelihoods.erring_camera import ErringCamera
from bcppl.sensors.likelihoods.screened_probe import TOUCHES, simulated_probe
from bcppl.sensors.likelihoods.simulated_probe import ProbeSettings
from bcppl.sensors.measurements import Recording
from bcppl.sensors.scene import Prepare, Scene, chosen, likelihoods_for
from bcppl.traces import Model


def peg_in_hole(scene: Scene, actions: Sequence[Any]) -> None:
    """The program: the part's pose, then each measurement's sites by its sensor."""
    hole = pyro.sample("hole", scene.prior)
    for number, action in enumerate(actions):
        scene.sensor(action).observe(number, action, hole)


def prepare(
    recording: Recording, renderer: Callable[[Part], PartRenderer] = renderer_for, **settings: Any
) -> Scene:
    """The scene of a recording.

    Args:
        recording: of depth images and probe windows.
        renderer: makes the renderer of the part; by default the one that is faster for its mesh.
        settings: fields of `CameraSettings`, `ProbeSettings` and `TouchSettings`.

    Raises:
        InputError: a setting is unknown or out of range, a camera cannot see the part near its guess, there
            are probe windows and no peg, or the part cannot be touched.
    """
    cameras, probe, touches = chosen("peg_in_hole", settings, CAMERAS, ProbeSettings(), TOUCHES)
    prior = prior_from_guess(recording.guess)
    likelihoods: dict[str, Prepare] = {
        "view": partial(ErringCamera, prior=prior, settings=cameras, renderer=renderer),
        "window": partial(simulated_probe, settings=probe, touches=touches),
    }
    return Scene(prior, likelihoods_for(recording, likelihoods), "peg_in_hole")


model = Model(
    program=peg_in_hole,
    prepare=prepare,
    observe=Scene.observed,
    pose="hole",
    simulate_recording=simulated_in("peg_in_hole"),
    inference=("guided_smc", {}),
)
