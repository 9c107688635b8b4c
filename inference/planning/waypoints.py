"""Waypoints of planned motions, and strokes as long as the belief is uncertain."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch

from bcppl import poses
from bcppl.arrays import Array
from bcppl.beliefs import Belief
from bcppl.geometry.parts import Part
from bcppl.robot.plan import Manner
from bcppl.sensors.plausibility.pegs import peg_doubt

if TYPE_CHECKING:
    from bcppl.inference.planning.metrology_parameters import MetrologyParameters
    from bcppl.inference.planning.touching import TouchParameters


STIFFNESS = (2500.0, 2500.0, 2500.0, 150.0, 150.0, 150.0)
DAMPING = (120.0, 120.0, 120.0, 2.5, 2.5, 2.5)
UP = np.array([0.0, 0.0, 1.0])
NO_LEAN = np.zeros(3)
_LEFT_OUT = 0.05  # of the belief's weight, beyond the longest half stroke, of which nobody is warned


class Waypoint(NamedTuple):
    """A waypoint of the peg's tip in the part's frame.

    Attributes:
        position: (3,) metres.
        manner: of the motion to it.
        speed: of that, m/s.
        lean: (3,) rotation vector by which the peg leans from the part's z axis, about its tip, radians.
    """

    position: Array
    manner: Manner
    speed: float
    lean: Array = NO_LEAN


def half_stroke(
    belief: Belief, positions: Array, normal: Array, limits: TouchParameters | MetrologyParameters
) -> float:
    """Half the length (m) of a guarded stroke, in proportion to the uncertainty of the surface's position.

    The position (3,) on the surface, or several (K, 3), of which the most uncertain counts, and the normal
    (3,) there are in the part's frame.

    Warns:
        RuntimeWarning: the surface may well be farther away than the longest half stroke.
    """
    of_particles = poses.transform(belief.world_from_part, torch.as_tensor(np.atleast_2d(positions)))
    direction = poses.rotation_matrix(belief.mean) @ torch.as_tensor(normal)
    along = of_particles @ direction  # (N, K)
    mean = belief.weights @ along
    deviation = float(torch.sqrt(belief.weights @ (along - mean) ** 2).max())
    shortest, longest = limits.shortest_half_stroke, limits.longest_half_stroke
    if float((belief.weights @ ((along - mean).abs() > longest).to(belief.weights)).max()) > _LEFT_OUT:
        warnings.warn(
            f"a surface may be farther away than half a stroke is long ({1e3 * longest:g} mm), so that the "
            "peg may meet it at speed; look once more, or give a longer longest_half_stroke.",
            RuntimeWarning,
            stacklevel=2,
        )
    return float(np.clip(limits.standard_deviations * deviation, shortest, longest))


def turned(belief: Belief, positions: Array, lean: Array = NO_LEAN) -> Array:
    """Poses (K, 7) in the world at positions (K, 3) in the part's frame, turned by `lean` from the mean part.

    The rotation vector (3,) is in the part's frame, radians.
    """
    axes = belief.mean.clone()
    if lean.any():
        axes = poses.retract(axes, torch.from_numpy(np.concatenate([np.zeros(3), lean])))
    world_from_peg = axes.expand(len(positions), 7).clone()
    world_from_peg[:, :3] = poses.transform(belief.mean, torch.from_numpy(positions))
    return np.asarray(world_from_peg.numpy())


def leaning(belief: Belief, waypoints: Sequence[Waypoint], tip: float) -> Array:
    """Poses (K, 7) in the world of a peg whose tip, at z = `tip` in its frame, is at each waypoint."""
    lean = torch.from_numpy(np.stack([waypoint.lean for waypoint in waypoints]))
    part_from_peg = poses.identity(len(waypoints))
    part_from_peg[:, :3] = torch.from_numpy(np.stack([waypoint.position for waypoint in waypoints]))
    part_from_peg = poses.retract(part_from_peg, torch.cat([torch.zeros_like(lean), lean], dim=-1))
    peg_from_tip = poses.identity()
    peg_from_tip[2] = -tip
    return np.asarray(poses.compose(belief.mean, poses.compose(part_from_peg, peg_from_tip)).numpy())


def top_of(part: Part) -> float:
    """The height z of a part's top in its frame, metres."""
    return float(part.vertices[:, 2].max())


def tip_of(peg: Part) -> float:
    """The height z of a peg's tip in its frame, its lowest, metres; warns where that is probably no tip."""
    for doubt in peg_doubt(peg):
        # At this line for all planners, so that Python shows it once.
        warnings.warn(doubt, RuntimeWarning, stacklevel=1)
    return float(peg.vertices[:, 2].min())
