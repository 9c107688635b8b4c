"""Whether runs agree with an exact answer, within their own standard error.

So many standard errors as a normal would allow are widened to those of Student's t with as few runs.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from scipy import stats
from torch import Tensor

from bcppl.beliefs import normalised
from bcppl.inference.population import Population

RUNS = 20


def agrees(errors: np.ndarray, resolution: float) -> None:
    """The mean of Zhat / Z is 1 within 3 standard errors, and known to `resolution`."""
    ratios = np.exp(errors)
    error = ratios.std(ddof=1) / math.sqrt(len(ratios))
    print("Zhat / Z", ratios.mean(), "+-", error, "sd of log Zhat", errors.std(ddof=1))
    assert abs(ratios.mean() - 1) < allowed(3.0, len(ratios)) * error
    assert error < resolution


def allowed(deviations: float, runs: int) -> float:
    """Standard errors of a mean of some runs that are as rare as so many of a normal."""
    return float(stats.t.isf(stats.norm.sf(deviations), runs - 1))


def posterior_agrees(populations: list[Population], read: Callable[[Any], Tensor], exact: Tensor) -> None:
    """The weighted mean of something, over runs, within 3.5 standard errors of what it is."""
    found = torch.stack(
        [torch.tensordot(normalised(p.log_weights), read(p.trace), dims=1) for p in populations]
    )
    error = found.std(0) / math.sqrt(len(found))
    print("found", found.mean(0), "+-", error, "exact", exact)
    assert bool(((found.mean(0) - exact).abs() < allowed(3.5, len(found)) * error + 1e-5).all())
    assert bool((error < 0.1 * exact.abs()).all())
