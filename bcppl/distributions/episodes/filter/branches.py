"""The hypotheses that the filter over a probe's episodes carries for each particle, and what it is given."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from bcppl.arrays import Array, Indices

KEPT = 16  # hypotheses of a particle
# Parameters of the present contact, after those that all touches share: where it is, and by how much its
# compliance differs. Another contact has others.
OF_CONTACT = 2
INLIER, OUTLIER = 0, 1  # what an episode is; plus twice the number of the change before or in it


class Segments(NamedTuple):
    """S segments of consecutive rows: a piece of an episode of contact, or one row without contact.

    Attributes:
        first, last: (S,) the index of a segment's first row, and that after its last.
        contact: (S,) 1 for a piece of an episode.
        begins: (S,) 1 for one whose contact is not that of the piece before.
        slips: (S,) 1 for one in which what is held by friction may slip: it is loaded more than before.
        own: (H, R) of each hypothesis, variances of the errors of rows without contact, m^2.
        common: (H, 2) variances of the parameters of a contact that begins, m^2 and (m/N)^2.
        errors: (H, R, E) covariances of a row's error with those of its episode up to it, m^2, but for what
            the parameters of its contact add.
        factor: (H, R, E) their Cholesky factors, with inverted diagonals.
        log_determinant: (H, S) of an episode's covariance.
        white: (H, R, 2) the gaps' derivatives by the contact's parameters, whitened by the factor.
        known: (H, S, 2, 2) the information on these in an episode.
        loaded: (R,) by a row of an episode, the share of a change's variances that has come.
    """

    first: Indices
    last: Indices
    contact: Indices
    begins: Indices
    slips: Indices
    own: Array
    common: Array
    errors: Array
    factor: Array
    log_determinant: Array
    white: Array
    known: Array
    loaded: Array


class Prior(NamedTuple):
    """What holds before the first row.

    Attributes:
        log_weight, compliance, scale: (H,) of each hypothesis: its log-probability, the compliance of a
            contact in m/N, and the factor of the shared errors' standard deviations.
        delay: (H,) the place of its delay among those for which gaps are given.
        mean, variance: (M,) of the parameters; the last two are those of a contact.
        change_log_probability: (C,) of each change, at an episode: none, then jumps of one or more errors.
        change_variance: (C, M) by each.
        outlier: the probability that an episode, or a row without contact, is one.
        farthest: m, the range over which an outlier's gap is spread evenly.
    """

    log_weight: Array
    compliance: Array
    scale: Array
    delay: Indices
    mean: Array
    variance: Array
    change_log_probability: Array
    change_variance: Array
    outlier: float
    farthest: float


class Branches(NamedTuple):
    """The hypotheses of N particles after some rows.

    Attributes:
        number: (N,) how many there are; others are not used.
        log_weight: (N, B) unnormalised: their sum is the likelihood of the rows so far.
        which: (N, B) the hypothesis of the prior.
        mean: (N, B, M) of the parameters, those of the present contact last.
        covariance: (N, B, M, M).
        event: (N, B, E) of each episode so far: twice the number of a change, and one more for an outlier.
        squared: (N, B, E) its squared whitened errors, as predicted.
    """

    number: Indices
    log_weight: Array
    which: Indices
    mean: Array
    covariance: Array
    event: Indices
    squared: Array

    @property
    def log_evidence(self) -> Array:
        """(N,) the log-likelihood of the rows so far."""
        used = np.arange(self.log_weight.shape[1]) < self.number[:, None]
        return np.asarray(np.logaddexp.reduce(np.where(used, self.log_weight, -np.inf), axis=1))

    @property
    def weights(self) -> Array:
        """(N, B) normalised, 0 for those that are not used."""
        used = np.arange(self.log_weight.shape[1]) < self.number[:, None]
        shifted = np.where(used, self.log_weight, -np.inf) - self.log_evidence[:, None]
        return np.asarray(np.exp(shifted))

    @property
    def on_host(self) -> Branches:
        """Itself: these are arrays."""
        return self

    @property
    def of_each(self) -> Branches:
        """The same where what holds for all particles is written for each."""
        count = len(self.number)
        return Branches._make(each if len(each) == count else np.repeat(each, count, axis=0) for each in self)


def begun(prior: Prior, particles: int) -> Branches:
    """The hypotheses of N particles before the first row."""
    hypotheses, parameters = len(prior.log_weight), len(prior.mean)
    size = max(KEPT, hypotheses)
    # The same for all particles, and held once: an axis of one in place of theirs.
    log_weight, which = np.zeros((1, size)), np.zeros((1, size), dtype=np.int64)
    mean, covariance = np.zeros((1, size, parameters)), np.zeros((1, size, parameters, parameters))
    log_weight[0, :hypotheses], which[0, :hypotheses] = prior.log_weight, np.arange(hypotheses)
    mean[:, :hypotheses] = prior.mean
    own = np.arange(parameters)
    covariance[0, :hypotheses, own, own] = prior.variance[:, None] * prior.scale**2
    none = np.zeros((1, size, 0))
    count = np.full(particles, hypotheses)
    return Branches(count, log_weight, which, mean, covariance, none.astype(np.int64), none)
