"""Contacts of a probe by episodes: errors that last, an unknown compliance, and rows already used."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, NamedTuple

import torch
from scipy.special import bdtrc
from torch import Tensor
from torch.special import log_ndtr

from bcppl.distributions.checks import Check, chi_square
from bcppl.distributions.manifold import FARTHEST, ContactManifold, Quadratic
from bcppl.distributions.parameters import NONNEGATIVE, POSITIVE

_FAR = 4.0  # standard deviations
# Columns of a row: the peg's pose, then these.
FELT, NOISE, FORCE, TIME, EPISODE, GIVEN = range(7, 13)
COLUMNS = 13
_LOG_TWO_PI = math.log(2.0 * math.pi)
# Nodes of the compliance, in decades from its median: they are closer than `varying` is wide.
_DECADES = torch.linspace(-1.25, 1.25, 11, dtype=torch.float64)
_RIDGE = 1.0  # 1/m^2 and 1/rad^2: far less than any touch informs
_LEAST = 0.1  # of a contact's information that an unknown compliance leaves


class _Errors(NamedTuple):
    """Those of `ContactEpisodes` on which the covariances depend."""

    blur: float
    shared: float
    drift: float
    lasting: float
    compliance: float
    varying: float
    rough: float


class _Blocks(NamedTuple):
    """The contact rows of a value by episode: E episodes of at most n rows."""

    rows: Tensor  # (E, n) indices into the decided rows
    used: Tensor  # (E, n)
    nodes: Tensor  # (K,) compliances, m/N
    force: Tensor  # (E, n) 0 where unused
    factor: Tensor  # (K, E, n, n) Cholesky factors of the covariances; the identity where unused

    def residual(self, distance: Tensor) -> Tensor:
        """Errors (K, E, n, N) of distances (N, S)."""
        error = torch.where(self.used, distance[:, self.rows], 0.0).permute(1, 2, 0)
        return error + (self.nodes[:, None, None] * self.force)[..., None]

    def whitened(self, error: Tensor) -> Tensor:
        """Errors (K, E, n, X) times the inverse of the Cholesky factors."""
        return torch.linalg.solve_triangular(self.factor, error, upper=False)


@dataclass(eq=False, repr=False)
class ContactEpisodes(ContactManifold):
    """Where a held peg was measured to be, and whether it felt the part, over the rows of a window.

    A row is the mean of stamps that hardly differ, or one stamp. In an episode, which is an uninterrupted
    contact, the gap at row i of force F_i is normal with mean -c F_i, and its errors have the covariance

        (noise_i^2 + (0.2 c F_i)^2) [i = j] + drift^2 exp(-|t_i - t_j| / lasting) + shared^2
        + (varying c)^2 F_i F_j:

    noise of the rows, a stationary Ornstein-Uhlenbeck process in time, the unknown geometry, and a compliance
    that differs from contact to contact by a factor. The compliance c of part and peg is common to a probe
    and log-normal; it is integrated out by a sum over nodes. So a row adds what it adds whatever the rate,
    and the product of the windows' likelihoods does not depend on how the probe is cut into them: a row that
    an earlier window has used is in the value again, marked as given, and the log-likelihood is that of all
    rows minus that of the given ones.

    A row without contact has the probability that a gap about d is positive, as in `ContactManifold`; an
    episode is an outlier as a whole.

    The event is (T, 13): world_from_peg; 1 with contact, 0 without, NaN for a row that is not used; noise (m)
    of the row; force (N); time (s); the number of the episode; 1 for a given row. Where `motion` predicts the
    rows there are no forces and times: these are NaN, and the rows are distributed as in `ContactManifold`.

    Args:
        drift: standard deviation of the errors that last, m.
        lasting: the time after which they are forgotten, s.
        compliance: median, m/N.
        uncertain: standard deviation of its decimal logarithm.
        varying: standard deviation of a contact's compliance, as a share of the probe's.
        rough: the same of a row's.
        blur: m by which the errors of rows are taken to be wider.
    """

    drift: float = field(default=0.00002, metadata=NONNEGATIVE)
    lasting: float = field(default=0.1, metadata=POSITIVE)
    compliance: float = field(default=0.000005, metadata=POSITIVE)
    uncertain: float = field(default=0.5, metadata=POSITIVE)
    varying: float = field(default=0.6, metadata=NONNEGATIVE)
    rough: float = field(default=0.2, metadata=NONNEGATIVE)
    blur: float = field(default=0.0, metadata=NONNEGATIVE)

    def __post_init__(self) -> None:
        super(ContactManifold, self).__init__(len(self.pose), (self.stamps, COLUMNS))

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-likelihood (N,) of one window (T, 13), or of one for each particle (N, T, 13)."""
        if is_predicted(value):
            return super().log_prob(value[..., : FELT + 1])
        rows = value[~torch.isnan(value[:, FELT])]
        new = rows[:, GIVEN] != 1.0
        if not bool(new.any()):
            return self.pose.new_zeros(len(self.pose))
        distance = self.gap(self.pose, rows[:, :7]).distance
        log_prob = self._of_rows_without_contact(distance, rows)
        contact = rows[:, FELT] == 1.0
        if bool((contact & new).any()):
            log_prob = log_prob + self._of_episodes(distance, rows, contact)
            if not bool(new.all()):
                log_prob = log_prob - self._of_episodes(distance, rows, contact & ~new)
        return log_prob

    def quadratic(self, value: Tensor) -> Quadratic:
        """The log-likelihood of a window to second order; contacts that are far off count for little."""
        if is_predicted(value):
            return super().quadratic(value[..., : FELT + 1])
        rows = value[~torch.isnan(value[:, FELT])]
        count, contact, given = len(self.pose), rows[:, FELT] == 1.0, rows[:, GIVEN] == 1.0
        pull, information = self.pose.new_zeros(count, 6), self.pose.new_zeros(count, 6, 6)
        if len(rows) == 0:
            return Quadratic(pull, information)
        gaps = self.gap(self.pose, rows[:, :7])
        gradient = gaps.gradient(self.pose)
        for sign, used in ((1.0, contact), (-1.0, contact & given)):
            if bool(used.any()):
                own = self._quadratic_of_episodes(gaps.distance, gradient, rows, used)
                pull, information = pull + sign * own.gradient, information + sign * own.information
        free = (rows[:, FELT] == 0.0) & ~given
        if bool(free.any()):
            spread = self._spread(rows[free])
            score, slope = gaps.distance[:, free] / spread, gradient[:, free] / spread[:, None]
            hazard = torch.exp(-0.5 * score**2 - 0.5 * _LOG_TWO_PI - log_ndtr(score))
            bend = (hazard * (hazard + score)).clamp(min=0.0)
            pull = pull - (hazard[..., None] * slope).sum(dim=1)
            information = information + slope.transpose(-1, -2) @ (bend[..., None] * slope)
        return Quadratic(pull, information)

    def residual(self, value: Tensor) -> Tensor:
        """Gaps (N, T) that contradict the contact signal, as of `ContactManifold`; 0 for given rows."""
        if is_predicted(value):
            return super().residual(value[..., : FELT + 1])
        stood, felt = value[:, :7].clone(), value[:, FELT]
        stood[torch.isnan(felt)] = self.pose[0]
        distance = self.gap(self.pose, stood).distance
        contact = distance + self.compliance * torch.nan_to_num(value[:, FORCE])
        residual = torch.where(felt == 1.0, contact, distance.clamp(max=0.0))
        residual = torch.where(value[:, GIVEN] == 1.0, 0.0, residual)
        return torch.where(torch.isnan(felt), torch.nan, residual)

    def predictive_check(self, value: Tensor, replicas: Callable[[], Any]) -> Check | None:
        """The check of a window at P particles, as of `ContactManifold`, the compliance by its posterior."""
        if is_predicted(value):
            return super().predictive_check(value[..., : FELT + 1], replicas)
        rows = value[~torch.isnan(value[:, FELT])]
        new = rows[:, GIVEN] != 1.0
        if not bool(new.any()):
            return None
        contact, distance = rows[:, FELT] == 1.0, self.gap(self.pose, rows[:, :7]).distance
        whole, count = Check(1.0, "contacts", 0.0), int((contact & new).sum())
        if count:
            every = self._blocks(rows, contact)
            inlier, stray = self._inliers(every, every.residual(distance))
            either = torch.logaddexp(inlier, stray[:, None].expand_as(inlier))
            weights = (self._log_weights()[:, None] + either.sum(dim=1)).softmax(dim=0)
            squared = every.whitened(every.residual(distance)).square().sum(dim=(1, 2))
            if bool((contact & ~new).any()):
                old = self._blocks(rows, contact & ~new)
                squared = squared - old.whitened(old.residual(distance)).square().sum(dim=(1, 2))
            whole = chi_square((weights * squared).sum(dim=0), count, "contacts")
        free = (rows[:, FELT] == 0.0) & new
        deep = (distance[:, free] < -_FAR * self._spread(rows[free])).sum(dim=1)
        outliers = float(bdtrc(deep.numpy() - 1, int(free.sum()), self.outlier).mean())
        return Check(min(1.0, 2.0 * min(whole.probability, outliers)), "contacts", whole.excess)

    def _with_errors(self, rows: Tensor) -> Tensor:
        return padded(super()._with_errors(rows), self.stamps)

    def _spread(self, rows: Tensor) -> Tensor:
        return (rows[:, NOISE] ** 2 + self.blur**2 + self.drift**2 + self.shared**2).sqrt()

    def _log_weights(self) -> Tensor:
        """Of the nodes of the compliance."""
        return (-0.5 * (_DECADES / self.uncertain) ** 2).log_softmax(dim=0)

    def _of_rows_without_contact(self, distance: Tensor, rows: Tensor) -> Tensor:
        free = (rows[:, FELT] == 0.0) & (rows[:, GIVEN] != 1.0)
        inlier = log_ndtr(distance[:, free] / self._spread(rows[free])) + math.log1p(-self.outlier)
        return torch.logaddexp(inlier, torch.full_like(inlier, math.log(self.outlier))).sum(dim=1)

    def _of_episodes(self, distance: Tensor, rows: Tensor, used: Tensor) -> Tensor:
        """Log-density (N,) of the gaps at the used rows."""
        blocks = self._blocks(rows, used)
        inlier, stray = self._inliers(blocks, blocks.residual(distance))
        episodes = torch.logaddexp(inlier, stray[:, None].expand_as(inlier)).sum(dim=1)
        return torch.logsumexp(self._log_weights()[:, None] + episodes, dim=0)

    def _blocks(self, rows: Tensor, used: Tensor) -> _Blocks:
        place = torch.nonzero(used)[:, 0]
        columns = rows[place][:, [NOISE, FORCE, TIME, EPISODE]]
        errors = _Errors(
            self.blur,
            self.shared,
            self.drift,
            self.lasting,
            self.compliance,
            self.varying,
            self.rough,
        )
        blocks = _blocks_of(columns.numpy().tobytes(), errors)
        return blocks._replace(rows=place[blocks.rows])

    def _inliers(self, blocks: _Blocks, error: Tensor) -> tuple[Tensor, Tensor]:
        """Log-densities (K, E, N) of episodes that are no outliers, and (E,) of those that are."""
        squared = blocks.whitened(error).square().sum(dim=2)
        size = 2.0 * torch.diagonal(blocks.factor, dim1=-2, dim2=-1).log().sum(dim=-1)
        count = blocks.used.sum(dim=1)
        inlier = -0.5 * (squared + (size + count * _LOG_TWO_PI)[..., None]) + math.log1p(-self.outlier)
        return inlier, math.log(self.outlier) - count * math.log(FARTHEST)

    def _quadratic_of_episodes(
        self, distance: Tensor, gradient: Tensor, rows: Tensor, used: Tensor
    ) -> Quadratic:
        blocks = self._blocks(rows, used)
        error = blocks.residual(distance)
        inlier, stray = self._inliers(blocks, error)
        either = torch.logaddexp(inlier, stray[:, None].expand_as(inlier))
        weights = (self._log_weights()[:, None] + either.sum(dim=1)).softmax(dim=0)
        variance = torch.diagonal(blocks.factor @ blocks.factor.transpose(-1, -2), dim1=-2, dim2=-1)
        # What is far off, seen as wide as the errors are taken to be, hardly pulls.
        sure = (inlier - either).exp()[:, :, None]
        trust = (sure / (1.0 + error**2 / (_FAR**2 * variance[..., None]))).sqrt()
        slope = torch.where(blocks.used[..., None], gradient[:, blocks.rows], 0.0).permute(1, 2, 3, 0)
        nodes, episodes, most, count = error.shape
        whitened = blocks.whitened(trust * error)
        scaled = (trust[:, :, :, None] * slope).reshape(nodes, episodes, most, 6 * count)
        turned = blocks.whitened(scaled).reshape(nodes, episodes * most, 6, count).permute(3, 0, 2, 1)
        pulls = (turned @ whitened.reshape(nodes, episodes * most, 1, count).permute(3, 0, 1, 2))[..., 0]
        within, shares = turned @ turned.transpose(-1, -2), weights.T
        pull = (shares[..., None] * pulls).sum(dim=1)
        away = pulls - pull[:, None]
        inside = (shares[..., None, None] * within).sum(dim=1)
        between = (shares[..., None] * away).transpose(-1, -2) @ away
        # The Hessian of a mixture is `inside` minus `between`; what is left of it is bounded from below.
        ridge = _RIDGE * torch.eye(6, dtype=torch.float64)
        factor = torch.linalg.cholesky(inside + ridge)
        left = torch.linalg.solve_triangular(factor, between, upper=False)
        lost = torch.linalg.solve_triangular(factor, left.transpose(-1, -2), upper=False)
        shares_lost, axes = torch.linalg.eigh(0.5 * (lost + lost.transpose(-1, -2)))
        root = factor @ (axes * (1.0 - shares_lost).clamp(min=_LEAST).sqrt()[..., None, :])
        information = root @ root.transpose(-1, -2)
        return Quadratic(pull, information)


