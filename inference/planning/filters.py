"""Which candidates may be carried out: what stands in the way, what the arm reaches, how hard it presses.

A filter looks at all candidates at once and says which it keeps. `filtered` asks several, one after another,
and counts what each removed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from scipy.spatial.transform import Rotation, Slerp

from bcppl import poses
from bcppl.arguments import number_within
from bcppl.errors import InputError
from bcppl.geometry.gap import PegGap
from bcppl.geometry.parts import Part
from bcppl.inference.planning.touching import middles_of_strokes
from bcppl.robot.inverse_kinematics import joint_paths
from bcppl.robot.kinematics import Robot
from bcppl.robot.plan import Plan
from bcppl.sensors.candidates import Candidate, duration_of, motion_of, placement_of

Array = npt.NDArray[np.float64]

_APART = 0.002  # m between the places at which a free motion is looked at
_MET = 0.0005  # m: a stroke whose middle is so near to the part meets it there


class Filter(NamedTuple):
    """Keeps some candidates.

    Attributes:
        removes: what is true of those that it does not keep, in words: "are out of the arm's reach".
        keeps: of candidates (C), C booleans.
    """

    removes: str
    keeps: Callable[[Sequence[Candidate]], Sequence[bool]]


@dataclass(frozen=True, eq=False)
class Candidates(Sequence[Candidate]):
    """What may be done next, and what was left out.

    Attributes:
        kept: the candidates.
        removed: how many were left out, by what is true of them.
    """

    kept: tuple[Candidate, ...]
    removed: Mapping[str, int] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.kept)

    def __getitem__(self, index: Any) -> Any:
        return self.kept[index]

    def __str__(self) -> str:
        left = f"; left out those that {self.gone}" if self.gone else ""
        return f"{len(self)} candidate{'s' * (len(self) != 1)}{left}"

    @property
    def gone(self) -> str:
        """What was left out, in words: "come from below (9), lead through the part (1)"; else empty."""
        return ", ".join(f"{why} ({count})" for why, count in self.removed.items() if count)


class Mounted(NamedTuple):
    """An arm that holds the peg.

    Attributes:
        robot: with a tip, so that no joint is left out or too many.
        link: what the peg is mounted on.
        link_from_peg: (7,) the peg's frame, whose tip is at its lowest z, in the link's: where the link's z
            leads along the fingers, turned about by pi.
        world_from_base: (7,) where the robot stands.
    """

    robot: Robot
    link: str
    link_from_peg: Array
    world_from_base: Array


def filtered(candidates: Iterable[Candidate], filters: Sequence[Filter]) -> Candidates:
    """The candidates that all filters keep.

    Raises:
        InputError: there are none to begin with, or none is left.
    """
    found = sifted(candidates, filters)
    refuse_none(found)
    return found


def sifted(candidates: Iterable[Candidate], filters: Sequence[Filter]) -> Candidates:
    """As `filtered`, also where none is left."""
    left, removed = list(candidates), dict[str, int]()
    for each in filters:
        if not isinstance(each, Filter):
            raise InputError(
                f"a filter is a {type(each).__name__}; give Filter(removes, keeps): what is true of those it "
                "leaves out, in words, and a function of all candidates that says which it keeps."
            )
        if left:
            kept = [c for c, keep in zip(left, _kept(each, left), strict=True) if keep]
            removed[each.removes] = removed.get(each.removes, 0) + len(left) - len(kept)
            left = kept
    return Candidates(tuple(left), removed)


def _kept(each: Filter, candidates: Sequence[Candidate]) -> list[bool]:
    given: object = each.keeps(candidates)
    try:
        says = list(given) if isinstance(given, Iterable) else []
    except TypeError:  # an array without axes
        says = []
    flags = [bool(one) for one in says if isinstance(one, bool | np.bool_) or _is_flag(one)]
    if not len(says) == len(flags) == len(candidates):
        raise InputError(
            f"the filter of candidates that {each.removes} does not say of each whether it is kept; let it "
            f"give {len(candidates)} booleans for {len(candidates)} candidates."
        )
    return flags


def _is_flag(said: object) -> bool:
    return isinstance(said, torch.Tensor) and said.dtype == torch.bool and said.ndim == 0


def refuse_none(candidates: Candidates) -> None:
    """Refuse an empty choice, and say why it is empty.

    Raises:
        InputError: there is no candidate.
    """
    if len(candidates):
        return
    if not candidates.gone:
        raise InputError("there are no candidates to choose from; give one plan or view, or a kind of them.")
    total = sum(candidates.removed.values())
    raise InputError(
        f"none of {total} candidate{'s' * (total != 1)} is left to choose from: they {candidates.gone}; "
        "give other candidates, or filters that keep more."
    )


def from_within(direction: Sequence[float], angle: float, removes: str = "") -> Filter:
    """Keeps plans whose guarded motions are, and views that look, along a direction within an angle.

    Args:
        direction: (3,) in the world, of any length, along which the peg moves or the camera looks; for
            touches from above [0, 0, -1].
        angle: radians.
        removes: what is true of the others, in words.

    Raises:
        InputError: the direction has no length, or the angle is no number from 0 to pi.
    """
    number_within("candidates are to come from within an angle of {}", angle, least=0.0, most=math.pi)
    along = np.asarray(direction, dtype=np.float64)
    if along.shape != (3,) or not (np.isfinite(along).all() and np.linalg.norm(along) > 0.0):
        raise InputError(f"a direction of approach is {direction}; give three numbers, not all zero.")
    along = along / np.linalg.norm(along)

    def keeps(candidate: Candidate) -> bool:
        motion, placement = motion_of(candidate), placement_of(candidate)
        ways = [] if motion is None else [way for _, way in middles_of_strokes(motion)]
        if placement is not None:
            pose = torch.as_tensor(placement.world_from_sensor)
            ways.append(poses.rotation_matrix(pose)[:, 2].numpy())
        return all(bool(way @ along > math.cos(angle) - 1e-9) for way in ways)

    says = removes or f"come from more than {math.degrees(angle):.3g}° beside the direction that was asked"
    return Filter(says, lambda candidates: [keeps(c) for c in candidates])


def not_from_below() -> Filter:
    """Keeps touches and views that come from above or from the side, up to 30 degrees from below."""
    return from_within((0.0, 0.0, -1.0), math.radians(120.0), "come from below")


def clear_of_part(gap: PegGap, world_from_part: Array | torch.Tensor) -> Filter:
    """Keeps plans whose free motions do not lead through the part where it is thought to be.

    Free motions are looked at up to the first contact and from the pose at which the peg is free again: how
    it gets away from where it was pressed on depends on what it met.

    Args:
        gap: of the part and the peg.
        world_from_part: (7,).
    """
    there = poses.as_pose(world_from_part, "where the part is thought to be")[None]

    def keeps(candidates: Sequence[Candidate]) -> list[bool]:
        motions = [motion_of(c) for c in candidates]
        ways = [np.empty((0, 7)) if motion is None else free_ways(motion) for motion in motions]
        if not sum(map(len, ways)):
            return [True] * len(candidates)
        distance = gap(there, torch.from_numpy(np.concatenate(ways))).distance[0].numpy()
        ends = np.cumsum([len(way) for way in ways])[:-1]
        return [bool((each > 0.0).all()) for each in np.split(distance, ends)]

    return Filter("lead through the part", keeps)


def meeting(gap: PegGap, world_from_part: Array | torch.Tensor) -> Filter:
    """Keeps plans whose guarded motions meet the part half-way, where it is thought to be.

    Args:
        gap: of the part and the peg.
        world_from_part: (7,).
    """
    there = poses.as_pose(world_from_part, "where the part is thought to be")[None]

    def keeps(candidates: Sequence[Candidate]) -> list[bool]:
        motions = [motion_of(c) for c in candidates]
        met = [[] if motion is None else middles_of_strokes(motion) for motion in motions]
        middles = [middle for strokes in met for middle, _ in strokes]
        if not middles:
            return [True] * len(candidates)
        distance = gap(there, torch.from_numpy(np.stack(middles))).distance[0].abs().numpy()
        ends = np.cumsum([len(strokes) for strokes in met])[:-1]
        return [bool((each < _MET).all()) for each in np.split(distance, ends)]

    return Filter("would meet the part elsewhere or not at all", keeps)


def clear_of_table(peg: Part, height: float, margin: float = 0.002) -> Filter:
    """Keeps plans that keep the peg's lowest point a margin (m) above a table of a height (m)."""
    number_within("the table is {} m high", height)
    corners = torch.from_numpy(np.ascontiguousarray(peg.mesh.convex_hull.vertices))

    def keeps(candidate: Candidate) -> bool:
        motion, placement = motion_of(candidate), placement_of(candidate)
        if placement is not None and not placement.world_from_sensor[2] > height:
            return False
        if motion is None:
            return True
        lowest = poses.transform(torch.from_numpy(motion.world_from_peg), corners)[..., 2].min()
        return bool(lowest > height + margin)

    return Filter("lead into the table", lambda candidates: [keeps(c) for c in candidates])


