"""Quasi-static motion of a compliantly held peg in contact with a part.

A peg that is pressed slowly through a spring is where the spring is shortest: at its command where that is
free, otherwise at the nearest pose that the part allows. Haptic rendering computes the same: the peg is the
god-object, or virtual proxy, of C. Zilles and J. Salisbury, A constraint-based god-object method for haptic
display, IROS 1995. There is no friction.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
import trimesh
from torch import Tensor

from bcppl import poses
from bcppl.arrays import Array, Indices, Mask
from bcppl.compiled import compiled
from bcppl.contact.half_spaces import project_onto_half_spaces
from bcppl.geometry.gap import Frames, PegGap, frames_of
from bcppl.geometry.gap.peg_gap import Tables, measured
from bcppl.geometry.gap.sharp_edges import dot
from bcppl.geometry.parts import Part
from bcppl.poses.kernels import local, retract, rotation_matrix
from bcppl.robot.commands import interpolated_command
from bcppl.robot.motion import ProbeWindow

_LONGEST = 0.001  # m: of a step
_SHORTEST = 0.0001
_THIN = 0.4  # of the thinnest wall: a longer step might pass through it
_TOUCHES = 2e-7  # m: contact below this distance
_CONVERGED = 1e-7  # m: the step at which a blocked peg is at rest; a fifth of it is no penetration
_ROUGHLY = 1e-5  # m: the same after `_PATIENT` iterations
_PATIENT = 10
_ITERATIONS = 40  # of a blocked peg, for one command
_DEEP = 5e-5  # m: a step that leads deeper into the part is halved
_REFUTED = 1e-6  # m
_ALIKE = 0.99999  # cosine between the normals of two planes that count as one
_PLANES = 4  # contacts that are remembered
_CHUNK = 8  # pegs of a chunk of work
_MEASURED = 0.0019  # m: larger gaps are upper bounds, because edges farther away are not measured


class QuasiStaticMotion:
    """Motion of a held peg along a commanded path, for many poses of the part.

    Between stamps the peg moves straight towards its command, by steps shorter than the part's walls are
    thick. Where the part blocks it, it slides along the tangent planes of up to four contacts to the point
    nearest to the command. Its rotation is the commanded one, and there are no dynamics: it suits slow
    probes, whose controller is much stiffer in rotation than the forces of a touch ask for.

    Attributes:
        gap: the distance between part and peg.
        step: upper bound of a step, metres.
    """

    def __init__(self, gap: PegGap) -> None:
        self.gap = gap
        self.step = float(
            np.clip(_THIN * min(_thickness(gap.part), _thickness(gap.peg)), _SHORTEST, _LONGEST)
        )
        self.reach = float(np.linalg.norm(gap.peg.vertices, axis=1).max())
        low, high = gap.part.vertices.min(axis=0), gap.part.vertices.max(axis=0)
        self._middle, self._half = torch.from_numpy(0.5 * (low + high)), torch.from_numpy(0.5 * (high - low))
        self._corners = torch.from_numpy(gap.peg.mesh.convex_hull.vertices.view(np.ndarray))

    def __call__(self, world_from_part: Tensor, world_from_peg: Tensor) -> Tensor:
        """Poses of the peg.

        Args:
            world_from_part: (N, 7).
            world_from_peg: (T, 7) commanded, or (N, T, 7) for a command of each particle's own. A peg that
                begins inside the part is pushed out.

        Returns:
            (N, T, 8) world_from_peg, then 1 in contact and 0 out of it; NaN for a particle whose part or
            command is.
        """
        part = world_from_part.detach().to(torch.float64)
        command = world_from_peg.detach().to(torch.float64).expand(len(part), *world_from_peg.shape[-2:])
        motion = torch.full((*command.shape[:2], 8), torch.nan, dtype=torch.float64)
        finite = torch.isfinite(part).all(dim=1) & torch.isfinite(command).all(dim=2).all(dim=1)
        if command.shape[1] and bool(finite.any()):
            motion[finite] = self._motion(part[finite], command[finite])
        return motion

    def _motion(self, part: Tensor, command: Tensor) -> Tensor:
        turned = _angles(command[:, :-1, 3:], command[:, 1:, 3:])
        moved = (command[:, 1:, :3] - command[:, :-1, :3]).norm(dim=-1) + self.reach * turned
        moved = torch.cat([torch.zeros_like(moved[:, :1]), moved], dim=1)
        free = _free(self, self.separation(part, command), turned)
        frames, longest = frames_of(part), self.step
        rows, counts = np.empty((*command.shape[:2], 8)), np.zeros(len(part), dtype=np.int64)
        path, lengths = command.numpy(), moved.numpy()

        def work(first: int, last: int, tables: Tables) -> int:
            return _followed(first, last, frames, path, lengths, free, tables, longest, rows, counts)

        with self.gap.effort.measure() as effort:
            self.gap.in_threads(work, len(part), _CHUNK)
            effort.items += int(counts.sum())
        return torch.from_numpy(rows)

    def separation(self, world_from_part: Tensor, world_from_peg: Tensor) -> Tensor:
        """Distances (N, K, 6) of a peg at poses (N, K, 7) from the planes of the part's bounding box."""
        peg = poses.compose(poses.inverse(world_from_part)[:, None], world_from_peg)
        across = poses.rotation_matrix(peg) @ self._corners.T
        place = peg[..., :3] - self._middle
        return torch.cat(
            [place + across.amin(-1) - self._half, -place - across.amax(-1) - self._half], dim=-1
        )


