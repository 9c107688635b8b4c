"""How a compliantly held peg moves past a part without physics: it follows its command until it is blocked.

The god-object, or virtual proxy, of haptics: C. Zilles and J. Salisbury, A constraint-based god-object method
for haptic display, IROS 1995; friction by W. Harwin and N. Melder, Improved haptic rendering for multi-finger
manipulation using friction cone based god-objects, Eurohaptics 2002. What a robot presses slowly through a
spring stands where the spring would be shortest: at its command where that is free, else as near to it as the
part allows.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import roma
import torch
import trimesh
from torch import Tensor

from bcppl import poses
from bcppl.arguments import number_within
from bcppl.errors import InputError
from bcppl.parts import Part
from bcppl.recordings.measurements import ProbeWindow
from bcppl.simulators.gap import PegGap
from bcppl.simulators.peg_model import commands
from bcppl.simulators.placement import compiled

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

_LONGEST = 0.001  # m: of a step
_SHORTEST = 0.0001
_THIN = 0.4  # of the thinnest wall: a longer step might come out on its other side
_DEEP = 2e-8  # m: a peg no deeper than this is out
_TOUCHES = 2e-7  # m: nearer than this it touches
_STILL = 1e-7  # m: a step shorter than this is none
_ROUNDS = 60  # steps that a blocked peg may take towards one command
_PLANES = 4  # contacts that are kept in mind
_SEEN = 0.0019  # m: a gap measured as larger may be smaller, for edges farther off are not looked at


class GodObject:
    """Where a held peg gets to along a commanded path, for many poses of the part, without physics.

    From stamp to stamp the peg goes straight towards its command, by steps shorter than the part's walls are
    thick. Where the part blocks it, it slides along the tangent planes of up to four contacts as far as the
    command leads, or, with friction, as far as the command lies outside of the cone of friction. Its rotation
    is held as commanded, and nothing is dynamic: it suits slow probes, whose controller is much stiffer
    against turning than the press of a touch asks for.

    Attributes:
        gap: measures gaps.
        friction: Coulomb's coefficient; 0 for none. A command that lies `pressed` metres or more beyond a
            surface is held back no more than one at `pressed`, as guarded motions stop there.
        pressed: metres.
        step: metres; no step is longer.

    Raises:
        InputError: a number is out of range.
    """

    def __init__(self, gap: PegGap, friction: float = 0.0, pressed: float = 0.002) -> None:
        self.gap = gap
        self.friction = number_within("a god-object is given friction {}", friction, least=0.0)
        self.pressed = number_within("a god-object is given pressed {}", pressed, least=0.0)
        self.step = float(
            np.clip(_THIN * min(_thickness(gap.part), _thickness(gap.peg)), _SHORTEST, _LONGEST)
        )
        self._reach = float(np.linalg.norm(gap.peg.vertices, axis=1).max())
        low, high = gap.part.vertices.min(axis=0), gap.part.vertices.max(axis=0)
        self._middle, self._half = 0.5 * (low + high), 0.5 * (high - low)
        self._corners = gap.peg.mesh.convex_hull.vertices.view(np.ndarray)

    def __call__(self, world_from_part: Tensor, world_from_peg: Tensor) -> Tensor:
        """Where the peg gets to.

        Args:
            world_from_part: (N, 7).
            world_from_peg: (T, 7) commanded, or (N, T, 7) where each particle has a command of its own. A
                peg that begins inside the part is pushed out.

        Returns:
            (N, T, 8) world_from_peg, then 1 where it touches the part and 0 where it does not; NaN for a
            particle whose part or whose command is.

        Raises:
            InputError: the shapes are not these.
        """
        count = len(world_from_part)
        if (
            world_from_part.shape != (count, 7)
            or world_from_peg.ndim not in (2, 3)
            or world_from_peg.shape[-1] != 7
            or (world_from_peg.ndim == 3 and len(world_from_peg) != count)
        ):
            raise InputError(
                f"a god-object is given poses {tuple(world_from_part.shape)} of the part and "
                f"{tuple(world_from_peg.shape)} of the peg; give (N, 7), and (T, 7) or (N, T, 7)."
            )
        part = world_from_part.detach().to(torch.float64)
        command = world_from_peg.detach().to(torch.float64).expand(count, *world_from_peg.shape[-2:])
        found = torch.full((*command.shape[:2], 8), torch.nan, dtype=torch.float64)
        sound = torch.isfinite(part).all(dim=1) & torch.isfinite(command).all(dim=2).all(dim=1)
        if command.shape[1] and bool(sound.any()):
            found[sound] = _Motion(self, part[sound], command[sound]).followed()
        return found

    def clearance(self, world_from_part: Tensor, world_from_peg: Tensor) -> Tensor:
        """How far (N, K, 6) a peg at poses (N, K, 7) is beyond each face of the part's bounding box."""
        peg = poses.compose(poses.inverse(world_from_part)[:, None], world_from_peg)
        across = poses.rotation_matrix(peg) @ torch.from_numpy(self._corners).T
        place = peg[..., :3] - torch.from_numpy(self._middle)
        half = torch.from_numpy(self._half)
        return torch.cat([place + across.amin(-1) - half, -place - across.amax(-1) - half], dim=-1)


