"""The filter over a probe's episodes where nothing is learned of shared errors, for all particles by torch.

Without these an episode's errors are correlated alike in all particles, and its hypotheses never multiply:
what the compiled filter (`bcppl.distributions.episodes.filter.switching_filter`) does particle by particle is
a few operations on all of them. On a GPU it is evaluated so, where the particles are.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.special import log_ndtr

from bcppl.arrays import Array, Indices
from bcppl.devices import numbers, on_device_of
from bcppl.distributions.episodes.filter.branches import OF_CONTACT, Branches, Prior, Segments
from bcppl.distributions.episodes.filter.free_rows import BETWEEN, CLEAR, RUBBING
from bcppl.distributions.episodes.filter.switching_filter import FAINT

_FREE = 64  # rows without contact at a time: they take memory


@dataclass(frozen=True, eq=False)
class AlikeBranches:
    """The H hypotheses of N particles after some rows, on a device; their parameters are the contact's.

    Attributes:
        log_weight: (N, H) unnormalised; -inf for one that is dropped.
        mean, covariance: (N, H, 2) and (N, H, 2, 2) of the parameters.
        squared: (N, H, E) of each episode so far its squared whitened errors, as predicted.
    """

    log_weight: Tensor
    mean: Tensor
    covariance: Tensor
    squared: Tensor

    @property
    def log_evidence(self) -> Tensor:
        """(N,) the log-likelihood of the rows so far."""
        return self.log_weight.logsumexp(dim=1)

    @property
    def of_each(self) -> AlikeBranches:
        """Itself: every particle's are written."""
        return self

    @property
    def on_host(self) -> Branches:
        """The same as the compiled filter gives it, but for what is dropped, which has no weight here."""
        log_weight, squared = numbers(self.log_weight), numbers(self.squared)
        particles, hypotheses = log_weight.shape
        return Branches(
            number=np.full(particles, hypotheses),
            log_weight=log_weight,
            which=np.broadcast_to(np.arange(hypotheses), log_weight.shape).copy(),
            mean=numbers(self.mean),
            covariance=numbers(self.covariance),
            event=np.zeros(squared.shape, np.int64),
            squared=squared,
        )


def begun_alike(prior: Prior, pose: Tensor) -> AlikeBranches:
    """The hypotheses of the particles at poses (N, 7) before the first row."""
    log_weight = on_device_of(np.asarray(prior.log_weight), pose).expand(len(pose), -1)
    shape, sizes = log_weight.shape, (OF_CONTACT, (OF_CONTACT, OF_CONTACT), 0)
    return AlikeBranches(log_weight, *(log_weight.new_zeros(*shape, *np.atleast_1d(each)) for each in sizes))


def filtered_alike(
    before: AlikeBranches, prior: Prior, segments: Segments, distance: Tensor, force: Array
) -> AlikeBranches:
    """The hypotheses after further rows, as `switching_filter.filtered`.

    Args:
        before: after the rows before these.
        prior: of all hypotheses, which differ in no delay.
        segments: of these rows.
        distance: (N, R) the gaps, m.
        force: (R,) N.
    """
    log_weight, squared = before.log_weight, [before.squared]
    mean, covariance = before.mean, before.covariance
    free: list[int] = []

    def put(values: Array | Indices) -> Tensor:
        return on_device_of(np.ascontiguousarray(values), distance)

    # Of many hypotheses few differ in the noise of a row.
    noises, whose = np.unique(np.sqrt(segments.own), axis=0, return_inverse=True)
    own, of_each = put(noises), put(whose.reshape(-1))
    sunk, log_in = put(prior.compliance[:, None] * force), math.log1p(-prior.outlier)
    log_out = math.log(prior.outlier) if prior.outlier > 0.0 else -math.inf
    ends = zip(segments.first.tolist(), segments.last.tolist(), segments.contact.tolist(), strict=True)
    for s, (first, last, contact) in enumerate(ends):
        if not contact:
            free.append(first)
            continue
        log_weight = log_weight + _of_free(distance, free, own, log_in, log_out)[:, of_each]
        free, rows = [], last - first
        if segments.begins[s]:
            mean = torch.zeros_like(mean)
            covariance = torch.diag_embed(put(segments.common)).expand_as(covariance)
        by = put(np.stack([np.ones(rows), force[first:last]]))
        error = distance[:, None, first:last] + sunk[:, first:last] + mean @ by
        factor = _lower(segments.factor[:, first:last, :rows])
        white = torch.einsum("hij,nhj->nhi", put(factor), error)
        ratio = covariance @ put(segments.known[:, s]) + put(np.eye(OF_CONTACT))
        later = torch.linalg.solve(ratio, covariance)
        pull = torch.einsum("hra,nhr->nha", put(segments.white[:, first:last]), white)
        step = (later @ pull[..., None])[..., 0]
        square = white.square().sum(dim=2) - (pull * step).sum(dim=2)
        size = put(segments.log_determinant[:, s] + rows * math.log(2.0 * math.pi)) + ratio.logdet()
        inlier = log_in - 0.5 * (square + size)
        stray = torch.full_like(inlier, log_out - rows * math.log(prior.farthest))
        either = torch.logaddexp(inlier, stray)
        inside = (inlier - either).exp()[..., None]
        mean = mean - inside * step
        inside = inside[..., None]
        covariance = inside * later + (1.0 - inside) * covariance
        covariance = covariance + inside * (1.0 - inside) * step[..., None] * step[..., None, :]
        log_weight = log_weight + either
        faint = log_weight < log_weight.amax(dim=1, keepdim=True) - FAINT
        log_weight = log_weight.masked_fill(faint, -torch.inf)
        squared.append(square[..., None])
    log_weight = log_weight + _of_free(distance, free, own, log_in, log_out)[:, of_each]
    return AlikeBranches(log_weight, mean, covariance, torch.cat(squared, dim=2))


def _of_free(distance: Tensor, rows: list[int], own: Tensor, log_in: float, log_out: float) -> Tensor:
    """The log-probability (N, K) of rows without contact, as of `switching_filter`, for noises (K, R)."""
    total = distance.new_zeros(len(distance), len(own))
    for first in range(0, len(rows), _FREE):
        which = slice(rows[first], rows[min(first + _FREE, len(rows)) - 1] + 1)
        if which.stop - which.start != len(rows[first : first + _FREE]):
            raise AssertionError("rows without contact between two episodes follow one another")
        gap = distance[:, which]
        score = gap[:, None] / own[:, which] + BETWEEN
        log_density = -0.5 * score.square() - 0.5 * math.log(2.0 * math.pi)
        positive = torch.logaddexp(log_ndtr(score), math.log(RUBBING) + log_density).clamp(max=0.0)
        either = torch.logaddexp(log_in + positive, torch.full_like(score, log_out))
        either = torch.where(gap[:, None] > CLEAR, 0.0, either)
        total = total + either.sum(dim=2)
    return total


def _lower(factor: Array) -> Array:
    """The inverses (H, n, n) of Cholesky factors whose diagonals are inverted already."""
    inverse = np.zeros(factor.shape)
    for i in range(factor.shape[1]):
        inverse[:, i, i] = factor[:, i, i]
        for j in range(i):
            rest = -(factor[:, i, j:i] * inverse[:, j:i, j]).sum(axis=1)
            inverse[:, i, j] = rest * factor[:, i, i]
    return inverse
