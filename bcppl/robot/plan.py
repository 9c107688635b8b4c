"""Plans of straight motions, some of them guarded.

A `Probe` is an executed command. A plan precedes it: the executor (a robot, or a simulated world) decides
from the wrench where guarded motions end.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from bcppl import poses
from bcppl.arguments import number_within
from bcppl.arrays import Array
from bcppl.errors import InputError
from bcppl.robot.motion import Probe

Manner = Literal["free", "guarded", "held", "searching"]
MANNERS: tuple[Manner, ...] = ("free", "guarded", "held", "searching")

QUICKEST = 1e5  # samples per second, more than any sensor's rate
STIFFEST = 1e7  # N/m and the other units: beyond any arm, and unstable at any time step
LONGEST = 600.0  # s: a longer plan is in milliseconds
WIDEST = 5.0  # m between knots, and
FARTHEST = 100.0  # m from the world's origin: beyond either the poses are in millimetres


@dataclass(frozen=True, eq=False, repr=False)
class Plan:
    """Straight motions of a held peg between knots.

    Between knots translations are interpolated linearly and rotations along the geodesic. A "guarded" motion
    stops where the contact force exceeds `force`; "held" motions after it are displaced by the remainder of
    its path, so a slide continues along the surface in contact. A "free" motion ends at its knot as planned.
    "Searching" motions are held ones with a command below a surface: once the peg has sunk by `sink` along
    the commanded z, measured from the stop of the last guarded motion if there was one, it is in a hole; the
    motion stops, and the searching motions directly after it are skipped.

    Attributes:
        name: of the resulting probe.
        times: (K,) seconds, increasing.
        world_from_peg: (K, 7) commanded poses at the knots.
        manners: (K - 1,) one of "free", "guarded", "held" and "searching" for each motion.
        force: contact force at which a guarded motion stops, newtons.
        stiffness: (6,) N/m along, then N m/rad about, the commanded peg's axes.
        damping: (6,) N s/m, then N m s/rad.
        rate: measurements per second.
        sink: depth below the surface at which a searching peg is in a hole, metres.

    Raises:
        InputError: shapes do not fit, times do not increase, a manner is unknown, the force is not positive,
            times or positions are so large that they are in milliseconds or millimetres, or a motion searches
            and no sink is given.
    """

    name: str
    times: Array
    world_from_peg: Array
    manners: tuple[Manner, ...]
    force: float
    stiffness: Array
    damping: Array
    rate: float = 100.0
    sink: float = 0.0

    def __repr__(self) -> str:
        motions = ", ".join(f"{count} {manner}" for manner, count in Counter(self.manners).items())
        return f"Plan({self.name!r}, {float(self.times[-1]):.3g} s, {motions})"

    def __post_init__(self) -> None:
        for name in ("times", "world_from_peg", "stiffness", "damping"):
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype=np.float64))
        knots = self.times.size if self.times.ndim == 1 else 0
        if knots < 2 or self.world_from_peg.shape != (knots, 7) or len(self.manners) != knots - 1:
            raise InputError(
                f"plan {self.name!r} has {knots} times, poses {self.world_from_peg.shape} and "
                f"{len(self.manners)} manners; give K >= 2 times, (K, 7) poses and K - 1 manners."
            )
        if not (np.isfinite(self.times).all() and (np.diff(self.times) > 0).all()):
            raise InputError(f"plan {self.name!r} has times that do not increase; sort them, in seconds.")
        poses.as_pose(self.world_from_peg, f"a pose of plan {self.name!r}")
        for manner in set(self.manners) - set(MANNERS):
            raise InputError(
                f"plan {self.name!r} has a motion that is {manner!r}; give one of {', '.join(MANNERS)}."
            )
        lasts = float(self.times[-1] - self.times[0])
        sampled = f"plan {self.name!r} lasts {lasts:.3g} s and has a rate of {{}} a second"
        number_within(sampled, self.rate, least=1.0 / lasts, most=QUICKEST)
        self._check_units(lasts)
        for name, given in (("stiffness", self.stiffness), ("damping", self.damping)):
            if given.shape != (6,) or not ((given >= 0.0) & (given <= STIFFEST)).all():
                raise InputError(
                    f"plan {self.name!r} has {name} {given.tolist()}; give six numbers from 0 to "
                    f"{STIFFEST:g}, in N/m and N m/rad, or N s/m and N m s/rad."
                )
        number_within(f"plan {self.name!r} stops at {{}} N", self.force, above=0.0)
        number_within(f"plan {self.name!r} has a sink of {{}} m", self.sink)
        if "searching" in self.manners and not self.sink > 0.0:
            raise InputError(
                f"plan {self.name!r} searches until the peg has sunk by {self.sink:g} m; give a positive "
                "`sink`, less than the depth of the command below the surface."
            )

    def _check_units(self, lasts: float) -> None:
        if lasts > LONGEST:
            raise InputError(
                f"plan {self.name!r} lasts {lasts:.0f} s: its times are probably in milliseconds; scale them."
            )
        positions = self.world_from_peg[:, :3]
        extent, away = float(np.ptp(positions, axis=0).max()), float(np.abs(positions).max())
        if extent > WIDEST or away > FARTHEST:
            raise InputError(
                f"plan {self.name!r} spans {extent:.4g} m, to {away:.4g} m from the world's origin: its "
                "poses are probably in millimetres; scale x, y and z by 0.001 to metres."
            )


def probe_of(plan: Plan) -> Probe:
    """The command of a plan that nothing stops, with stamps up to but without its last knot."""
    count = max(1, round(float(plan.times[-1] - plan.times[0]) * plan.rate))
    stamps = plan.times[0] + np.arange(count) / plan.rate
    return Probe(plan.name, plan.times, plan.world_from_peg, plan.stiffness, plan.damping, stamps)


@dataclass(frozen=True, eq=False)
class InsertionPlan:
    """A search for a hole, and a push into it from the pose at which the search ends.

    The two have their own stiffness: a search is stiff laterally and compliant along the axis; a push leaves
    the peg compliant in rotation. Between them the controller's stiffness is changed and its command set to
    the peg's pose, which unloads the springs.

    Attributes:
        search: ends with its last motion or, earlier, where a "searching" motion detects the hole.
        push: its first pose is the peg's expected pose at the end of the search; see `push_from`.
        world_from_hole: (7,) estimated pose of the hole: its origin in the plane of the part's top, z out of
            the material.
        depth: of the hole, metres.
        chamfer: depth below the top down to which the hole is wider, metres.

    Raises:
        InputError: the search has no searching motion, or the depth is not positive.
    """

    search: Plan
    push: Plan
    world_from_hole: Array
    depth: float
    chamfer: float

    def __post_init__(self) -> None:
        if "searching" not in self.search.manners:
            raise InputError(
                f"the search {self.search.name!r} of an insertion has no searching motion; give at least one."
            )
        if not self.depth > 0.0:
            raise InputError(f"an insertion is planned {self.depth:g} m deep; give a positive depth.")

    @property
    def deep_enough(self) -> float:
        """The least depth (m) of an inserted peg: 0.8 of the hole's, or 10 mm past the chamfer."""
        return min(0.8 * self.depth, self.chamfer + 0.01)

    def push_from(self, world_from_peg: Array, sunk: float | None = None) -> Plan:
        """The push, transformed as a whole to begin at a pose (7,) and to end at the planned depth.

        It is no faster than planned: where it has farther to go, it takes longer.

        The peg has rotated with the hole that it is in, so the path is along its own axes.

        Args:
            world_from_peg: the peg's pose.
            sunk: its depth (m) below the top, where contact located it; None for the depth relative to the
                push's first pose.
        """
        import torch

        start = torch.from_numpy(self.push.world_from_peg[0])
        pose = torch.as_tensor(world_from_peg)
        path = poses.compose(poses.inverse(start), torch.from_numpy(self.push.world_from_peg))
        if sunk is None:
            sunk = -float(poses.transform(poses.inverse(start), pose[None, :3])[0, 2])
        length = float(path[:, 2].abs().max())
        share = max(length - sunk, 0.0) / length if length > 0.0 else 1.0
        path[:, :3] *= share
        times = self.push.times[0] + (self.push.times - self.push.times[0]) * max(share, 1.0)
        return replace(self.push, times=times, world_from_peg=poses.compose(pose, path).numpy())
