"""Plans of compliant insertions: a guarded descent, a spiral search, and a compliant push.

The pose of the hole is that relative to the held peg (`Belief.relative`): what peg and part are off by alike
does not matter. Of several modes the heaviest is tried, for there may be no hole at their mean. The peg
descends along the hole's axis, presses softly, and follows a spiral as wide as the mode is uncertain until it
sinks in; then it is pushed with a stiffness that lets it align with the hole.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch

from bcppl import poses
from bcppl.arguments import number_within
from bcppl.arrays import Array
from bcppl.beliefs import Belief
from bcppl.errors import InputError
from bcppl.geometry.holes import Fit, Hole, fit_in, hole_of
from bcppl.geometry.parts import Part
from bcppl.inference.summaries import weighted_covariance
from bcppl.robot.plan import InsertionPlan, Manner, Plan


class InsertionParameters(NamedTuple):
    """Parameters of an insertion: metres, seconds, newtons, N/m along and N m/rad about the peg's axes.

    Attributes:
        approach_height: of the peg above the hole at the start.
        free_speed, landing_speed, search_speed, push_speed: m/s at most, but for the press after landing,
            which is twice as fast. With 0.1 mm of clearance and 0.2 mm and 0.4 degrees of uncertainty,
            searches at 5 mm/s missed 2 of 21 holes, at 3 mm/s none.
        contact_force: that stops the descent.
        press_depth: of the command beyond the point of contact; the spring along the axis presses by it.
        standard_deviations: the spiral's radii, in standard deviations of the hole's position.
        minimum_radius, maximum_radius: limits of that. The search ends where the hole is, so a larger radius
            takes more time only where the belief is overconfident.
        search_time: at most. A spiral that would take longer has a wider pitch, up to the clearance, and then
            is smaller, so that it covers less of the belief: with 0.1 mm of clearance and 1 mm of uncertainty
            on both axes about half of it, on one axis nearly all.
        maximum_turns: of the spiral per second.
        pitch: of the spiral, in clearances.
        push_force: that stops the push.
        push_depth: of the push, as a share of the hole's depth.
        search_stiffness, search_damping: stiff laterally, so that friction hardly holds the peg back.
        push_stiffness, push_damping: compliant about all axes, so that the hole aligns the peg.
    """

    approach_height: float = 0.02
    free_speed: float = 0.1
    landing_speed: float = 0.015
    search_speed: float = 0.003
    push_speed: float = 0.02
    contact_force: float = 0.7
    press_depth: float = 0.006
    standard_deviations: float = 4.0
    minimum_radius: float = 0.0003
    maximum_radius: float = 0.004
    search_time: float = 15.0
    maximum_turns: float = 2.0
    pitch: float = 0.6
    push_force: float = 20.0
    push_depth: float = 0.95
    search_stiffness: tuple[float, ...] = (4000.0, 4000.0, 150.0, 300.0, 300.0, 300.0)
    search_damping: tuple[float, ...] = (180.0, 180.0, 60.0, 5.0, 5.0, 5.0)
    push_stiffness: tuple[float, ...] = (800.0, 800.0, 1500.0, 5.0, 5.0, 5.0)
    push_damping: tuple[float, ...] = (80.0, 80.0, 120.0, 0.6, 0.6, 0.6)


_REST = 0.15  # s before any motion, for the tare
_SETTLE = 0.15  # s between the press and the search
_SUNK = 0.001  # m below the chamfer at which a peg is in a hole, or half of what is left of a shallow one
_KNOTS = 16  # per turn of the spiral, at least
_RIM = 1e-4  # m above its tip to which a peg's rim reaches
_SHRINK = 0.98  # of a spiral that takes too long, until it does not


class HoleEstimate(NamedTuple):
    """The hole at the heaviest mode of a belief, as seen from the held peg.

    Attributes:
        mass: the mode's share of the belief's weight.
        world_from_hole: (7,) the mean pose of the hole in that mode.
        covariance: (3, 3) m^2, of the hole's origin in that mode, along the axes of its mean pose.
    """

    mass: float
    world_from_hole: torch.Tensor
    covariance: torch.Tensor


def hole_estimate(belief: Belief, hole: Hole, fit: Fit) -> HoleEstimate:
    """The hole at the heaviest mode of a belief over world_from_part, as seen from a peg of a fit."""
    part_from_hole = torch.from_numpy(hole.part_from_hole)
    mode = belief.modes()[0]
    standing = poses.compose(poses.compose(mode.mean, part_from_hole), torch.from_numpy(fit.hole_from_peg))
    seen = mode.belief.relative(standing)
    world_from_hole = poses.compose(seen.mean, part_from_hole)
    holes = poses.compose(seen.world_from_part, part_from_hole.expand(len(seen), 7))
    away = poses.transform(poses.inverse(world_from_hole), holes[:, :3])
    return HoleEstimate(mode.mass, world_from_hole, weighted_covariance(away, seen.weights))


def _height_deviation(belief: Belief, hole: Hole, fit: Fit, peg: Part) -> float:
    """Standard deviation (m) of the height of the part's top under the rim of a peg over its hole."""
    part_from_hole, low = torch.from_numpy(hole.part_from_hole), float(peg.vertices[:, 2].min())
    mode = belief.modes()[0]
    part_from_peg = poses.compose(part_from_hole, torch.from_numpy(fit.hole_from_peg))
    seen = mode.belief.relative(poses.compose(mode.mean, part_from_peg))
    rim = torch.from_numpy(peg.vertices[peg.vertices[:, 2] < low + _RIM].copy())
    under = poses.transform(part_from_peg, rim)
    heights = poses.transform(poses.inverse(seen.mean), poses.transform(seen.world_from_part, under))[..., 2]
    return float(torch.sqrt(seen.weights @ (heights - seen.weights @ heights) ** 2).max())


