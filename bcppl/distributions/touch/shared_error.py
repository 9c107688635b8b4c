"""Touches with a shared error: an error of the part's pose during a whole session, integrated out.

A tracker's frame is off the part's, or a robot's base off the tracker's: by the same amount at every touch of
one session, and by another in the next. Ten touches do not average it away. To first order it adds h_k . b to
the signed distance at touch k, with b a shift in the plane and a turn about the vertical, normal about zero.
Then the thresholds of all touches are jointly normal, and each is conditioned on those before it (the
Cholesky factor of their covariance contains the conditionals): no latent value is added.

One session scatters more than another, too. All errors of a session are wider or narrower by a common factor,
log-normal about one. It is integrated out by a sum over three nodes (Gauss and Hermite): a touch has the
average of its densities at them, weighted by the session's touches before it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from bcppl import poses
from bcppl.distributions.checks import Check
from bcppl.distributions.touch.onset import OnsetLocation
from bcppl.distributions.touch.outliers import touch_check
from bcppl.distributions.touch.path import Path
from bcppl.distributions.touch.placed import Placed, distance_at

# The residual of an earlier touch is clipped at so many standard deviations.
CLIPPED = 4.0
_NODES = ((-math.sqrt(3.0), 1.0 / 6.0), (0.0, 2.0 / 3.0), (math.sqrt(3.0), 1.0 / 6.0))
_LEAST = -1e4  # nats of a touch: one that is impossible at every scale tells nothing of the scale


class SharedError:
    """The threshold of each touch of a session, given the places of those before it.

    A program adds every touch with `add`, and then conditions on its place with `condition_on`.

    Args:
        placed: the part at its poses; its z axis is taken for the vertical.
        center: (3,) in the part's frame: the centre of the turn, metres.
        shift, turn: standard deviations of the shared error: metres along each axis of the plane, radians.
        offset, spread, outlier: of each touch independently, as for `OnsetLocation`; metres.
        varying: standard deviation of the natural logarithm of the factor by which a session's errors, the
            shared one's and each touch's, are wider than stated.
    """

    __caches__ = ("_known", "_weighed")

    def __init__(
        self,
        placed: Placed,
        center: Tensor,
        shift: float,
        turn: float,
        offset: float,
        spread: float,
        outlier: float = 0.0,
        varying: float = 0.0,
    ) -> None:
        self.placed, self.center = placed, center
        self.offset, self.spread, self.outlier = offset, spread, outlier
        self.scale = torch.tensor([shift, shift, turn], dtype=torch.float64)
        nodes = _NODES if varying > 0.0 else ((0.0, 1.0),)
        self.factors = torch.tensor([math.exp(varying * x) for x, _ in nodes], dtype=torch.float64)
        self.shares = torch.tensor([share for _, share in nodes], dtype=torch.float64)
        self.paths: list[Path] = []
        self.places: list[Tensor] = []
        self._known: tuple[int, Tensor, Tensor] | None = None
        self._weighed: list[Tensor] = []

    def add(self, path: Path) -> None:
        """Add a touch along a path."""
        self.paths.append(path)

    def condition_on(self, place: Tensor) -> None:
        """Condition further touches on the place of the last, (3,) or (N, 3) in the world; NaN for never."""
        self.places.append(place)

    def threshold(self, which: int) -> tuple[Tensor, Tensor]:
        """Offset (N,) and spreads (S, N), by the session's factor, of a touch given the places before it."""
        if self._known is None or which >= self._known[0]:
            self._known = len(self.paths), *self._conditionals()
        _, mean, spread = self._known
        return self.offset - mean[:, which], self.factors[:, None] * spread[:, which]

    def log_weights(self, which: int) -> Tensor:
        """Log-probabilities (S, N) of the session's factor given the places of the touches before one."""
        if not self._weighed:
            self._weighed.append(self.shares.log()[:, None].expand(-1, len(self.placed.pose)))
        for k in range(len(self._weighed) - 1, which):
            each = self.onset(k).log_density(self.places[k], *self.threshold(k))
            self._weighed.append((self._weighed[k] + each.clamp(min=_LEAST)).log_softmax(dim=0))
        return self._weighed[which]

    def tail(self, which: int, place: Tensor) -> Tensor:
        """`OnsetLocation.tail` (N,) of a touch at a place, the session's factor given all places so far."""
        weights = self.log_weights(len(self.places)).exp()
        return (weights * self.onset(which).tail_of(place, *self.threshold(which))).sum(dim=0)

    def onset(self, which: int) -> OnsetLocation:
        """The onset of a touch by itself."""
        path = self.paths[which]
        return OnsetLocation(self.placed, self.placed.pose, path, self.offset, self.spread, self.outlier)

    def _conditionals(self) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation (N, K) of the error of the signed distance at each touch."""
        gradients = self._gradients() * self.scale
        count = len(self.paths)
        residual = gradients.new_zeros(len(gradients), count)
        touched = torch.zeros(len(gradients), count, dtype=torch.bool)
        for k, place in enumerate(self.places):
            touched[:, k] = ~torch.isnan(place).any(dim=-1)
            residual[:, k] = self._distance(place) + self.offset
        # A touch without contact, or still to come, does not inform the others.
        known = torch.where(touched[..., None], gradients, 0.0)
        marginal = (known.square().sum(-1) + self.spread**2).sqrt()
        residual = torch.where(touched, residual, 0.0).clamp(-CLIPPED * marginal, CLIPPED * marginal)
        covariance = known @ known.mT + self.spread**2 * torch.eye(count, dtype=torch.float64)
        factor = torch.linalg.cholesky(covariance)
        error = torch.linalg.solve_triangular(factor, residual[..., None], upper=False)[..., 0]
        spread = factor.diagonal(dim1=-2, dim2=-1).clone()
        mean = (factor @ error[..., None])[..., 0] - spread * error
        for k in (~touched.all(dim=0)).nonzero().flatten().tolist():
            across = known[:, :k] @ gradients[:, k, :, None]
            white = torch.linalg.solve_triangular(factor[:, :k, :k], across, upper=False)[..., 0]
            left = gradients[:, k].square().sum(-1) + self.spread**2 - white.square().sum(-1)
            mean[:, k] = torch.where(touched[:, k], mean[:, k], (white * error[:, :k]).sum(-1))
            spread[:, k] = torch.where(touched[:, k], spread[:, k], left.sqrt())
        return mean, spread

    def _gradients(self) -> Tensor:
        """Gradients (N, K, 3) of the signed distance where a path meets the part, by its shift and turn.

        They depend on pose and paths, not on the place of contact: so a touch's density integrates to one.
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
        """Signed distance (N,) at a place (3,) or (N, 3); any finite number where that is NaN."""
        pose = self.placed.pose
        if place.ndim == 1 and bool(place.isnan().any()):
            return pose.new_zeros(len(pose))
        there = torch.where(torch.isnan(place), pose[:, :3], place) if place.ndim > 1 else place
        return distance_at(self.placed, pose, there)[0]