def along(proxy: GodObject, window: ProbeWindow, every: int, world_from_part: Tensor) -> Tensor:
    """Where a peg gets to in a window of a probe, (N, T, 8) at its stamps, `every` of them apart.

    The whole way up to there is followed, from the probe's first stamp on.
    """
    stamps = np.arange(window.first % every, window.last, every)
    command = torch.from_numpy(commands(window.probe, window.probe.stamps[stamps])[0])
    return proxy(world_from_part, command)[:, window.first // every :]


class _Motion:
    """Pegs of N particles on their way."""

    def __init__(self, rules: GodObject, world_from_part: Tensor, command: Tensor) -> None:
        self.rules, self.part, self.command = rules, world_from_part, command
        self.place = command[:, 0, :3].clone()
        self.blocked = torch.ones(len(command), dtype=torch.bool)  # or not yet known not to be
        self.slack = torch.zeros(len(command), dtype=torch.float64)

    def followed(self) -> Tensor:
        rules, command = self.rules, self.command
        away = rules.clearance(self.part, command)
        # Between stamps a straight way stays beyond a face that it is beyond at both ends; a turn sags.
        apart = torch.minimum(away[:, 1:], away[:, :-1]).amax(dim=-1)
        turned = _angles(command[:, :-1, 3:], command[:, 1:, 3:])
        ways = (command[:, 1:, :3] - command[:, :-1, :3]).norm(dim=-1) + rules._reach * turned
        free = apart > rules._reach * (1.0 - torch.cos(0.5 * turned))
        rows = [
            self._at(command[:, 0], torch.zeros(len(command), dtype=torch.float64), away[:, 0].amax(-1) > 0)
        ]
        for t in range(1, command.shape[1]):
            count = 1
            near = ways[:, t - 1][~(free[:, t - 1] & ~self.blocked)]
            if len(near):
                count = max(1, math.ceil(float(near.max()) / rules.step))
            for share in torch.arange(1, count + 1) / count:
                goal = _between(command[:, t - 1], command[:, t], float(share))
                row = self._at(goal, ways[:, t - 1] / count, free[:, t - 1])
            rows.append(row)
        return torch.stack(rows, dim=1)

    def _at(self, goal: Tensor, moved: Tensor, free: Tensor) -> Tensor:
        """Poses and contact (N, 8) at a command (N, 7), all of it `moved` (N,) from the last one."""
        self.slack -= moved
        easy = ~self.blocked & (free | (self.slack > 0.0))
        place, touches = goal[:, :3].clone(), torch.zeros(len(goal), dtype=torch.bool)
        left = (~easy).nonzero().flatten()
        if len(left):
            reached, distance = self._towards(left, goal[left])
            place[left], touches[left] = reached, distance < _TOUCHES
            off = (reached - goal[left, :3]).norm(dim=1)
            self.blocked[left] = off > _STILL
            touches[left] |= off > 10.0 * _STILL
            self.slack[left] = distance.clamp(max=_SEEN)
        self.place = place
        return torch.cat([place, goal[:, 3:], touches[:, None].to(torch.float64)], dim=1)

    def _towards(self, chosen: Tensor, goal: Tensor) -> tuple[Tensor, Tensor]:
        """Where pegs (M,) get to on the way to a command (M, 7), and how far from the part they are then."""
        rules, count = self.rules, len(chosen)
        part, place = self.part[chosen], self.place[chosen].numpy().copy()
        turn = poses.rotation_matrix(part)
        target = goal[:, :3].numpy()
        normals, offsets = np.zeros((count, _PLANES, 3)), np.full((count, _PLANES), -np.inf)
        seen = np.full((count, _PLANES, 3), np.inf)
        distance = np.full(count, np.inf)
        on = np.arange(count)
        for turns in range(_ROUNDS):
            there = torch.cat([torch.from_numpy(place[on]), goal[on, 3:]], dim=1)
            gap = rules.gap(part[on], there[:, None])
            normal = (turn[on] @ gap.normal[:, 0, :, None])[..., 0].numpy()
            distance[on] = gap.distance[:, 0].numpy()
            slot = turns % _PLANES
            normals[on, slot], seen[on, slot] = normal, place[on]
            offsets[on, slot] = (normal * place[on]).sum(axis=1) - distance[on]
            moving = np.zeros(len(on), dtype=np.bool_)
            ahead = np.empty((len(on), 3))
            _stepped(
                place[on],
                target[on],
                distance[on],
                normals[on],
                offsets[on],
                seen[on],
                rules.step,
                rules.friction,
                rules.pressed,
                ahead,
                moving,
            )
            if turns == _ROUNDS - 1:
                break
            place[on[moving]] = ahead[moving]
            on = on[moving]
            if len(on) == 0:
                break
        return torch.from_numpy(place), torch.from_numpy(distance)


@compiled
def _stepped(
    place: Array,
    target: Array,
    distance: Array,
    normals: Array,
    offsets: Array,
    seen: Array,
    longest: float,
    friction: float,
    pressed: float,
    ahead: Array,
    moving: Mask,
) -> None:
    """The next step of each peg: out of the part if it is in it, else towards its target."""
    for m in range(len(place)):
        kept = np.zeros(normals.shape[1], np.bool_)
        for p in range(normals.shape[1]):
            # A plane is what the part is like near where it was seen.
            kept[p] = ((place[m] - seen[m, p]) ** 2).sum() < 4.0 * longest * longest
        if distance[m] < -_DEEP:
            ahead[m] = _nearest(place[m], normals[m], offsets[m], kept)
            moving[m] = True
            continue
        best = _nearest(target[m], normals[m], offsets[m], kept)
        step = best - place[m]
        size = np.sqrt((step * step).sum())
        if friction > 0.0 and distance[m] < _TOUCHES:
            # The command draws back to the cone's rim.
            beyond = np.sqrt(((target[m] - best) ** 2).sum())
            held = friction * min(beyond, pressed)
            left = max(0.0, size - held)
            step *= left / max(size, 1e-300)
            size = left
        if size > longest:
            step *= longest / size
            size = longest
        moving[m] = size > _STILL
        ahead[m] = place[m] + step


@compiled
def _nearest(point: Array, normals: Array, offsets: Array, kept: Mask) -> Array:
    """The point on the free side of kept planes that is nearest to a point, by trying which ones hold it."""
    count = len(offsets)
    best, least = point.copy(), np.inf
    if _violation(point, normals, offsets, kept) <= _DEEP:
        return best
    least_violation = np.inf
    for a in range(count):
        if not kept[a]:
            continue
        for b in range(a, count):
            if not kept[b]:
                continue
            for c in range(b, count):
                if not kept[c]:
                    continue
                tried, sound = _on_planes(point, normals, offsets, a, b, c)
                if not sound:
                    continue
                off = ((tried - point) ** 2).sum()
                violation = _violation(tried, normals, offsets, kept)
                if violation <= _DEEP:
                    if off < least:
                        best, least = tried, off
                elif least == np.inf and violation < least_violation:
                    best, least_violation = tried, violation
    return best


@compiled
def _violation(point: Array, normals: Array, offsets: Array, kept: Mask) -> float:
    worst = 0.0
    for p in range(len(offsets)):
        if kept[p]:
            worst = max(worst, offsets[p] - (normals[p] * point).sum())
    return worst


@compiled
def _on_planes(point: Array, normals: Array, offsets: Array, a: int, b: int, c: int) -> tuple[Array, bool]:
    """The point of up to three planes nearest to a point: projections by Gram and Schmidt."""
    chosen = (a, b, c)
    basis, values = np.zeros((3, 3)), np.zeros(3)
    rank = 0
    for k in range(3):
        if k > 0 and chosen[k] == chosen[k - 1]:
            continue
        normal = normals[chosen[k]].copy()
        value = offsets[chosen[k]]
        for r in range(rank):
            share = (normal * basis[r]).sum()
            normal -= share * basis[r]
            value -= share * values[r]
        length = np.sqrt((normal * normal).sum())
        if length < 1e-3:
            return point, False
        basis[rank], values[rank] = normal / length, value / length
        rank += 1
    found = point.copy()
    for r in range(rank):
        found += (values[r] - (basis[r] * found).sum()) * basis[r]
    return found, True


def _thickness(part: Part) -> float:
    """How thick (m) a part's thin walls are: that which a twentieth of its surface is no thicker than."""
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


def _between(first: Tensor, second: Tensor, share: float) -> Tensor:
    """Poses (N, 7) on the way from one to the other: straight, and along the geodesic."""
    if share == 1.0:
        return second
    start, stop = poses.quaternion_xyzw(first), poses.quaternion_xyzw(second)
    stop = torch.where((start * stop).sum(dim=-1, keepdim=True) < 0.0, -stop, stop)
    step = share * roma.unitquat_to_rotvec(roma.quat_product(roma.quat_conjugation(start), stop))
    turned = roma.quat_product(start, roma.rotvec_to_unitquat(step))
    return poses.from_translation_quaternion_xyzw(torch.lerp(first[:, :3], second[:, :3], share), turned)
