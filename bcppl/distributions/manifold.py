"""The contact manifold: where a peg stood while it felt something has no gap to the part, elsewhere one."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import torch
from scipy.special import bdtrc
from torch import Tensor
from torch.special import log_ndtr

from bcppl.distributions.checks import Check, chi_square
from bcppl.distributions.lazy import LazyDistribution
from bcppl.distributions.parameters import COUNT, NONNEGATIVE, POSITIVE, PROBABILITY
from bcppl.errors import InputError

_FAR = 4.0  # standard deviations
FARTHEST = 0.02  # m: the range over which an outlier's gap is spread evenly


class Gaps(Protocol):
    """What `bcppl.geometry.gap.PegGap` gives."""

    @property
    def distance(self) -> Tensor:
        """(N, T) metres."""

    def gradient(self, world_from_part: Tensor) -> Tensor:
        """(N, T, 6) its derivatives in the tangent space at the part's poses."""


class MeasuresGap(Protocol):
    """`bcppl.geometry.gap.PegGap`, or another that measures gaps at poses (N, 7) and (T, 7) or (N, T, 7)."""

    def __call__(self, world_from_part: Tensor, world_from_peg: Tensor) -> Gaps: ...  # noqa: D102


class Quadratic(NamedTuple):
    """A log-likelihood to second order around poses, in their tangent space.

    Attributes:
        gradient: (N, 6) of minus the log-likelihood, 1/m and 1/rad.
        information: (N, 6, 6) the Gauss-Newton approximation of its Hessian.
    """

    gradient: Tensor
    information: Tensor