class SharedOnset(OnsetLocation):
    """`OnsetLocation` of one touch of a session with a shared error.

    Args:
        shared: the error; this touch is the last that was added to it.
    """

    __caches__ = ("shared",)

    def __init__(self, shared: SharedError) -> None:
        self.shared, self.which = shared, len(shared.paths) - 1
        # Later touches of the session do not change it.
        self.given = shared.center, shared.scale, shared.factors, tuple(shared.paths), tuple(shared.places)
        placed, path = shared.placed, shared.paths[-1]
        super().__init__(placed, placed.pose, path, shared.offset, shared.spread, shared.outlier)

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-density (N,) of one location (3,), or of one for each particle (N, 3)."""
        each = self.log_density(value, *self.shared.threshold(self.which))
        return (self.shared.log_weights(self.which) + each).logsumexp(dim=0)

    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        """Locations of first contact (N, 3), interpolated between the path's points; NaN for never."""
        offset, spread = self.shared.threshold(self.which)
        own = torch.multinomial(self.shared.log_weights(self.which).exp().T, 1)
        return self._sample(offset, spread.T.gather(1, own)[:, 0])

    def tail(self, value: Tensor) -> Tensor:
        """As of `OnsetLocation`, given the session's other touches."""
        return self.shared.tail(self.which, value)

    def predictive_check(self, value: Tensor, replicas: Callable[[], Any]) -> Check:
        """The check of an onset beside the session's others: how many are as far off."""
        places = self.shared.places
        others = [self.shared.tail(k, place) for k, place in enumerate(places) if k != self.which]
        return touch_check(self.tail(value), self.outlier, torch.stack(others, 1) if others else None)
