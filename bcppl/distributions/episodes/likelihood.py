"""Contacts of a probe by episodes: errors that last, errors that all touches share, rows already used."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy.special import bdtrc
from torch import Tensor

from bcppl import poses
from bcppl.devices import numbers, on_device_of
from bcppl.distributions.checks import Check, chi_square
from bcppl.distributions.episodes.couples import coupled, log_blocked
from bcppl.distributions.episodes.displaced import lines_at
from bcppl.distributions.episodes.filter.branches import Branches, begun
from bcppl.distributions.episodes.filter.posterior import drawn, moments, probable_jumps
from bcppl.distributions.episodes.filter.row_errors import segments_of
from bcppl.distributions.episodes.filtered import FilteredEpisodes
from bcppl.distributions.episodes.prior import WIDE
from bcppl.distributions.episodes.rows import (
    COLUMNS,
    FELT,
    FORCE,
    GIVEN,
    TIME,
    given_and_all,
    is_predicted,
    padded,
)
from bcppl.distributions.manifold import Gaps, Quadratic

_FAR = 4.0  # standard deviations


@dataclass(eq=False, repr=False)
class ContactEpisodes(FilteredEpisodes):
    """Where a held peg was measured to be, and whether it felt the part, over the rows of a window.

    A row is the mean of stamps that hardly differ, or one stamp. In an episode, which is an uninterrupted
    contact or, of a longer one, what is in half a second of a probe, the gap at row i of force F_i is normal
    with mean -c F_i, and its errors have the covariance

        (noise_i^2 + (0.2 c F_i)^2) [i = j] + drift^2 exp(-|t_i - t_j| / lasting) + shared^2
        + (varying c)^2 F_i F_j:

    noise of the rows, a stationary Ornstein-Uhlenbeck process in time, the unknown geometry, and a compliance
    that differs from contact to contact by a factor. The last two are the same in all episodes of a contact.
    The compliance c of part and peg is common to a recording and log-normal; all errors but those in c are
    wider by a common factor with some probability (`prior.NOISES`); both are integrated out by a sum over
    nodes. So a row adds what it adds whatever the rate, and the product of the windows' likelihoods does not
    depend on how a probe is cut into them: a row that an earlier window has used is in the value again,
    marked as given, and the log-likelihood is that of all rows minus that of the given ones.

    What all touches share (`bench`: the peg's pose in the hand, the arm's compliance, ...) moves the gap and
    is integrated out (`bcppl.distributions.episodes.filter.switching_filter`). The gap is linear over what
    that may be (`bcppl.distributions.episodes.regressed`), given the rows until a few before
    (`rows.last_end`).

    A row without contact has the probability that a gap about d is positive, as in `ContactManifold`, or
    about zero: a peg may rub along the part with a force that is not felt. Between two walls the gap seems
    less than it is, which the probability allows for. Of an episode each piece of a tenth of a second, or of
    four rows, may be an outlier by itself (`bcppl.distributions.episodes.filter.row_errors`), and the errors
    that last are its own. Where a torque is one that no single contact exerts, an episode has besides the
    probability that the peg is not free to turn against it (`bcppl.distributions.episodes.couples`).

    The event is (T, COLUMNS): world_from_peg; 1 with contact, 0 without, NaN for a row that is not used;
    noise (m) of the row; force (N); time (s); the number of the episode; 1 for a given row; the wrench on the
    peg (N and N m, in its frame); the rotation vector (rad, there) that contacts prevent (`rows.TURN`),
    0 for none; 1 for an episode whose contact is that of the episode before (`rows.CONTINUES`); twists (m and
    rad, in its frame) to where it was a little earlier (`rows.EARLIER`). Where
    `motion` predicts the rows there are no forces and times: these are NaN, and the rows are distributed as
    in `ContactManifold`.

    Args:
        drift: standard deviation of the errors that last, m.
        lasting: the time after which they are forgotten, s.
        compliance: median, m/N.
        uncertain: standard deviation of its decimal logarithm.
        varying: standard deviation of a contact's compliance, as a share of the recording's.
        rough: the same of a row's.
        blur: m by which the errors of rows are taken to be wider.
        bench: errors that all touches share.
        hypotheses: of compliance, noise and scale; by default the nodes of the compliance.
        solids: what measures the gap of pegs that are displaced by shared errors; `gap` unless given.

    Attributes:
        memory: of what is known after which rows, at these poses and by these arguments; where windows of the
            same are given that of another, each row is used once.
    """

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-likelihood (N,) of one window (T, COLUMNS), or of one for each particle (N, T, COLUMNS)."""
        if is_predicted(value):
            return super().log_prob(value[..., : FELT + 1])
        if value.ndim == 3:
            # One that was measured is most often the same for all.
            windows, whose = torch.nan_to_num(value, nan=-torch.inf).unique(dim=0, return_inverse=True)
            every = torch.stack([self.log_prob(torch.where(w == -torch.inf, torch.nan, w)) for w in windows])
            return every[whose, torch.arange(len(whose))]
        given, rows = given_and_all(value)
        if len(given) == len(rows):
            return self.pose.new_zeros(len(self.pose))
        before = self.branches(given).log_evidence
        evidence = on_device_of(self.branches(rows, given).log_evidence - before, self.pose)
        pressed = coupled(rows[len(given) :])
        if self.solids is None or not len(pressed):
            return evidence
        spread = self._spread_at(self.solids(self.pose, pressed[:, :7]), pressed)
        return evidence + log_blocked(self.solids, self.pose, pressed, spread)

    def quadratic(self, value: Tensor) -> Quadratic:
        """The log-likelihood of a window to second order, the shared errors integrated out.

        Of several hypotheses it is the mixture's, by its first two moments.
        """
        if is_predicted(value):
            return super().quadratic(value[..., : FELT + 1])
        given, rows = given_and_all(value)
        count = len(self.pose)
        whole = Quadratic(self.pose.new_zeros(count, 6), self.pose.new_zeros(count, 6, 6))
        for sign, used in ((1.0, rows), (-1.0, given)):
            if len(used):
                own = self._quadratic_of(used)
                whole = Quadratic(
                    whole.gradient + sign * own.gradient, whole.information + sign * own.information
                )
        return whole

    def joint_covariance(self, value: Tensor) -> Tensor:
        """Covariance (N, 6 + M, 6 + M) of the pose and the shared errors given a window's rows, linear here.

        With hardly any prior of the pose (0.1 m, 1 rad): translation along the world's axes and rotation in
        the part's frame, m and rad; then the shared errors, in their standard deviations. At the true pose
        it is what touches can tell at best, a Bayesian Cramer-Rao bound of a linear model.
        """
        return self._joint_moments(given_and_all(value)[1])[1]

    def residual(self, value: Tensor) -> Tensor:
        """Gaps (N, T) that contradict the contact signal, as of `ContactManifold`; 0 for given rows."""
        if is_predicted(value):
            return super().residual(value[..., : FELT + 1])
        stood, felt = value[:, :7].clone(), value[:, FELT]
        stood[torch.isnan(felt)] = self.pose[0]
        gaps = self.gap(self.pose, stood)
        distance = gaps.distance
        if self.is_displaced:
            branches = self.branches(given_and_all(value)[1]).on_host
            used = torch.nan_to_num(value)
            used[:, :7] = stood
            distance = distance + self._shift(gaps, used, branches)
        contact = distance + self.compliance * torch.nan_to_num(value[:, FORCE])
        residual = torch.where(felt == 1.0, contact, distance.clamp(max=0.0))
        residual = torch.where(value[:, GIVEN] == 1.0, 0.0, residual)
        return torch.where(torch.isnan(felt), torch.nan, residual)

    def changes(self, value: Tensor) -> list[tuple[str, float, Tensor]]:
        """The sudden changes given a window's rows and those before them.

        Returns:
            The name of each, the time of the first row after it (s), and its probabilities (N,).
        """
        rows = value[:0] if is_predicted(value) else given_and_all(value)[1]
        if not len(rows):
            return []
        segments = segments_of(rows, self._row_errors, self._every)
        times = rows[segments.first[segments.contact == 1], TIME].tolist()
        return probable_jumps(self.branches(rows).on_host, self.bench, times)

    def shared_posterior(self, value: Tensor) -> tuple[Tensor, Tensor]:
        """Mean (N, M) and covariance (N, M, M) of the shared errors' parameters, as `shared_moments`."""
        rows = value[:0] if is_predicted(value) else given_and_all(value)[1]
        return moments(self.branches(rows).on_host)

    def shared_moments(self, value: Tensor) -> dict[str, tuple[Tensor, Tensor]]:
        """Means and variances (N, M) of each shared error, given a window's rows and those before them."""
        mean, covariance = self.shared_posterior(value)
        variance = covariance.diagonal(dim1=-2, dim2=-1)
        return {name: (mean[:, place], variance[:, place]) for name, place in self.bench.slices.items()}

    @property
    def is_displaced(self) -> bool:
        """Whether the peg may be elsewhere than it is measured."""
        return bool(self.bench.errors)

    def apparent_poses(self, value: Tensor, world_from_peg: Tensor, draws: int) -> Tensor:
        """The part's poses (N, draws, 7) as of `bcppl.beliefs.belief.ApparentPose`, given a window's rows.

        The place there has an error of its own (`shared`), as every contact has.
        """
        branches = self.branches(given_and_all(value)[1]).on_host
        row = world_from_peg.new_zeros(1, COLUMNS)
        row[0, :7] = world_from_peg
        twist = drawn(branches, draws) @ self.bench.effect(row).twist[0].T
        generator = torch.Generator().manual_seed(1)
        local = torch.randn(*twist.shape[:-1], 3, generator=generator, dtype=torch.float64)
        twist[..., :3] += self.shared * local
        turn = poses.rotation_matrix(world_from_peg)
        measured = world_from_peg.expand(*twist.shape[:-1], 7)
        true = poses.retract(measured, torch.cat([twist[..., :3] @ turn.T, twist[..., 3:]], dim=-1))
        part = on_device_of(self.pose, twist)[:, None].expand(*twist.shape[:-1], 7)
        return poses.compose(measured, poses.compose(poses.inverse(true), part))

    def predictive_check(self, value: Tensor, replicas: Callable[[], Any]) -> Check | None:
        """The check of a window at P particles, as of `ContactManifold`, the shared errors integrated out."""
        if is_predicted(value):
            return super().predictive_check(value[..., : FELT + 1], replicas)
        given, rows = given_and_all(value)
        new = rows[len(given) :]
        if not len(new):
            return None
        whole, count = Check(1.0, "contacts", 0.0), int((new[:, FELT] == 1.0).sum())
        branches = self.branches(rows, given).on_host
        if count:
            squared = branches.squared.sum(axis=2)
            if bool((given[:, FELT] == 1.0).any()):
                # Of the rows that are new: those before them are squared alike in both.
                before = self.branches(given).on_host
                squared = squared - (before.weights * before.squared.sum(axis=2)).sum(axis=1, keepdims=True)
            whole = chi_square(torch.from_numpy((branches.weights * squared).sum(axis=1)), count, "contacts")
        free = new[new[:, FELT] == 0.0]
        if not len(free):
            return whole
        gaps = self.gap(self.pose, free[:, :7])
        deep = (gaps.distance < -_FAR * self._spread_at(gaps, free)).sum(dim=1)
        outliers = float(bdtrc(numbers(deep) - 1, len(free), self.outlier).mean())
        return Check(min(1.0, 2.0 * min(whole.probability, outliers)), "contacts", whole.excess)

    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        """As of `ContactManifold`, with room (N, T, COLUMNS) for all that a measured window has."""
        return padded(super().sample(sample_shape), self.stamps)

    def _spread_at(self, gaps: Gaps, rows: Tensor) -> Tensor:
        """Standard deviations (N, R) of the gaps of rows without contact, a priori."""
        prior, lines = self._prior(0), lines_at(gaps, self.pose, rows, self.bench)
        weights = on_device_of(np.bincount(prior.delay, np.exp(prior.log_weight)), self.pose)
        variances = self._variance(lines.columns, rows) + lines.moved**2
        return torch.einsum("d,ndr->nr", weights, variances).sqrt()

    def _shift(self, gaps: Gaps, rows: Tensor, branches: Branches) -> Tensor:
        """The gaps' changes (N, R) by the delay and the shared errors, on average over hypotheses."""
        lines = lines_at(gaps, self.pose, rows, self.bench)
        moved, columns = lines.moved, lines.columns
        delay = torch.from_numpy(self._prior(0).delay[branches.which])  # (N, B)
        particle = torch.arange(len(delay))[:, None]
        each = moved[particle, delay]
        shared = torch.from_numpy(branches.mean[..., : columns.shape[-1]])
        each = each + torch.einsum("nbrm,nbm->nbr", columns[particle, delay], shared)
        return (torch.from_numpy(branches.weights)[..., None] * each).sum(dim=1)

    def _quadratic_of(self, rows: Tensor) -> Quadratic:
        mean, covariance = self._joint_moments(rows)
        precision = torch.linalg.inv(covariance[:, :6, :6])
        pull = (precision @ mean[:, :6, None])[..., 0]
        information = precision - torch.diag(WIDE**-2)
        return Quadratic(-pull, 0.5 * (information + information.transpose(-1, -2)))

    def _joint_moments(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Mean (N, 6 + M) and covariance of the pose's displacement and the shared errors, given rows."""
        prior = self._prior(6)
        if self.blur:
            prior = prior._replace(outlier=0.0)
        errors = self._known(rows).errors if self._regresses else self._errors_before
        return moments(self._filtered(begun(prior, len(self.pose)), prior, rows, errors, free=True))
