"""A part is seen by depth cameras whose stated poses are in error, then touched with a held peg.

The default model. A camera's extrinsic error and range bias are latent (`ErringCamera`). A touch is explained
by the measured pose of the peg, which robots repeat to hundredths of a millimetre: while the wrench shows
contact the peg's distance to the part is zero, otherwise positive (`ContactProbe`). What all touches share,
the grasp, the arm and the clock, is integrated out; how large it may be is the bench's `profile`, by default
"ur5e".
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import pyro

from bcppl.distributions.poses import prior_from_guess
from bcppl.geometry.gap import PegGap
from bcppl.geometry.parts import Part
from bcppl.models.shipped import simulated_in
from bcppl.rendering.part_renderer import PartRenderer
from bcppl.rendering.rasterisation import renderer_for
from bcppl.sensors.likelihoods.camera_settings import CameraSettings
from bcppl.sensors.likelihoods.contact_probe import ContactProbe, TouchSettings
from bcppl.sensors.likelihoods.erring_camera import ErringCamera
from bcppl.sensors.measurements import Recording
from bcppl.sensors.scene import Prepare, Scene, chosen, likelihoods_for
from bcppl.traces import Model

CAMERAS = CameraSettings(bins=1, effective_pixels=None, temperature=6.0)


def look_and_touch(scene: Scene, actions: Sequence[Any]) -> None:
    """The program: the part's pose, then each measurement's sites by its sensor."""
    part = pyro.sample("part", scene.prior)
    for number, action in enumerate(actions):
        scene.sensor(action).observe(number, action, part)


def prepare(
    recording: Recording,
    renderer: Callable[[Part], PartRenderer] = renderer_for,
    gap: Callable[[Part, Part], PegGap] = PegGap,
    **settings: Any,
) -> Scene:
    """The scene of a recording.

    Args:
        recording: of depth images and probe windows.
        renderer: makes the renderer of the part; by default the one that is faster for its mesh.
        gap: makes what measures the gap between part and peg.
        settings: fields of `CameraSettings` and `TouchSettings`.

    Raises:
        InputError: a setting is unknown or out of range, a camera cannot see the part near its guess, or
            there are probe windows and no peg.
    """
    cameras, touches = chosen("look_and_touch", settings, CAMERAS, TouchSettings())
    prior = prior_from_guess(recording.guess)
    likelihoods: dict[str, Prepare] = {
        "view": partial(ErringCamera, prior=prior, settings=cameras, renderer=renderer),
        "window": partial(ContactProbe.prepare, settings=touches, gap=gap),
    }
    return Scene(prior, likelihoods_for(recording, likelihoods), "look_and_touch")


model = Model(
    program=look_and_touch,
    prepare=prepare,
    observe=Scene.observed,
    pose="part",
    simulate_recording=simulated_in("bench"),
    inference=("guided_smc", {}),
)
