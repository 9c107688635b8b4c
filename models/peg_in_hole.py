"""BayesContact's program: a hole is seen by depth cameras, then felt with a peg on a compliant arm.

The pose of the part is drawn from the prior. The first measurements are depth images; the others are windows
of a probing trajectory, each simulated against the part at that pose: where contact was felt (a Chamfer
surrogate, in the peg's frame) and where the peg was (a density). A window in which nothing was felt says that
nothing was in the way.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
import pyro
import torch
from torch import Tensor

from bcppl.arguments import number_within, whole_number
from bcppl.contact.peg_model import ContactParameters
from bcppl.contact.physics import PegPhysics
from bcppl.contact.touch import Touch
from bcppl.contact.track import ContactTrack
from bcppl.contact.wrench import Sensing
from bcppl.distributions.contact import ChamferContacts, PegPose
from bcppl.distributions.depth import RobustDepth
from bcppl.distributions.poses import prior_from_guess
from bcppl.effort import Effort
from bcppl.errors import InputError
from bcppl.geometry.parts import Part
from bcppl.rendering.renderer import DepthRenderer
from bcppl.rendering.scene import RendersPart
from bcppl.robot.motion import ProbeWindow
from bcppl.sensors import DepthImage, Measurement, Recording, View
from bcppl.traces import Model, carried

# What inference believes of the contact. The worlds that make recordings have parameters of their own.
CONTACT = ContactParameters(time_step=0.004, friction=0.3, time_constant=0.008)


@dataclass(frozen=True)
class Settings:
    """What is known of the sensors.

    Attributes:
        depth_scale: of the depth's Laplace noise, metres.
        outlier: the probability that a pixel shows something else than what is rendered.
        effective_pixels: how many independent pixels a view is worth; a camera that is off by millimetres
            shifts them all together.
        contact_scale: sigma of the Chamfer surrogate, metres.
        one_empty: its cost where only one of the two felt a contact, square metres.
        translation_scale, rotation_scale: of the peg's pose, metres and radians: what the physics does not
            know of friction and stiffness, more than the sensor's noise.
        pose_every: every so many stamps the peg's pose counts.
        contact: what inference believes of the contact.
    """

    depth_scale: float = 0.003
    outlier: float = 0.1
    effective_pixels: float = 50.0
    contact_scale: float = 0.003
    one_empty: float = 2.0 * 0.005**2
    translation_scale: float = 0.0007
    rotation_scale: float = 0.005
    pose_every: int = 25
    contact: ContactParameters = CONTACT

    def __post_init__(self) -> None:
        for name in ("depth_scale", "contact_scale", "translation_scale", "rotation_scale"):
            number_within(
                f"a site's spread must be positive and {name} is {{}}", getattr(self, name), above=0.0
            )
        number_within("peg_in_hole is given one_empty {}", self.one_empty, least=0.0)
        whole_number("peg_in_hole is given pose_every {}", self.pose_every)


@dataclass(frozen=True, eq=False)
class Scene:
    """What stays the same over a run: the prior, the renderer, the physics, and how wrenches are read."""

    prior: Any
    renderer: RendersPart
    physics: PegPhysics | None
    sensing: Sensing | None
    background: Mapping[str, npt.NDArray[np.float64]]
    settings: Settings

    @property
    def efforts(self) -> Mapping[str, Effort]:
        """What each simulator has done so far."""
        efforts = {"rendering": self.renderer.effort}
        return efforts if self.physics is None else {**efforts, "physics": self.physics.effort}


def peg_in_hole(scene: Scene, actions: Sequence[View | ProbeWindow]) -> None:
    """The program: the part's pose, a depth image for every view, contacts and peg poses for every window."""
    settings = scene.settings
    hole = pyro.sample("hole", scene.prior)
    for k, action in enumerate(actions):
        if isinstance(action, View):
            depth = RobustDepth(
                scene.renderer,
                action.camera,
                hole,
                scale=settings.depth_scale,
                outlier=settings.outlier,
                background=scene.background.get(action.camera.name),
                effective_pixels=settings.effective_pixels,
            )
            pyro.sample(f"depth_{k}", depth)
        else:
            assert scene.physics is not None and scene.sensing is not None
            begin = partial(ContactTrack.start, scene.physics, scene.sensing, hole, action.probe)
            track = carried(f"probe {action.probe.name}", hole, begin)
            window = (track, action.first, action.last)
            pyro.sample(f"contacts_{k}", ChamferContacts(*window, settings.contact_scale, settings.one_empty))
            peg = PegPose(
                *window, settings.translation_scale, settings.rotation_scale, every=settings.pose_every
            )
            pyro.sample(f"peg_{k}", peg)


def prepare(
    recording: Recording, renderer: Callable[[Part], RendersPart] = DepthRenderer, **settings: Any
) -> Scene:
    """The scene of a recording.

    Args:
        recording: what was measured.
        renderer: makes the renderer of the part, such as `bcppl.rendering.choice.renderer_for`.
        settings: fields of `Settings`.

    Raises:
        InputError: a spread is not positive, there are probe windows and no peg, or the part cannot be
            touched.
    """
    chosen = Settings(**settings)
    windows = [m.action for m in recording.measurements if isinstance(m.action, ProbeWindow)]
    physics = sensing = None
    if windows:
        if recording.peg is None:
            raise InputError("the recording has probe windows but no peg; add the peg that was held.")
        physics = PegPhysics(recording.part, recording.peg, chosen.contact)
        sensing = Sensing(recording.peg, rate=1.0 / float(np.median(np.diff(windows[0].probe.stamps))))
    return Scene(
        prior_from_guess(recording.guess),
        renderer(recording.part),
        physics,
        sensing,
        recording.background,
        chosen,
    )


def observe(scene: Scene, measurements: Sequence[Measurement]) -> Mapping[str, Tensor]:
    """Depth images, and what is read from the wrench by the code that reads the simulated one.

    Raises:
        InputError: a measurement is neither a view nor a probe window.
    """
    values: dict[str, Tensor] = {}
    touches: dict[str, list[tuple[int, Touch]]] = {}
    for k, measurement in enumerate(measurements):
        action, seen = measurement.action, measurement.observation
        if isinstance(action, View) and isinstance(seen, DepthImage):
            values[f"depth_{k}"] = torch.from_numpy(seen.depth)
        elif isinstance(action, ProbeWindow) and isinstance(seen, Touch):
            touches.setdefault(action.probe.name, []).append((k, seen))
        else:
            raise InputError(
                f"measurement {k} is a {measurement.kind}, which peg_in_hole does not explain; "
                "choose another model."
            )
    for windows in touches.values():
        assert scene.sensing is not None
        read = scene.sensing.measure([touch for _, touch in windows])
        for (k, _), (contacts, peg) in zip(windows, read, strict=True):
            values[f"contacts_{k}"], values[f"peg_{k}"] = contacts, peg
    return values


def invent(seed: int, **options: Any) -> Recording:
    """A block with a hole, seen and probed in a finer simulation: see `bcppl.models.worlds.peg_in_hole`."""
    from bcppl.models.worlds.peg_in_hole import record

    return record(seed, **options)


model = Model(program=peg_in_hole, prepare=prepare, observe=observe, pose="hole", invent=invent)
