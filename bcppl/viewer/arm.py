"""The arm that holds the peg, as a page draws it: the shapes of its links, and where these were in a touch.

A recording holds the peg's poses and no joint angles: the angles are those of inverse kinematics, which go on
from those of the touch before.
"""

from __future__ import annotations

import warnings

import numpy as np
import torch
import trimesh

from bcppl import poses
from bcppl.arrays import Array, Indices
from bcppl.errors import InputError
from bcppl.geometry.parts import Part
from bcppl.robot.arm_with_peg import ArmWithPeg

ROWS = 50  # of a touch, at which links are placed; the page interpolates between them
THICK, THIN = 0.035, 0.012  # radii of an arm's segments at the base and at the end, in lengths of the arm
SIDES = 12
_SHORT = 1e-4  # m: joints that are nearer to one another have no segment between them


class DrawnArm:
    """An arm, drawn.

    Attributes:
        links: the bodies of the links that are drawn, each in its link's frame and of its name: their meshes,
            or segments between the joints where these are not at hand.

    Warns:
        RuntimeWarning: the meshes cannot be read; why, and where they were searched.
    """

    def __init__(self, arm: ArmWithPeg) -> None:
        self.arm = arm
        try:
            self.links = arm.robot.parts or segments(arm)
        except InputError as error:
            warnings.warn(f"{error} Segments are drawn in their place.", RuntimeWarning, stacklevel=2)
            self.links = segments(arm)
        self._angles: Array | None = None  # at the end of the touch before

    def placed(self, world_from_peg: Array) -> tuple[Indices, Array] | None:
        """Rows (G,) of the peg's poses (R, 7), and the poses (G, K, 7) of the links then, in the world.

        None where the arm does not reach one of them.
        """
        rows = np.unique(np.linspace(0, len(world_from_peg) - 1, min(ROWS, len(world_from_peg))).astype(int))
        base = torch.as_tensor(self.arm.world_from_base)
        path = poses.compose(poses.inverse(base), torch.from_numpy(world_from_peg[rows])).numpy()
        angles = self._along(path)
        if angles is None:
            return None
        self._angles = angles[-1]
        links = self.arm.robot.base_from_links(angles, links=[part.name for part in self.links])
        return rows, np.asarray(poses.compose(base, links).numpy())

    def _along(self, base_from_peg: Array) -> Array | None:
        """Joint angles (G, J) along a path (G, 7), near those of the touch before where that is possible."""
        from bcppl.robot.inverse_kinematics import joint_paths  # which takes seconds to import

        robot, link, held, _ = self.arm
        for near in (self._angles, None):
            if near is None:
                near = joint_paths(robot, link, base_from_peg[None, :1], held)[0, 0]
            if np.isfinite(near).all():  # every pose from the same angles, in one batch
                angles = joint_paths(robot, link, base_from_peg[:, None], held, near=near)[:, 0]
                if np.isfinite(angles).all():
                    return angles
        return None


def segments(arm: ArmWithPeg) -> tuple[Part, ...]:
    """Tapered segments from each link's frame to those of its children, and to the peg's, by link."""
    robot, chain = arm.robot, [arm.link]
    while chain[0] != robot.links[0]:
        chain.insert(0, robot.joint_to(chain[0]).parent)
    ends = [robot.joint_to(link).parent_from_child[:3, 3] for link in chain[1:]]
    ends.append(np.asarray(arm.link_from_peg)[:3])
    lengths = [float(np.linalg.norm(end)) for end in ends]
    radii = np.linspace(THICK, THIN, len(chain) + 1) * sum(lengths)
    return tuple(
        _segment(link, end, radii[k], radii[k + 1])
        for k, (link, end, length) in enumerate(zip(chain, ends, lengths, strict=True))
        if length > _SHORT
    )


def _segment(name: str, end: Array, first: float, last: float) -> Part:
    """A cone's frustum from the origin to an end, of two radii."""
    around = np.linspace(0.0, 2.0 * np.pi, SIDES, endpoint=False)
    ring = np.stack([np.cos(around), np.sin(around), np.zeros(SIDES)], axis=1)
    turn = trimesh.geometry.align_vectors([0.0, 0.0, 1.0], end)[:3, :3]
    both = np.concatenate([first * ring @ turn.T, last * ring @ turn.T + end])
    hull = trimesh.convex.convex_hull(both)
    return Part(name, np.asarray(hull.vertices), np.asarray(hull.faces), source="segments of an arm")