def no_longer_than(seconds: float) -> Filter:
    """Keeps views, and plans that last no longer than so many seconds."""
    number_within("candidates may last {} s", seconds, least=0.0)
    return Filter(
        f"last longer than {seconds:.3g} s",
        lambda candidates: [duration_of(c) <= seconds + 1e-9 for c in candidates],
    )


def no_harder_than(force: float) -> Filter:
    """Keeps plans that press with no more than a force (N), by `pressing_force`."""
    limit = number_within("candidates may press with {} N", force, above=0.0)

    def keeps(candidate: Candidate) -> bool:
        motion = motion_of(candidate)
        return motion is None or pressing_force(motion) <= limit

    return Filter(f"press with more than {limit:g} N", lambda candidates: [keeps(c) for c in candidates])


def pressing_force(plan: Plan) -> float:
    """With how many newtons a plan presses once it has met a surface.

    It is what stops its guarded motions, and what its spring adds where it is led on beyond that. What is
    held while nothing was met counts as if it met something where it begins. An impact may be more.
    """
    worst, onto = 0.0, np.zeros(3)
    for k, manner in enumerate(plan.manners):
        way = plan.world_from_peg[k + 1, :3] - plan.world_from_peg[k, :3]
        if manner == "guarded":
            worst, onto = max(worst, plan.force), way / max(float(np.linalg.norm(way)), 1e-12)
            base = plan.world_from_peg[k + 1, :3]
        elif manner in ("held", "searching"):
            met = bool(onto.any())
            begins = base if met else plan.world_from_peg[k, :3]
            along = onto if met else way / max(float(np.linalg.norm(way)), 1e-12)
            beyond = float((plan.world_from_peg[k + 1, :3] - begins) @ along)
            held = poses.rotation_matrix(torch.from_numpy(plan.world_from_peg[k + 1])).numpy()
            spring = float(np.square(held.T @ along) @ np.asarray(plan.stiffness)[:3])
            worst = max(worst, (plan.force if met else 0.0) + spring * max(beyond, 0.0))
        elif manner == "free":
            onto = np.zeros(3)
    return worst