def insertion_plan(
    belief: Belief,
    part: Part,
    peg: Part,
    hole: Hole | None = None,
    parameters: InsertionParameters | None = None,
) -> InsertionPlan:
    """A compliant insertion at a belief's heaviest mode, with a search as wide as that is uncertain.

    Args:
        belief: over world_from_part.
        part: with the hole, its z axis out of its top.
        peg: the held peg, its frame where it is held and its tip at its lowest z.
        hole: of the part; `hole_of(part, peg=peg)` unless given.
        parameters: of the insertion.

    Raises:
        InputError: the part has no hole or several, the peg does not fit, or a parameter is not positive.
    """
    chosen = _checked(InsertionParameters() if parameters is None else parameters)
    hole = hole_of(part, peg=peg) if hole is None else hole
    fit = fit_in(hole, peg)
    _, world_from_hole, covariance = hole_estimate(belief, hole, fit)
    height = max(0.001, chosen.standard_deviations * _height_deviation(belief, hole, fit, peg))
    times, tips, manners = _descent(chosen, height)
    spiral_times, spiral = _spiral(covariance[:2, :2].numpy(), fit.clearance, chosen)
    times = np.concatenate([times, times[-1] + spiral_times])
    tips = np.concatenate([tips, np.column_stack([spiral, np.full(len(spiral), tips[-1, 2])])])
    searching: Manner = "searching"

    def with_tip_at(positions: Array) -> Array:
        """The peg's poses (K, 7) with its tip at positions (K, 3) in the hole's frame."""
        hole_from_tip = torch.from_numpy(fit.hole_from_peg).expand(len(positions), 7).clone()
        hole_from_tip[:, :3] += torch.from_numpy(positions)
        return np.asarray(poses.compose(world_from_hole, hole_from_tip).numpy())

    search = Plan(
        "search",
        times,
        with_tip_at(tips),
        (*manners, *((searching,) * len(spiral))),
        chosen.contact_force,
        np.array(chosen.search_stiffness),
        np.array(chosen.search_damping),
        sink=hole.chamfer + min(_SUNK, 0.5 * (hole.depth - hole.chamfer)),
    )
    depth = chosen.push_depth * hole.depth
    down = max(depth / chosen.push_speed, 0.2)
    push = Plan(
        "push",
        np.array([0.0, down, down + 0.2]),
        with_tip_at(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -depth], [0.0, 0.0, -depth]])),
        ("guarded", "held"),
        chosen.push_force,
        np.array(chosen.push_stiffness),
        np.array(chosen.push_damping),
    )
    return InsertionPlan(search, push, world_from_hole.numpy(), hole.depth, hole.chamfer)


