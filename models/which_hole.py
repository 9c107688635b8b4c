"""Which hole is it? A plate has several equal holes, and a near camera sees one of them.

`hole` is the pose of the hole in view, `which` its number among the plate's holes. The positions of the
others and of the plate's edges depend on both. The camera informs `hole` and not `which`; touching where a
neighbour would be informs `which`. The frame of a recording's part is in the first hole, so `hole` is the
part's pose if that one is in view, and the pose that an insertion needs in any case.

The discrete site displaces the same plate, so one renderer and one physics serve all particles. For a choice
among parts of different shapes, each with its simulators, `bcppl.distributions.switch.Switch` evaluates the
one that each particle has.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyro
import torch
from pyro.distributions import Categorical
from torch import Tensor

from bcppl import poses
from bcppl.errors import InputError
from bcppl.models.grasped_peg import by_known_cameras
from bcppl.models.shipped import simulated_in
from bcppl.sensors.measurements import Recording
from bcppl.sensors.scene import Scene
from bcppl.traces import Model

# Positions of the holes in the frame of the first, metres: those of the simulated plate.
PITCH = 0.034
HOLES = ((0.0, 0.0), (PITCH, 0.0), (0.0, PITCH), (PITCH, PITCH))


@dataclass(frozen=True, eq=False)
class PlateScene(Scene):
    """The scene, and `hole_from_part` (K, 7): the plate's pose in the frame of each of its holes."""

    hole_from_part: Tensor


def which_hole(scene: PlateScene, actions: Sequence[Any]) -> None:
    """The program: the number and the pose of the hole in view, then each measurement's sites."""
    which = pyro.sample("which", Categorical(torch.ones(len(scene.hole_from_part), dtype=torch.float64)))
    hole = pyro.sample("hole", scene.prior)
    part = poses.compose(hole, scene.hole_from_part[which])
    for number, action in enumerate(actions):
        scene.sensor(action).observe(number, action, part)


def prepare(
    recording: Recording, holes: Sequence[tuple[float, float]] = HOLES, **settings: Any
) -> PlateScene:
    """The scene of a recording.

    Args:
        recording: of depth images and probe windows; its part's frame is in the first hole.
        holes: positions of the holes, x and y in the part's frame, metres.
        settings: as for `grasped_peg.by_known_cameras`.

    Raises:
        InputError: there are fewer than two holes, the first is not at the origin, two are at one place, or
            one is beside the part; or as `grasped_peg.by_known_cameras`.
    """
    try:
        places = np.asarray(holes, dtype=np.float64).reshape(-1, 2)
    except (TypeError, ValueError):
        places = np.zeros((0, 2))
    if len(places) < 2 or places[0].any() or len(np.unique(places, axis=0)) < len(places):
        raise InputError(
            f"which_hole is given holes at {holes}; give x and y of two or more in the part's "
            "frame, the first (0, 0), and none twice."
        )
    low, high = recording.part.vertices[:, :2].min(axis=0), recording.part.vertices[:, :2].max(axis=0)
    within = ((low <= places) & (places <= high)).all(axis=1)
    if not within.all():
        k = int(np.argmin(within))
        raise InputError(
            f"hole {k} is at {places[k].tolist()}, beside part {recording.part.name!r}, which reaches from "
            f"{low.tolist()} to {high.tolist()} m; give metres in the part's frame."
        )
    hole_from_part = poses.identity(len(places))
    hole_from_part[:, :2] = -torch.from_numpy(places)
    scene = by_known_cameras(recording, "which_hole", **settings)
    return PlateScene(scene.prior, scene.likelihoods, "which_hole", hole_from_part)


model = Model(
    program=which_hole,
    prepare=prepare,
    observe=Scene.observed,
    pose="hole",
    simulate_recording=simulated_in("which_hole"),
)
