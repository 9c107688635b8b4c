"""Errors of the rows of an episode as a dense Gaussian, written down from the likelihood's docstring."""

from __future__ import annotations

import torch
from torch import Tensor

from bcppl.distributions.episodes.filter.row_errors import Hypothesis, RowErrors
from bcppl.distributions.episodes.rows import EPISODE, FORCE, NOISE, TIME


def factors(rows: Tensor, errors: RowErrors, hypothesis: Hypothesis) -> Tensor:
    """Rows (R, n) of the Cholesky factors of the episodes' covariances; n rows in the longest one."""
    sizes = rows[:, EPISODE].unique(return_counts=True)[1]
    factor = torch.zeros(len(rows), int(sizes.max()), dtype=torch.float64)
    for episode in rows[:, EPISODE].unique():
        own = (rows[:, EPISODE] == episode).nonzero()[:, 0]
        apart = (rows[own, None, TIME] - rows[own, TIME]).abs()
        lasting = errors.drift**2 * torch.exp(-apart / errors.lasting) + errors.shared**2
        lasting = lasting + torch.diag(rows[own, NOISE] ** 2 + errors.blur**2)
        sunk = hypothesis.compliance * rows[own, FORCE]
        covariance = hypothesis.noise**2 * lasting + torch.diag((errors.rough * sunk) ** 2)
        covariance = covariance + errors.varying**2 * sunk[:, None] * sunk
        factor[own, : len(own)] = torch.linalg.cholesky(covariance)
    return factor