def _checked(parameters: InsertionParameters) -> InsertionParameters:
    for name, value in parameters._asdict().items():
        if name.endswith(("stiffness", "damping")):
            if np.shape(value) != (6,):
                raise InputError(f"the insertion has {name} {value!r}; give six numbers.")
            for number in value:
                number_within(f"the insertion has {name} with {{}} in it", number, above=0.0)
        else:
            number_within(f"the insertion has {name} {{}}", value, above=0.0)
    return parameters


def _descent(parameters: InsertionParameters, height: float) -> tuple[Array, Array, tuple[Manner, ...]]:
    """Times (K,), tips (K, 3) in the hole's frame and manners (K - 1,) up to the beginning of a search."""
    lowest = -height - 2.0 * parameters.contact_force / parameters.search_stiffness[2]
    pressed = lowest - parameters.press_depth
    start = parameters.approach_height + height
    heights = np.array([start, start, height, lowest, pressed, pressed])
    speeds = [parameters.free_speed, parameters.landing_speed, 2.0 * parameters.landing_speed]
    spans = [_REST, *(np.abs(np.diff(heights[1:5])) / speeds), _SETTLE]
    times = np.concatenate([[0.0], np.cumsum(np.maximum(spans, 0.05))])
    tips = np.column_stack([np.zeros((len(heights), 2)), heights])
    return times, tips, ("free", "free", "guarded", "held", "held")


def _spiral(covariance: Array, clearance: float, parameters: InsertionParameters) -> tuple[Array, Array]:
    """Times (K,) from the start and positions (K, 2) of a spiral over the ellipse of a covariance."""
    variances, axes = np.linalg.eigh(covariance)
    spread = parameters.standard_deviations * np.sqrt(np.maximum(variances, 0.0))
    radii = np.clip(spread, parameters.minimum_radius, parameters.maximum_radius) + clearance
    pitch, widest = parameters.pitch * clearance, max(parameters.pitch, 1.0) * clearance
    # An ellipse's area over the pitch is about the spiral's length, and a lower bound.
    length = parameters.search_speed * parameters.search_time
    most = parameters.maximum_turns * parameters.search_time
    pitch = min(max(pitch, math.pi * radii.prod() / length, radii[0] / most), widest)
    radii = radii * min(1.0, math.sqrt(pitch * length / (math.pi * radii.prod())), pitch * most / radii[0])
    spans, positions = _turns(radii, pitch, parameters)
    while spans.sum() > parameters.search_time:
        pitch, radii = (pitch / _SHRINK, radii) if pitch < widest else (pitch, _SHRINK * radii)
        spans, positions = _turns(radii, pitch, parameters)
    return np.cumsum(spans), positions @ axes.T


def _turns(radii: Array, pitch: float, parameters: InsertionParameters) -> tuple[Array, Array]:
    """Spans (K,) and ends (K, 2) of motions from an ellipse's centre along a spiral, s and m.

    The ellipse has radii (2,) of which the second is the longer. The spiral grows from its longer axis, with
    turns a pitch apart at most, so that one of them passes the hole's centre within half of that. From the
    centre it would be several times as long where the ellipse is elongated.
    """
    count = radii[0] / pitch
    angle = np.linspace(0.0, 2.0 * math.pi * count, max(2, math.ceil(_KNOTS * count)) + 1)
    grown = radii - (1.0 - angle / angle[-1])[:, None] * radii[0]
    ends = np.column_stack([np.sin(angle), np.cos(angle)]) * grown
    lengths = np.linalg.norm(np.diff(ends, axis=0, prepend=0.0), axis=1)
    turned = np.diff(angle, prepend=0.0) / (2.0 * math.pi)
    spans = np.maximum(lengths / parameters.search_speed, turned / parameters.maximum_turns)
    return spans[spans > 0.0], ends[spans > 0.0]
