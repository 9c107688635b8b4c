"""The memory in which the compiled filter takes particles, one by one, through the segments of a probe."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from bcppl.arrays import Array, Indices, Mask
from bcppl.compiled import compiled
from bcppl.distributions.episodes.filter.branches import OF_CONTACT, Branches, Prior, Segments
from bcppl.distributions.episodes.filter.gaps import Gaps


class Workspace(NamedTuple):
    """Arrays for B hypotheses of M parameters, D delays and L rows of the longest segment.

    Attributes:
        weight, square: (W,) of each candidate at an episode: its log-weight and its squared whitened errors.
        source, kind: (W,) the hypothesis that it comes from, and the event, as of `Branches`.
        rank: (W,) weights, -inf where a candidate has been taken.
        leading: (D,) the best candidate of each delay.
        distance, columns: (D, L) a segment's gaps with each delay, and their derivatives (D, L, M).
        filled: (D,) for which delays these are known.
        error: (B, L) of each hypothesis, the gaps that it predicts.
        pulls, joints: (B, L, M) and (B, L, L) their covariances with the parameters and one another.
        white, factor: (L,) and (L, L) of one candidate: its whitened errors, by a Cholesky factor.
        pull, changed, gain: (M,), (M,) and (L, M) room of one candidate; `changed` are a change's variances.
        later_mean, later_covariance: (B, 2) and (B, 2, 2) of the contact's parameters given an episode.
        moved: (2,) by how much these have.
        old: of one particle, the hypotheses before an episode.
    """

    weight: Array
    square: Array
    source: Indices
    kind: Indices
    rank: Array
    leading: Indices
    distance: Array
    columns: Array
    filled: Mask
    error: Array
    pulls: Array
    joints: Array
    white: Array
    factor: Array
    pull: Array
    changed: Array
    gain: Array
    later_mean: Array
    later_covariance: Array
    moved: Array
    old: Branches


@compiled
def workspace(after: Branches, prior: Prior, segments: Segments, gaps: Gaps) -> Workspace:
    """Memory for particles whose hypotheses after the rows are held in `after`."""
    size, parameters = after.log_weight.shape[1], after.mean.shape[2]
    longest, delays = int((segments.last - segments.first).max()), len(gaps.late)
    most = 2 * size * len(prior.change_log_probability)
    return Workspace(
        np.empty(most),
        np.empty(most),
        np.empty(most, np.int64),
        np.empty(most, np.int64),
        np.empty(most),
        np.empty(delays, np.int64),
        np.empty((delays, longest)),
        np.empty((delays, longest, parameters)),
        np.empty(delays, np.bool_),
        np.empty((size, longest)),
        np.empty((size, longest, parameters)),
        np.empty((size, longest, longest)),
        np.empty(longest),
        np.empty((longest, longest)),
        np.empty(parameters),
        np.empty(parameters),
        np.empty((longest, parameters)),
        np.empty((size, OF_CONTACT)),
        np.empty((size, OF_CONTACT, OF_CONTACT)),
        np.empty(OF_CONTACT),
        Branches(
            after.number[:1].copy(),
            after.log_weight[:1].copy(),
            after.which[:1].copy(),
            after.mean[:1].copy(),
            after.covariance[:1].copy(),
            after.event[:1].copy(),
            after.squared[:1].copy(),
        ),
    )
