"""Errors of the rows of an episode, as a process in time: the same for all particles."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from bcppl.arrays import Array, Indices
from bcppl.compiled import compiled
from bcppl.devices import on_host
from bcppl.distributions.episodes.branches import Segments
from bcppl.distributions.episodes.conditioning import factorise
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
    """The segments of rows (R, COLUMNS), with their errors under each hypothesis."""
    columns = rows[:, [FELT, NOISE, FORCE, TIME, EPISODE]].contiguous()
    with on_host():
        return _segments(columns.numpy().tobytes(), errors, hypotheses)


@lru_cache(maxsize=64)
def _segments(columns: bytes, errors: RowErrors, hypotheses: tuple[Hypothesis, ...]) -> Segments:
    felt, noise, force, time, episode = (
        torch.frombuffer(bytearray(columns), dtype=torch.float64).view(-1, 5).T
    )
    contact = felt == 1.0
    begins = torch.ones(len(felt), dtype=torch.bool)
    begins[1:] = ~(contact[1:] & contact[:-1] & (episode[1:] == episode[:-1]))
    first = begins.nonzero()[:, 0]
    last = torch.cat([first[1:], torch.tensor([len(felt)])])
    compliance = torch.tensor([h.compliance for h in hypotheses], dtype=torch.float64)
    scale = torch.tensor([h.noise for h in hypotheses], dtype=torch.float64)
    sunk = compliance[:, None] * torch.where(contact, force, 0.0)
    own = noise**2 + errors.blur**2
    alone = scale[:, None] ** 2 * (own + errors.shared**2 + errors.drift**2)
    own = scale[:, None] ** 2 * own + (errors.rough * sunk) ** 2
    joint = torch.zeros(len(hypotheses), len(felt), int((last - first).max()), dtype=torch.float64)
    loaded = torch.zeros_like(time)
    for begin, end in zip(first.tolist(), last.tolist(), strict=True):
        if contact[begin]:
            # What is held by friction slips when it is loaded more than it was.
            most = force[begin:end].clamp(min=1e-3).cummax(dim=0).values
            loaded[begin:end] = most / most[-1]
            apart = (time[begin:end, None] - time[begin:end]).abs()
            lasting = errors.shared**2 + errors.drift**2 * torch.exp(-apart / errors.lasting)
            both = errors.varying**2 * sunk[:, begin:end, None] * sunk[:, None, begin:end]
            both = both + scale[:, None, None] ** 2 * lasting + torch.diag_embed(own[:, begin:end])
            joint[:, begin:end, : end - begin] = both
    arrays = (first, last, contact[first].to(torch.int64), alone, joint, loaded)
    return _with_factors(*(np.ascontiguousarray(each.numpy()) for each in arrays))


def _with_factors(
    first: Indices, last: Indices, contact: Indices, own: Array, errors: Array, loaded: Array
) -> Segments:
    factor, log_determinant = np.zeros_like(errors), np.zeros((len(errors), len(first)))
    set_factors(first, last, contact, errors, factor, log_determinant)
    return Segments(first, last, contact, own, errors, factor, log_determinant, loaded)


@compiled
def set_factors(
    first: Indices, last: Indices, contact: Indices, errors: Array, factor: Array, log_determinant: Array
) -> None:
    """Set the factors (H, R, E) of episodes' covariances, as of `factorise`, and log-determinants (H, S)."""
    none, never = np.zeros((errors.shape[2], 0)), np.zeros(0)
    for h in range(len(errors)):
        for s in range(len(first)):
            if contact[s]:
                own, to = errors[h, first[s] : last[s]], factor[h, first[s] : last[s]]
                log_determinant[h, s] = factorise(own, none, never, never, to)