class WindowMotion:
    """Quasi-static motion in a window of a probe, at every `every`-th of its stamps.

    The probe is followed from its first stamp on, by a command that no guard stops.
    """

    def __init__(self, model: QuasiStaticMotion, window: ProbeWindow, every: int) -> None:
        self.model, self.window, self.every = model, window, every

    def __call__(self, world_from_part: Tensor) -> Tensor:
        """(N, T, 8), as `QuasiStaticMotion` returns it, for poses (N, 7) of the part."""
        return self.together([self], [world_from_part])[0]

    @property
    def command(self) -> Tensor:
        """(S, 7) from the probe's beginning to the window's end."""
        probe, first = self.window.probe, self.window.first % self.every
        stamps = probe.stamps[first : self.window.last : self.every]
        return torch.from_numpy(interpolated_command(probe, stamps)[0])

    @staticmethod
    def together(motions: Sequence[WindowMotion], world_from_part: Sequence[Tensor]) -> list[Tensor]:
        """Motions for poses (N_k, 7) each, (N_k, T_k, 8), in one batch for each model."""
        rows: dict[int, Tensor] = {}
        commands = [motion.command for motion in motions]
        for model in {id(motion.model): motion.model for motion in motions}.values():
            own = [k for k, motion in enumerate(motions) if motion.model is model]
            longest = max(len(commands[k]) for k in own)
            # A command that has ended is held.
            padded = [
                torch.cat([commands[k], commands[k][-1:].expand(longest - len(commands[k]), 7)]) for k in own
            ]
            counts = [len(world_from_part[k]) for k in own]
            command = torch.stack(padded).repeat_interleave(torch.tensor(counts), dim=0)
            moved = model(torch.cat([world_from_part[k] for k in own]), command)
            for k, row in zip(own, moved.split(counts), strict=True):
                first = motions[k].window.first // motions[k].every
                rows[k] = row[:, first : len(commands[k])]
        return [rows[k] for k in range(len(motions))]


def _free(model: QuasiStaticMotion, separation: Tensor, turned: Tensor) -> Mask:
    """Whether ways to commands lead past the part (N, T), by separations (N, T, 6) and angles (N, T - 1)."""
    # A straight motion stays beyond a plane that both of its ends are beyond; a rotation sags.
    apart = torch.minimum(separation[:, 1:], separation[:, :-1]).amax(dim=-1)
    free = apart > model.reach * (1.0 - torch.cos(0.5 * turned))
    return np.asarray(torch.cat([separation[:, :1].amax(dim=-1) > 0, free], dim=1))


@compiled
def _followed(
    first: int,
    last: int,
    part: Frames,
    command: Array,
    moved: Array,
    free: Mask,
    tables: Tables,
    longest: float,
    rows: Array,
    counts: Indices,
) -> int:
    """Set poses and contact (N, T, 8) of pegs from `first` to `last`, and how often each was measured.

    They follow commands (N, T, 7), to which their surfaces move by at most (N, T) from the last, and which
    lead past the part where they are `free` (N, T). It returns what `measured` does.
    """
    searched, stamps, room = 0, command.shape[1], _room()
    gap = np.empty((1, 1)), np.empty((1, 1, 3)), np.empty((1, 1, 3))
    peg = Frames(np.empty((1, 1, 3, 3)), np.empty((1, 1, 3)))
    tangent, goal, turn = np.empty((1, 6)), np.empty((1, 7)), np.empty((1, 3, 3))
    place, target = peg.translation[0, 0], goal[0, :3]
    for n in range(first, last):
        solid = Frames(part.rotation[n : n + 1], part.translation[n : n + 1])
        blocked, known, touches = True, False, False  # until measured
        slack = 0.0  # a lower bound of the distance to the part, by the last measurement and the motion since
        peg.rotation[:], place[:] = np.nan, command[n, 0, :3]
        for t in range(stamps):
            before, here = command[n, max(t - 1, 0)][None], command[n, t][None]
            local(before, here, tangent)
            turns = np.any(here[0, 3:] != before[0, 3:])
            steps = 1 if free[n, t] and not blocked else max(1, math.ceil(moved[n, t] / longest))
            for step in range(1, steps + 1):
                goal[:] = here
                if step < steps:
                    retract(before, step / steps * tangent, goal)
                    if not turns:  # but for rounding, by which its gap would be unknown
                        goal[0, 3:] = here[0, 3:]
                slack -= moved[n, t] / steps
                if not blocked and (free[n, t] or slack > 0.0):
                    place[:], known, touches = target, False, False
                    continue
                rotation_matrix(goal, goal, turn)
                known = known and bool(np.all(turn[0] == peg.rotation[0, 0]))
                peg.rotation[0, 0] = turn[0]
                found, known, measurements = _approached(
                    solid, peg, target, tables, longest, gap, known, room
                )
                searched, counts[n] = searched + found, counts[n] + measurements
                off = _apart(place, target)
                blocked = off > _CONVERGED
                touches = gap[0][0, 0] < _TOUCHES or off > 10.0 * _CONVERGED
                slack = min(gap[0][0, 0], _MEASURED)
            rows[n, t, :3], rows[n, t, 3:7], rows[n, t, 7] = place, here[0, 3:], touches
    return searched