@lru_cache(maxsize=128)
def _blocks_of(columns: bytes, errors: _Errors) -> _Blocks:
    """The episodes of rows with the columns NOISE, FORCE, TIME and EPISODE, the same for all particles."""
    noise, force, time, episode = torch.frombuffer(bytearray(columns), dtype=torch.float64).view(-1, 4).T
    _, own, counts = torch.unique_consecutive(episode, return_inverse=True, return_counts=True)
    within = torch.arange(len(episode)) - (counts.cumsum(0) - counts)[own]
    shape = len(counts), int(counts.max())
    rows, used = torch.zeros(shape, dtype=torch.int64), torch.zeros(shape, dtype=torch.bool)
    rows[own, within], used[own, within] = torch.arange(len(episode)), True
    noise, force, time = (torch.where(used, each[rows], 0.0) for each in (noise, force, time))
    nodes = errors.compliance * 10.0**_DECADES
    sunk = nodes[:, None, None] * force
    apart = (time[:, :, None] - time[:, None, :]).abs()
    lasting = errors.drift**2 * torch.exp(-apart / errors.lasting) + errors.shared**2
    both = used[:, :, None] & used[:, None, :]
    covariance = torch.where(both, lasting, 0.0) + errors.varying**2 * sunk[..., None] * sunk[..., None, :]
    own_variance = torch.where(used, noise**2 + errors.blur**2 + (errors.rough * sunk) ** 2, 1.0)
    factor = torch.linalg.cholesky(covariance + torch.diag_embed(own_variance))
    return _Blocks(rows, used, nodes, force, factor)


def is_predicted(value: Tensor) -> bool:
    """Whether a value holds rows that a `motion` predicts, which have no times."""
    return value.ndim == 3 or bool((torch.isnan(value[:, TIME]) & ~torch.isnan(value[:, FELT])).any())


def padded(rows: Tensor, stamps: int) -> Tensor:
    """Rows (..., S, C) as (..., T, 13); those that are added repeat the first pose and are not used."""
    full = torch.full((*rows.shape[:-2], stamps, COLUMNS), torch.nan, dtype=torch.float64)
    if rows.shape[-2]:
        full[..., :7] = rows[..., :1, :7]
    full[..., : rows.shape[-2], : rows.shape[-1]] = rows
    return full
