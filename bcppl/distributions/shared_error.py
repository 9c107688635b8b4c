"""Touches that err together: an error of the part's pose that a whole session shares, integrated out.

A tracker's frame lies beside the part, or a robot's base beside the tracker's: by the same amount at every
touch of one session, and by another in the next. Ten touches do not average it away. To first order it adds
h_k . b to the signed distance at touch k, with b a shift in the plane and a turn about the vertical, normal
about zero. Then the thresholds of all touches are jointly normal, and each is conditioned on those before it
(the Cholesky factor of their covariance holds the conditionals): no latent value is added.
"""

from __future__ import annotations

import torch
from torch import Tensor

from bcppl import poses
from bcppl.distributions.path import Path
from bcppl.distributions.touch import OnsetLocation, Placed

# An earlier touch that lies further off than this many standard deviations counts as if it lay there.
CLIPPED = 4.0


class SharedError:
    """The threshold of each touch of a session, given what was felt before.

    A program adds every touch by `expect`, and says by `felt` where it was felt.

    Args:
        placed: the part at its poses; its z axis is taken for the vertical.
        center: (3,) in the part's frame: about which it is turned, metres.
        shift, turn: standard deviations of the shared error: metres along each axis of the plane, radians.
        offset, spread: of one touch by itself, as `OnsetLocation` has them, metres.
    """

    __caches__ = ("_known",)

    def __init__(
        self, placed: Placed, center: Tensor, shift: float, turn: float, offset: float, spread: float
    ) -> None:
        self.placed, self.center, self.offset, self.spread = placed, center, offset, spread
        self.scale = torch.tensor([shift, shift, turn], dtype=torch.float64)
        self.paths: list[Path] = []
        self.places: list[Tensor] = []
        self._known: tuple[int, Tensor, Tensor] | None = None

    def expect(self, path: Path) -> int:
        """A touch along a path; gives its number."""
        self.paths.append(path)
        return len(self.paths) - 1

    def felt(self, place: Tensor) -> None:
        """Where the last touch was felt, (3,) or (N, 3) in the world; NaN for never."""
        self.places.append(place)

    def threshold(self, which: int) -> tuple[Tensor, Tensor]:
        """Offset and spread (N,) of a touch, given where those before it were felt."""
        if self._known is None or which >= self._known[0]:
            self._known = len(self.paths), *self._conditionals()
        _, mean, spread = self._known
        return self.offset - mean[:, which], spread[:, which]

    def _conditionals(self) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation (N, K) of what is added to the signed distance at each touch."""
        slopes = self._slopes() * self.scale
        count = len(self.paths)
        depth = slopes.new_zeros(len(slopes), count)
        told = torch.zeros(len(slopes), count, dtype=torch.bool)
        for k, place in enumerate(self.places):
            told[:, k] = ~torch.isnan(place).any(dim=-1)
            depth[:, k] = self._distance(place) + self.offset
        # What was never felt, or not yet, tells nothing of the others.
        seen = torch.where(told[..., None], slopes, 0.0)
        alone = (seen.square().sum(-1) + self.spread**2).sqrt()
        depth = torch.where(told, depth, 0.0).clamp(-CLIPPED * alone, CLIPPED * alone)
        covariance = seen @ seen.mT + self.spread**2 * torch.eye(count, dtype=torch.float64)
        factor = torch.linalg.cholesky(covariance)
        error = torch.linalg.solve_triangular(factor, depth[..., None], upper=False)[..., 0]
        spread = factor.diagonal(dim1=-2, dim2=-1).clone()
        mean = (factor @ error[..., None])[..., 0] - spread * error
        for k in (~told.all(dim=0)).nonzero().flatten().tolist():
            across = (seen[:, :k] @ slopes[:, k, :, None]) if k else slopes.new_zeros(len(slopes), 0, 1)
            known = torch.linalg.solve_triangular(factor[:, :k, :k], across, upper=False)[..., 0]
            left = slopes[:, k].square().sum(-1) + self.spread**2 - known.square().sum(-1)
            mean[:, k] = torch.where(told[:, k], mean[:, k], (known * error[:, :k]).sum(-1))
            spread[:, k] = torch.where(told[:, k], spread[:, k], left.sqrt())
        return mean, spread

    def _slopes(self) -> Tensor:
        """What a shift and a turn of the part change in the signed distance (N, K, 3) where a path meets it.

        They hang on pose and paths, not on where a touch is felt: so a touch's density integrates to one.
        """
        each = torch.arange(len(self.placed.pose))
        normals, points = [], []
        for path in self.paths:
            distance, normal = self.placed.near(path.points)
            meets = distance.abs().argmin(dim=-1)
            normals.append(normal[each, meets])
            points.append(path.points[meets])
        normal = torch.stack(normals, dim=1)
        arm = torch.stack(points, dim=1) - poses.transform(self.placed.pose, self.center[None])
        turning = normal[..., 1] * arm[..., 0] - normal[..., 0] * arm[..., 1]
        return -torch.stack([normal[..., 0], normal[..., 1], turning], dim=-1)

    def _distance(self, place: Tensor) -> Tensor:
        """Signed distance (N,) at a place (3,) or (N, 3) where it is known, else anything finite."""
        if place.ndim == 1:
            if bool(place.isnan().any()):
                return self.placed.pose.new_zeros(len(self.placed.pose))
            return self.placed.near(place[None])[0][:, 0]
        there = torch.where(torch.isnan(place), self.placed.pose[:, :3], place)
        pose = self.placed.pose
        distance: Tensor = self.placed.distance(
            poses.transform(poses.inverse(pose), there[:, None])[:, 0]
        ).distance
        return distance


class SharedOnset(OnsetLocation):
    """`OnsetLocation` of one touch of a session whose touches err together.

    Args:
        shared: what they share; this touch is the last one that it expects.
        outlier: probability of an onset that has nothing to do with the part.
    """

    __caches__ = ("shared",)

    def __init__(self, shared: SharedError, outlier: float) -> None:
        self.shared, self.which = shared, len(shared.paths) - 1
        # What it shares with later touches does not change it.
        self.given = shared.center, shared.scale, tuple(shared.paths), tuple(shared.places)
        placed, path = shared.placed, shared.paths[-1]
        super().__init__(placed, placed.pose, path, shared.offset, shared.spread, outlier)

    def threshold(self) -> tuple[Tensor, Tensor]:
        """Offset and spread (N,) of this touch, given where those before it were felt, metres."""
        return self.shared.threshold(self.which)