@compiled
def _room() -> tuple[Array, Array, Array, Mask, Array]:
    """Planes that are remembered: normals, offsets and where they were seen; and room for `_step`."""
    normals, seen = np.empty((_PLANES, 3)), np.empty((_PLANES, 3))
    return normals, np.empty(_PLANES), seen, np.empty(_PLANES, np.bool_), np.empty(3)


@compiled
def _approached(
    part: Frames,
    peg: Frames,
    target: Array,
    tables: Tables,
    longest: float,
    gap: tuple[Array, Array, Array],
    known: bool,
    room: tuple[Array, Array, Array, Mask, Array],
) -> tuple[int, bool, int]:
    """Move a peg (1, 1) towards a target until it is there or at rest, and measure its gap (1, 1).

    `known` is whether that is measured already. It returns what `measured` does, `known` and how often that
    was called.
    """
    searched, measurements, normal, outside, last = 0, 0, np.empty(3), False, np.empty(3)
    normals, offsets, seen, active, best = room
    normals[:], offsets[:], seen[:] = 0.0, 0.0, np.inf
    place, planes = peg.translation[0, 0], (normals, offsets, seen)
    for iteration in range(_ITERATIONS):
        if not known:
            searched += measured(0, 1, part, peg, tables, *gap)
            measurements += 1
        if gap[0][0, 0] >= -_DEEP:
            outside, last[:] = True, place
        elif outside:
            # What it has met is not known yet, and from deep inside the shortest way out may be another one.
            place[:] = 0.5 * (place + last)
            continue
        for axis in range(3):
            normal[axis] = dot(part.rotation[0, axis], gap[2][0, 0])
        converged = _CONVERGED if iteration < _PATIENT else _ROUGHLY
        known = _step(place, target, gap[0][0, 0], normal, planes, longest, converged, active, best)
        if known:
            break
    return searched, known, measurements


@compiled
def _step(
    place: Array,
    target: Array,
    distance: float,
    normal: Array,
    remembered: tuple[Array, Array, Array],
    longest: float,
    converged: float,
    active: Mask,
    best: Array,
) -> bool:
    """Move a peg by one step: out of the part where it penetrates it, otherwise towards its target.

    `active` and `best` are room for that. True, and no step, where it is at rest.
    """
    normals, offsets, seen = remembered
    slot, least, same = 0, np.inf, False
    for p in range(len(offsets)):
        # A plane approximates the part near where it was seen; a gap wider than it allows refutes it.
        above = dot(normals[p], place) - offsets[p]
        active[p] = _apart(place, seen[p]) < 2.0 * longest and above > distance - _REFUTED
        # The newest replaces one like it, an inactive one, or the least tight.
        tight = -np.inf
        if active[p]:
            tight = -above
            if dot(normals[p], normal) > _ALIKE:
                slot, same = p, True
        if not same and tight < least:
            slot, least = p, tight
    normals[slot], seen[slot], active[slot] = normal, place, True
    offsets[slot] = dot(normal, place) - distance
    inside = distance < -0.2 * converged
    project_onto_half_spaces(place if inside else target, normals, offsets, active, best)
    size = _apart(best, place)
    share = 1.0
    if not inside and size > longest:
        share = longest / size
    if not inside and size <= converged:
        return True
    for axis in range(3):
        place[axis] += share * (best[axis] - place[axis])
    return False


@compiled
def _apart(first: Array, second: Array) -> float:
    """The distance of two points (3,)."""
    return np.sqrt((first[0] - second[0]) ** 2 + (first[1] - second[1]) ** 2 + (first[2] - second[2]) ** 2)


def _thickness(part: Part) -> float:
    """Thickness (m) of a part's thin walls: its 5 % quantile over the surface."""
    mesh = part.mesh
    points, faces = trimesh.sample.sample_surface(mesh, 2000, seed=0)
    inward = -mesh.face_normals[faces]
    places, rays, _ = mesh.ray.intersects_location(points + 1e-6 * inward, inward, multiple_hits=False)
    if len(places) == 0:
        return float(part.extent.min())
    return float(np.quantile(np.linalg.norm(places - points[rays], axis=1), 0.05))


def _angles(first: Tensor, second: Tensor) -> Tensor:
    """Angles (...) between quaternions (..., 4)."""
    return 2.0 * torch.acos((first * second).sum(dim=-1).abs().clamp(max=1.0))
