"""Errors of the rows of an episode: their covariances, the same for all particles, as Cholesky factors."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from bcppl.distributions.episodes.branches import Segments
from bcppl.distributions.episodes.rows import EPISODE, FELT, FORCE, NOISE, TIME


class Hypothesis(NamedTuple):
    """What may hold for all of a recording's touches.

    Attributes:
        log_weight: of its probability.
        compliance: of part and peg where they touch, m/N.
        noise: by which the rows' own errors are wider than stated.
        scale: by which the errors that all touches share are wider than stated.
        delay: the interval in which the wrench's delay lies, from 1 on (`rows.late`); 0 for no delay.
    """

    log_weight: float
    compliance: float
    noise: float = 1.0
    scale: float = 1.0
    delay: int = 0


class RowErrors(NamedTuple):
    """The errors of a row, as of `ContactEpisodes`; `blur` m are added."""

    blur: float
    shared: float
    drift: float
    lasting: float
    varying: float
    rough: float


def segments_of(rows: Tensor, errors: RowErrors, hypotheses: tuple[Hypothesis, ...]) -> Segments:
    """The segments of rows (R, COLUMNS), with the factors of their covariances under each hypothesis."""
    columns = rows[:, [FELT, NOISE, FORCE, TIME, EPISODE]].contiguous()
    return _segments(columns.numpy().tobytes(), errors, hypotheses)


@lru_cache(maxsize=256)
def _segments(columns: bytes, errors: RowErrors, hypotheses: tuple[Hypothesis, ...]) -> Segments:
    felt, noise, force, time, episode = (
        torch.frombuffer(bytearray(columns), dtype=torch.float64).view(-1, 5).T
    )
    contact = felt == 1.0
    begins = torch.ones(len(felt), dtype=torch.bool)
    begins[1:] = ~(contact[1:] & contact[:-1] & (episode[1:] == episode[:-1]))
    first = begins.nonzero()[:, 0]
    last = torch.cat([first[1:], torch.tensor([len(felt)])])
    longest = int((last - first).max()) if len(first) else 1
    nodes = torch.tensor([h.compliance for h in hypotheses], dtype=torch.float64)
    scale = torch.tensor([h.noise for h in hypotheses], dtype=torch.float64)
    factor = torch.zeros(len(hypotheses), len(felt), longest, dtype=torch.float64)
    spread = (noise**2 + errors.blur**2 + errors.drift**2 + errors.shared**2).sqrt()
    factor[:, ~contact, 0] = scale[:, None] * spread[~contact]
    for begin, end in zip(first.tolist(), last.tolist(), strict=True):
        if not contact[begin]:
            continue
        own = slice(begin, end)
        apart = (time[own, None] - time[own]).abs()
        lasting = errors.drift**2 * torch.exp(-apart / errors.lasting) + errors.shared**2
        lasting = lasting + torch.diag(noise[own] ** 2 + errors.blur**2)
        sunk = nodes[:, None] * force[own]
        covariance = scale[:, None, None] ** 2 * lasting + torch.diag_embed((errors.rough * sunk) ** 2)
        covariance = covariance + errors.varying**2 * sunk[..., None] * sunk[..., None, :]
        factor[:, own, : end - begin] = torch.linalg.cholesky(covariance)
    arrays = (
        np.ascontiguousarray(each.numpy()) for each in (first, last, contact[first].to(torch.int64), factor)
    )
    return Segments(*arrays)
