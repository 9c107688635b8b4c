"""Where a part is if the held peg is in its hole: poses to start from, which nothing else leads to.

A hole with a tenth of a millimetre to spare is a needle: from millimetres away no gradient points to it.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from bcppl import poses
from bcppl.distributions.manifold import MeasuresGap
from bcppl.geometry.holes import Hole, fit_in
from bcppl.geometry.parts import Part
from bcppl.sensors.capabilities import InHole

_DEEP = 0.001  # m: a peg does not lie deeper in the material
_STAYS = 0.004  # m by which the tip of a wedged peg moves in half a second, at most
_LEAST_LEAN = 0.03  # rad: a peg that leans less may be as deep as with it
_LEVEL = 1e-5  # m: vertices of the peg closer in height than this are of its tip


class HoleEntry:
    """A part's hole and the peg that goes into it.

    Args:
        gap: measures the gap between part and peg.
        peg: as it is held.
        hole: of the part.

    Raises:
        InputError: the peg does not fit the hole.
    """

    def __init__(self, gap: MeasuresGap, peg: Part, hole: Hole) -> None:
        self._gap, self._clearance, self._chamfer = gap, fit_in(hole, peg).clearance, hole.chamfer
        self._mouth = torch.from_numpy(hole.part_from_hole[None, :3])
        low = float(peg.vertices[:, 2].min())
        self._tip = torch.tensor([[0.0, 0.0, low]], dtype=torch.float64)
        foot = peg.vertices[peg.vertices[:, 2] < low + _LEVEL, :2]
        self._width = float(np.ptp(foot, axis=0).min())

    def deep(self, part: Tensor, peg: Tensor) -> InHole:
        """Poses near some (M, 7) that have the hole where pegs (R, 7) would lie deep in the material."""
        least = self._gap(part, peg).distance.min(dim=1)
        deep = least.values < -_DEEP
        part, peg = part[deep], peg[least.indices[deep]]
        turn, along = poses.rotation_matrix(part), poses.rotation_matrix(peg)[..., 2]
        across = torch.linalg.cross(turn[..., 2], along)
        sine, cosine = across.norm(dim=1, keepdim=True), (turn[..., 2] * along).sum(dim=1, keepdim=True)
        leans = torch.atan2(sine, cosine) * across / sine.clamp(min=1e-12)
        own = (turn.transpose(-1, -2) @ leans[..., None])[..., 0]
        upright = poses.retract(part, torch.cat([torch.zeros_like(own), own], dim=1))
        tip_at = poses.transform(peg, self._tip)
        off = (tip_at - poses.transform(upright, self._mouth))[:, 0]
        upright[:, :3] += off - (off * along).sum(dim=1, keepdim=True) * along
        # Mouth and tip are anywhere between the walls.
        inside = poses.transform(poses.inverse(upright), tip_at)
        at = torch.cat([self._mouth.expand(len(peg), 1, 3), inside], dim=1)
        beside = torch.eye(3, dtype=torch.float64) - along[:, :, None] * along[:, None]
        turned = poses.rotation_matrix(upright)[:, None] @ _cross(at)
        moved = beside[:, None] @ torch.cat(
            [torch.eye(3, dtype=torch.float64).expand_as(turned), -turned], dim=-1
        )
        spread = self._clearance / math.sqrt(12.0)
        return InHole(upright, (moved.transpose(-1, -2) @ moved).sum(dim=1) / spread**2)

    def stays(self, peg: Tensor) -> bool:
        """Whether the tip of pegs (R, 7), of one contact, stays where a hole may hold it."""
        tip = poses.transform(peg, self._tip)[:, 0]
        return float((tip - tip[0]).norm(dim=1).max()) < _STAYS

    def wedged(self, part: Tensor, peg: Tensor) -> Tensor:
        """Poses (M, 7), turned as some are, whose hole has the tip of a peg (7,) that leans wedged in it.

        At a depth d a peg of width w that leans by an angle takes up w cos + d sin of the hole's width: it
        wedges where that is all, and stands in the middle.
        """
        axis, up = poses.rotation_matrix(part)[..., 2], poses.rotation_matrix(peg)[:, 2]
        tip = poses.transform(peg[None], self._tip)[0, 0]
        beside = up - (axis @ up)[:, None] * axis
        sine = beside.norm(dim=1, keepdim=True)
        room = self._clearance + self._width * (1.0 - (1.0 - sine**2).clamp(min=0.0).sqrt())
        depth = self._chamfer + room / sine.clamp(min=_LEAST_LEAN)
        mouth = tip + depth * (axis + 0.5 * beside)
        moved = part.clone()
        moved[:, :3] += mouth - poses.transform(part, self._mouth)[:, 0]
        return moved


def _cross(points: Tensor) -> Tensor:
    """Matrices (..., 3, 3) whose product with a vector is the cross product of points (..., 3) with it."""
    axes = torch.eye(3, dtype=torch.float64).expand(*points.shape[:-1], 3, 3)
    return torch.linalg.cross(points[..., None, :].expand_as(axes), axes, dim=-1).transpose(-1, -2)