@dataclass(eq=False, repr=False)
class ContactManifold(LazyDistribution):
    """Where a held peg was measured to be, and whether it felt the part, over a window of T stamps.

    With d the gap between the peg as measured and the part, a stamp with contact has d normal about
    `-sink`, one without has the probability that a gap about d is positive: Phi(d / spread). Errors of d are
    `noise`, independent at each stamp, and `shared`, the same for all stamps of a window at which there is
    contact: unknown stiffness of the contact and unknown geometry. With probability `outlier` a stamp, or
    all contacts of the window together, have nothing to do with the part.

    As a density over the peg's poses it is normalised but for a constant: on the manifold of contact the peg
    may be anywhere with equal chance, and off it anywhere that is free. Moving the part moves both along, so
    the constant does not depend on the part's pose (the manifold particle filter of Koval, Pollard and
    Srinivasa, Pose estimation for planar contact manipulation with manifold particle filters, IJRR 34, 2015,
    has the same likelihood). It is a likelihood of the pose of the part, given where the peg got to, and no
    prediction of where it will get to: it has a `sample` only where it is given a `motion` that is one.

    The event is (T, 8): the measured world_from_peg, then 1 where contact is felt, 0 where there is none, and
    NaN where that is undecided.

    Args:
        gap: measures gaps.
        pose: (N, 7) world_from_part.
        stamps: T.
        noise: m, of the gap at one stamp: the measured peg's position, and its turn times the peg's length.
        shared: m, of the gap, common to a window's contacts.
        sink: m that a peg sinks into the part at the forces of a probe.
        outlier: a probability.
        motion: where pegs get to, and whether they touch, (N, T, 8) for poses (N, 7) of the part; asked for
            samples only. Such is `bcppl.contact.quasi_static.QuasiStaticMotion`, along a command.
    """

    cost = 1

    gap: MeasuresGap
    pose: Tensor
    stamps: int = field(metadata=COUNT)
    noise: float = field(metadata=POSITIVE)
    shared: float = field(metadata=NONNEGATIVE)
    sink: float = field(default=0.0, metadata=NONNEGATIVE)
    outlier: float = field(default=0.001, metadata=PROBABILITY)
    motion: Callable[[Tensor], Tensor] | None = None

    def __post_init__(self) -> None:
        super().__init__(len(self.pose), (self.stamps, 8))

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-likelihood (N,) of one window (T, 8), or of one for each particle (N, T, 8)."""
        distance, felt, lost, _ = self._measured(value)
        log_prob = self._of_contacts(distance, felt == 1.0) + self._of_free(distance, felt == 0.0)
        return torch.where(lost, torch.nan, log_prob)

    def quadratic(self, value: Tensor) -> Quadratic:
        """The log-likelihood of a window (T, 8), or of one for each particle (N, T, 8), to second order.

        Stamps with contact that are off by many standard deviations count for little.
        """
        distance, felt, lost, gaps = self._measured(value)
        count = len(self.pose)
        if gaps is None:
            return Quadratic(self.pose.new_zeros(count, 6), self.pose.new_zeros(count, 6, 6))
        pull, information = self._second_order(distance, felt, gaps.gradient(self.pose))
        return Quadratic(
            torch.where(lost[:, None], torch.nan, pull),
            torch.where(lost[:, None, None], torch.nan, information),
        )

    def residual(self, value: Tensor) -> Tensor:
        """Gaps (N, T) that contradict the contact signal, metres; 0 where free, NaN where it is undecided.

        At contact the gap and the sink, elsewhere how deep the peg would have been in the part.
        """
        stood, felt = value[..., :7], value[..., 7]
        distance = self.gap(self.pose, stood).distance
        residual = torch.where(felt == 1.0, distance + self.sink, distance.clamp(max=0.0))
        return torch.where(torch.isnan(felt), torch.nan, residual)

    def predictive_check(self, value: Tensor, replicas: Callable[[], Any]) -> Check | None:
        """The check of a window (T, 8) at P particles (`bcppl.distributions.checks.Checked`).

        Squared residuals of the contacts, whitened by the noise and the shared error, against chi-square; the
        number of stamps without contact that lie four standard deviations deep in the part against the number
        of outliers. The smaller of the two p values, doubled; None where contact is undecided throughout.
        """
        if not bool((value[:, 7] == value[:, 7]).any()):
            return None
        residual, felt = self.residual(value), value[:, 7]
        contact, free = residual[:, felt == 1.0], residual[:, felt == 0.0]
        variance, common, count = self.noise**2, self.shared**2, contact.shape[1]
        share = common / (variance + count * common)
        squared = (contact.square().sum(dim=1) - share * contact.sum(dim=1).square()) / variance
        whole = chi_square(squared, count, "contacts") if count else Check(1.0, "contacts", 0.0)
        deep = (free < -_FAR * math.hypot(self.noise, self.shared)).sum(dim=1)
        outliers = float(bdtrc(deep.numpy() - 1, free.shape[1], self.outlier).mean())
        return Check(min(1.0, 2.0 * min(whole.probability, outliers)), "contacts", whole.excess)

    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        """Where pegs get to by `motion`, with errors, (N, T, 8); none is an outlier.

        Where a peg touches it sinks in along the contact's normal, and its place there has the common error;
        every stamp's place has `noise` along each axis.

        Raises:
            InputError: no motion was given.
        """
        if self.motion is None:
            raise InputError(
                "ContactManifold is a likelihood of the part's pose and predicts no place of a peg; give a "
                "`motion`, such as bcppl.contact.quasi_static.WindowMotion, or simulate the probe with "
                "bcppl.contact.probe_rollout.ProbeRollout."
            )
        return self._with_errors(self.motion(self.pose))

    @staticmethod
    def samples(sites: Sequence[ContactManifold]) -> list[Tensor]:
        """A sample of each of several, their motions all in one batch where they can be run together.

        All have the same noise, as far as they have as many stamps, so that they are compared by what differs
        between them; torch's generator is left as one of them leaves it. Each is as long as its motion, and
        has as many columns as that predicts.
        """
        kinds = {type(site.motion) for site in sites}
        together = getattr(next(iter(kinds)), "together", None) if len(kinds) == 1 else None
        moved: Sequence[Tensor | None] = [None] * len(sites)
        if together is not None:
            moved = together([site.motion for site in sites], [site.pose for site in sites])
        state, drawn = torch.get_rng_state(), []
        for site, rows in zip(sites, moved, strict=True):
            torch.set_rng_state(state)
            drawn.append(site.sample() if rows is None else site._with_errors(rows))
        return drawn

    def _with_errors(self, rows: Tensor) -> Tensor:
        shared = self.shared * torch.randn(len(rows), 1, 1, dtype=torch.float64)
        noise = self.noise * torch.randn(*rows.shape[:2], 3, dtype=torch.float64)
        sound = torch.isfinite(rows).all(dim=2).all(dim=1)
        shift = torch.full_like(noise, torch.nan)
        pose, drawn = self.pose[sound], rows[sound]
        normal = -self.gap(pose, drawn[..., :7]).gradient(pose)[..., :3]
        touching = (drawn[..., 7:] == 1.0).to(torch.float64)
        shift[sound] = noise[sound] + touching * normal * (shared[sound] - self.sink)
        return torch.cat([rows[..., :3] + shift, rows[..., 3:]], dim=-1)

    def _measured(self, value: Tensor) -> tuple[Tensor, Tensor, Tensor, Gaps | None]:
        """Distances and contact signals (N, S), which particles' observations are lost, and the gaps."""
        stood, felt = value[..., :7], value[..., 7]
        count = len(self.pose)
        lost = torch.zeros(count, dtype=torch.bool)
        if value.ndim == 3:  # a simulation that failed
            lost = torch.isnan(stood).any(dim=2).any(dim=1)
            stood = torch.where(lost[:, None, None], self.pose[:, None], stood)
        decided = ~torch.isnan(felt).reshape(-1, felt.shape[-1]).all(dim=0)
        if not bool(decided.any()):
            none = torch.zeros(count, 0, dtype=torch.float64)
            return none, none, lost, None
        gaps = self.gap(self.pose, stood[..., decided, :])
        return gaps.distance, felt[..., decided].expand(count, -1), lost, gaps

    def _second_order(self, distance: Tensor, felt: Tensor, slope: Tensor) -> tuple[Tensor, Tensor]:
        """Gradient (N, C) of minus the log-likelihood and information (N, C, C), by what moves the gaps.

        Gaps and contact signals are (N, S), their derivatives by C parameters (N, S, C).
        """
        touching = (felt == 1.0).to(torch.float64)
        # The common error takes the mean of a window's contacts part of its weight.
        variance, common = self.noise**2, self.shared**2
        share = (common / (variance + touching.sum(dim=1) * common))[:, None, None]
        # What is far off, seen as wide as the errors are taken to be, hardly pulls.
        error = distance + self.sink
        trust = (touching / (1.0 + error**2 / (_FAR**2 * (variance + common)))).sqrt()
        rows, error = slope * trust[..., None], error * trust
        weighed = (rows - share * rows.sum(dim=1, keepdim=True)) / variance
        pull = (weighed * error[..., None]).sum(dim=1)
        information = weighed.transpose(-1, -2) @ rows
        spread = math.hypot(self.noise, self.shared)
        score, free = distance / spread, slope / spread
        hazard = torch.exp(-0.5 * score**2 - 0.5 * math.log(2.0 * math.pi) - log_ndtr(score))
        hazard = torch.where(felt == 0.0, hazard, 0.0)
        pull = pull - (hazard[..., None] * free).sum(dim=1)
        bend = (hazard * (hazard + score)).clamp(min=0.0)
        information = information + free.transpose(-1, -2) @ (bend[..., None] * free)
        return pull, information

    def _of_contacts(self, distance: Tensor, touching: Tensor) -> Tensor:
        count = touching.sum(dim=1, dtype=torch.float64)
        error = torch.where(touching, distance + self.sink, 0.0)
        variance, common = self.noise**2, self.shared**2
        whole = variance + count * common
        squared = ((error**2).sum(dim=1) - common / whole * error.sum(dim=1) ** 2) / variance
        size = (count - 1) * math.log(variance) + torch.log(whole)
        inlier = -0.5 * (squared + size + count * math.log(2.0 * math.pi)) + math.log1p(-self.outlier)
        stray = math.log(self.outlier) - count * math.log(FARTHEST)
        return torch.where(count > 0, torch.logaddexp(inlier, stray), 0.0)

    def _of_free(self, distance: Tensor, free: Tensor) -> Tensor:
        score = distance / math.hypot(self.noise, self.shared)
        inlier = log_ndtr(score) + math.log1p(-self.outlier)
        either = torch.logaddexp(inlier, torch.full_like(inlier, math.log(self.outlier)))
        return torch.where(free, either, 0.0).sum(dim=1)
