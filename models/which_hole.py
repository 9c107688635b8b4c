"""Which hole is it? A plate has several holes that look alike, and a camera sees one of them from near by.

`hole` is the pose of the hole that is seen, `which` says which of the plate's it is. Where the others and the
plate's edges are hangs on both. The camera tells where the hole is and not which; touching where a neighbour
would be tells which. A recording's part has its frame in the first of the holes, so `hole` is the part's pose
where that is the one that is seen, and the pose that an insertion needs whichever it is.

A discrete site needs nothing else: here the choice moves one plate about, so one renderer and one physics do
for all. Where the choice is among parts of different shapes, each with its simulators,
`bcppl.distributions.switch.Switch` evaluates for each particle the one that it chose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import pyro
import torch
from pyro.distributions import Categorical
from torch import Tensor

from bcppl import poses
from bcppl.contact.track import ContactTrack
from bcppl.distributions.contact import ChamferContacts, PegPose
from bcppl.distributions.depth import RobustDepth
from bcppl.errors import InputError
from bcppl.models import peg_in_hole
from bcppl.robot.motion import ProbeWindow
from bcppl.sensors import Recording, View
from bcppl.traces import Model, carried

# Where the holes are in the frame of the first, metres: those of the plate that `invent` makes.
PITCH = 0.034
HOLES = ((0.0, 0.0), (PITCH, 0.0), (0.0, PITCH), (PITCH, PITCH))


@dataclass(frozen=True, eq=False)
class Scene(peg_in_hole.Scene):
    """What stays the same over a run; `hole_from_part` (K, 7) is the plate seen from each of its holes."""

    hole_from_part: Tensor


def which_hole(scene: Scene, actions: Sequence[View | ProbeWindow]) -> None:
    """The program: which hole is seen and where it is, then what every view and window shows of the plate."""
    settings = scene.settings
    which = pyro.sample("which", Categorical(torch.ones(len(scene.hole_from_part), dtype=torch.float64)))
    hole = pyro.sample("hole", scene.prior)
    part = poses.compose(hole, scene.hole_from_part[which])
    for k, action in enumerate(actions):
        if isinstance(action, View):
            depth = RobustDepth(
                scene.renderer,
                action.camera,
                part,
                scale=settings.depth_scale,
                outlier=settings.outlier,
                background=scene.background.get(action.camera.name),
                effective_pixels=settings.effective_pixels,
            )
            pyro.sample(f"depth_{k}", depth)
        else:
            assert scene.physics is not None and scene.sensing is not None
            begin = partial(ContactTrack.start, scene.physics, scene.sensing, part, action.probe)
            track = carried(f"probe {action.probe.name}", part, begin)
            window = (track, action.first, action.last)
            pyro.sample(f"contacts_{k}", ChamferContacts(*window, settings.contact_scale, settings.one_empty))
            peg = PegPose(
                *window, settings.translation_scale, settings.rotation_scale, every=settings.pose_every
            )
            pyro.sample(f"peg_{k}", peg)


def prepare(recording: Recording, holes: Sequence[tuple[float, float]] = HOLES, **settings: Any) -> Scene:
    """The scene of a recording.

    Args:
        recording: what was measured; its part's frame sits in the first hole.
        holes: where the holes are, x and y in the part's frame, metres.
        settings: fields of `peg_in_hole.Settings`, or `renderer`.

    Raises:
        InputError: there are fewer than two holes, the first is not at the origin, two are at one place or
            one beside the part; or as `peg_in_hole.prepare`.
    """
    try:
        places = np.asarray(holes, dtype=np.float64)
    except (TypeError, ValueError):
        places = np.zeros(0)
    if places.ndim != 2 or places.shape[1] != 2 or len(places) < 2 or places[0].any():
        raise InputError(
            f"which_hole is given holes at {holes}; give x and y of two or more in the part's "
            "frame, the first (0, 0)."
        )
    low, high = recording.part.vertices[:, :2].min(axis=0), recording.part.vertices[:, :2].max(axis=0)
    within = ((low <= places) & (places <= high)).all(axis=1)
    if not within.all():
        k = int(np.argmin(within))
        raise InputError(
            f"hole {k} is at {places[k].tolist()}, beside part {recording.part.name!r}, which reaches from "
            f"{low.tolist()} to {high.tolist()} m; give metres in the part's frame."
        )
    if len(np.unique(places, axis=0)) < len(places):
        raise InputError(f"which_hole is given one hole twice, {places.tolist()}; give each once.")
    hole_from_part = poses.identity(len(places))
    hole_from_part[:, :2] = -torch.from_numpy(places)
    return Scene(**peg_in_hole.prepare(recording, **settings).__dict__, hole_from_part=hole_from_part)


def invent(seed: int, **options: Any) -> Recording:
    """A plate with four holes, one of them seen and two neighbours' places touched, in a finer simulation."""
    from bcppl.models.worlds.which_hole import record

    return record(seed, **options)


model = Model(program=which_hole, prepare=prepare, observe=peg_in_hole.observe, pose="hole", invent=invent)