def within_reach(mounted: Mounted, *, seed: int = 0) -> Filter:
    """Keeps plans along which the arm's joints get the peg, and views for which they get a camera on a wrist.

    Cameras that do not stand on the wrist are kept. See `bcppl.robot.inverse_kinematics.joint_paths`.
    """
    base_from_world = poses.inverse(torch.as_tensor(mounted.world_from_base))

    def keeps(candidates: Sequence[Candidate]) -> list[bool]:
        kept = np.ones(len(candidates), dtype=bool)
        groups: dict[int, list[int]] = {}
        paths: dict[int, Array] = {}
        for k, candidate in enumerate(candidates):
            motion = motion_of(candidate)
            if motion is not None:
                paths[k] = _distinct(motion.world_from_peg)
                groups.setdefault(len(paths[k]), []).append(k)
        for which in groups.values():
            along = torch.from_numpy(np.stack([paths[k] for k in which]))
            found = joint_paths(
                mounted.robot,
                mounted.link,
                poses.compose(base_from_world, along).numpy(),
                mounted.link_from_peg,
                seed=seed,
            )
            kept[which] = np.isfinite(found).all(axis=(1, 2))
        for k, candidate in enumerate(candidates):
            placement = placement_of(candidate)
            if placement is not None and placement.wrist_from_sensor is not None:
                wrist = poses.compose(
                    torch.as_tensor(placement.world_from_sensor),
                    poses.inverse(torch.as_tensor(placement.wrist_from_sensor)),
                )
                path = poses.compose(base_from_world, wrist)[None, None].numpy()
                kept[k] = bool(np.isfinite(joint_paths(mounted.robot, mounted.link, path, seed=seed)).all())
        return [bool(each) for each in kept]

    return Filter(f"are out of {mounted.robot.name}'s reach", keeps)


def _distinct(world_from_peg: Array) -> Array:
    """The poses of a path without those at which it stands still."""
    moves = np.abs(np.diff(world_from_peg, axis=0)).max(axis=1) > 1e-9
    return world_from_peg[np.concatenate([[True], moves])]


def free_ways(plan: Plan) -> Array:
    """Poses (M, 7) of the peg, at most 2 mm apart, on its motions before and after it presses.

    Those are its free ones, and what is held while no guarded motion has met anything.
    """
    found, pressed = [plan.world_from_peg[:1]], False
    for k, manner in enumerate(plan.manners):
        if manner == "guarded":
            pressed = True
        elif not pressed:
            found.append(np.stack(list(_between(plan.world_from_peg[k], plan.world_from_peg[k + 1]))))
        elif manner == "free":
            found.append(plan.world_from_peg[k + 1 : k + 2])
            pressed = False
    return np.concatenate(found)


def _between(start: Array, stop: Array) -> Iterator[Array]:
    steps = max(1, math.ceil(float(np.linalg.norm(stop[:3] - start[:3])) / _APART))
    share = np.linspace(0.0, 1.0, steps + 1)
    ends = Rotation.from_quat(np.stack([start, stop])[:, [4, 5, 6, 3]])
    turned = Slerp([0.0, 1.0], ends)(share).as_quat()[:, [3, 0, 1, 2]]
    for one, turn in zip(share, turned, strict=True):
        yield np.concatenate([start[:3] + one * (stop[:3] - start[:3]), turn])
