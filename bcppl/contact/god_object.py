"""How a compliantly held peg moves past a part without physics: it follows its command until it is blocked.

The god-object, or virtual proxy, of haptics: C. Zilles and J. Salisbury, A constraint-based god-object method
for haptic display, IROS 1995; friction by W. Harwin and N. Melder, Improved haptic rendering for multi-finger
manipulation using friction cone based god-objects, Eurohaptics 2002. What a robot presses slowly through a
spring stands where the spring would be shortest: at its command where that is free, else as near to it as the
part allows.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import torch
import trimesh
from torch import Tensor

from bcppl import poses, quaternions
from bcppl.arguments import number_within
from bcppl.compiled import compiled
from bcppl.contact.peg_model import commands
from bcppl.contact.tangent_planes import nearest_allowed
from bcppl.errors import InputError
from bcppl.geometry.gap import Frames, PegGap, frames_of
from bcppl.geometry.parts import Part
from bcppl.robot.motion import ProbeWindow

Array = npt.NDArray[np.float64]
Numbers = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]

_LONGEST = 0.001  # m: of a step
_SHORTEST = 0.0001
_THIN = 0.4  # of the thinnest wall: a longer step might come out on its other side
_TOUCHES = 2e-7  # m: nearer than this it touches
_STILL = 1e-7  # m: a step shorter than this is none, a fifth of it no depth
_ROUGH = 1e-5  # m: after so many
_PATIENT = 10
_ROUNDS = 40  # steps that a blocked peg may take towards one command
_REFUTED = 1e-6  # m
_LIKE = 0.99999  # a cosine; planes leant no more than this are one
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


class WindowMotion:
    """Where a peg gets to in a window of a probe, at every so many of its stamps.

    The whole way up to there is followed, from the probe's first stamp on, by a command that nothing stops.
    """

    def __init__(self, proxy: GodObject, window: ProbeWindow, every: int) -> None:
        self.proxy, self.window, self.every = proxy, window, every

    def __call__(self, world_from_part: Tensor) -> Tensor:
        """(N, T, 8), as the god-object gives it, for poses (N, 7) of the part."""
        return self.together([self], [world_from_part])[0]

    @property
    def command(self) -> Tensor:
        """(S, 7) from the probe's beginning to the window's end."""
        probe, first = self.window.probe, self.window.first % self.every
        return torch.from_numpy(commands(probe, probe.stamps[first : self.window.last : self.every])[0])

    @staticmethod
    def together(motions: Sequence[WindowMotion], world_from_part: Sequence[Tensor]) -> list[Tensor]:
        """The motions for poses (N_k, 7) each, (N_k, T_k, 8), those of one god-object in one batch."""
        found: dict[int, Tensor] = {}
        ways = [motion.command for motion in motions]
        for proxy in {id(motion.proxy): motion.proxy for motion in motions}.values():
            own = [k for k, motion in enumerate(motions) if motion.proxy is proxy]
            longest = max(len(ways[k]) for k in own)
            # A command that has ended is held.
            padded = [torch.cat([ways[k], ways[k][-1:].expand(longest - len(ways[k]), 7)]) for k in own]
            counts = [len(world_from_part[k]) for k in own]
            command = torch.stack(padded).repeat_interleave(torch.tensor(counts), dim=0)
            rows = proxy(torch.cat([world_from_part[k] for k in own]), command)
            for k, row in zip(own, rows.split(counts), strict=True):
                first = motions[k].window.first // motions[k].every
                found[k] = row[:, first : len(ways[k])]
        return [found[k] for k in range(len(motions))]


class _Motion:
    """Pegs of N particles on their way."""

    def __init__(self, rules: GodObject, world_from_part: Tensor, command: Tensor) -> None:
        self.rules, self.part, self.command = rules, frames_of(world_from_part), command
        self.away = rules.clearance(world_from_part, command)
        self.place = command[:, 0, :3].clone()
        self.blocked = torch.ones(len(command), dtype=torch.bool)  # or not yet known not to be
        self.slack = torch.zeros(len(command), dtype=torch.float64)

    def followed(self) -> Tensor:
        rules, command = self.rules, self.command
        away = self.away
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
        on = chosen.numpy()
        part = Frames(self.part.rotation[on], self.part.translation[on])
        turn = frames_of(goal).rotation
        place, target = self.place[chosen].numpy().copy(), goal[:, :3].numpy()
        normals, offsets = np.zeros((count, _PLANES, 3)), np.zeros((count, _PLANES))
        seen = np.full((count, _PLANES, 3), np.inf)
        distance = np.full(count, np.inf)
        moving = np.arange(count)
        for rounds in range(_ROUNDS):
            peg = Frames(turn[moving, None], place[moving, None])
            found, _, normal = rules.gap.evaluate(Frames(*(each[moving] for each in part)), peg)
            distance[moving] = found[:, 0]
            stays = np.zeros(len(moving), dtype=np.bool_)
            _stepped(
                moving,
                place,
                target,
                found[:, 0],
                np.einsum("nij,nj->ni", part.rotation[moving], normal[:, 0]),
                normals,
                offsets,
                seen,
                rules.step,
                rules.friction,
                rules.pressed,
                _STILL if rounds < _PATIENT else _ROUGH,
                stays,
            )
            moving = moving[~stays]
            if len(moving) == 0:
                break
        return torch.from_numpy(place), torch.from_numpy(distance)


@compiled
def _stepped(
    moving: Numbers,
    place: Array,
    target: Array,
    distance: Array,
    normal: Array,
    normals: Array,
    offsets: Array,
    seen: Array,
    longest: float,
    friction: float,
    pressed: float,
    still: float,
    stays: Mask,
) -> None:
    """The next step of each moving peg: out of the part if it is in it, else towards its target."""
    planes = normals.shape[1]
    kept = np.zeros(planes, np.bool_)
    for k in range(len(moving)):
        m, slot, least, same = moving[k], 0, np.inf, False
        for p in range(planes):
            # A plane is what the part is like near where it was seen; a gap wider than it allows refutes it.
            kept[p] = ((place[m] - seen[m, p]) ** 2).sum() < 4.0 * longest * longest
            kept[p] &= (normals[m, p] * place[m]).sum() - offsets[m, p] > distance[k] - _REFUTED
            # The newest takes the place of one like it, of one out of date, or of the least tight.
            tight = -np.inf
            if kept[p]:
                tight = offsets[m, p] - (normals[m, p] * place[m]).sum()
                if (normals[m, p] * normal[k]).sum() > _LIKE:
                    slot, same = p, True
            if not same and tight < least:
                slot, least = p, tight
        normals[m, slot], seen[m, slot], kept[slot] = normal[k], place[m], True
        offsets[m, slot] = (normal[k] * place[m]).sum() - distance[k]
        inside = distance[k] < -0.2 * still
        best = nearest_allowed(place[m] if inside else target[m], normals[m], offsets[m], kept)
        step = best - place[m]
        size = np.sqrt((step * step).sum())
        if not inside and friction > 0.0 and distance[k] < _TOUCHES:
            # The command draws the peg no farther than the cone's rim.
            held = friction * min(np.sqrt(((target[m] - best) ** 2).sum()), pressed)
            step *= max(0.0, size - held) / max(size, 1e-300)
            size = max(0.0, size - held)
        if not inside and size > longest:
            step *= longest / size
        stays[k] = not inside and size <= still
        if not stays[k]:
            place[m] += step


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
    place = torch.lerp(first[:, :3], second[:, :3], share)
    if torch.equal(first[:, 3:], second[:, 3:]):
        return torch.cat([place, first[:, 3:]], dim=1)
    start, stop = poses.quaternion_xyzw(first), poses.quaternion_xyzw(second)
    stop = torch.where((start * stop).sum(dim=-1, keepdim=True) < 0.0, -stop, stop)
    step = share * quaternions.rotation_vector(quaternions.product(quaternions.conjugate(start), stop))
    turned = quaternions.product(start, quaternions.from_rotation_vector(step))
    return poses.from_translation_quaternion_xyzw(place, turned)
