"""Programs whose sites depend on a latent choice, with exact evidence and exact draws of the posterior."""

from __future__ import annotations

import math

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from bcppl.inference.population import Population
from bcppl.inference.structures import Jump, Strata
from bcppl.traces import Structure, Trace, generate, structural
from tests.invariance import matrix, number

PRIOR = matrix([0.5, 0.3, 0.2])
SPREADS = (1.0, 1.5, 0.7)
SEEN = matrix([1.2, 0.4, 2.0])


def summed(places: int) -> None:
    """One to three terms, whose sum is seen several times with noise of deviation 1."""
    count = structural("count", dist.Categorical(PRIOR)) + 1
    terms = [pyro.sample(f"term_{j}", dist.Normal(number(0.0), SPREADS[j])) for j in range(count)]
    total = terms[0] if count == 1 else torch.stack(terms).sum(dim=0)
    with pyro.plate("places", places):
        pyro.sample("y", dist.Normal(total, 1.0))


def log_evidences() -> Tensor:
    """Log p(y, count) of `summed` for each count (3,): the sum is normal."""
    logs = []
    for count in (1, 2, 3):
        variance = sum(s**2 for s in SPREADS[:count])
        covariance = torch.eye(3, dtype=torch.float64) + variance
        seen = torch.distributions.MultivariateNormal(torch.zeros(3, dtype=torch.float64), covariance)
        logs.append(seen.log_prob(SEEN) + PRIOR[count - 1].log())
    return torch.stack(logs)


EVIDENCES = log_evidences()
LOG_EVIDENCE = float(torch.logsumexp(EVIDENCES, 0))
POSTERIOR_OF_COUNT = torch.softmax(EVIDENCES, 0)


def terms_given(count: int) -> torch.distributions.MultivariateNormal:
    """The posterior of the terms (count,): precision diag(1/s^2) + 3 11'."""
    precision = torch.diag(matrix([1 / s**2 for s in SPREADS[:count]])) + 3.0
    mean = torch.linalg.solve(precision, torch.full((count,), float(SEEN.sum()), dtype=torch.float64))
    return torch.distributions.MultivariateNormal(mean, precision_matrix=precision)


def exact_strata(particles: int) -> Strata:
    """Strata of exact draws, as many of each structure as its probability asks for."""
    parts, founded = [], 0
    for count in (1, 2, 3):
        number_of = round(particles * float(POSTERIOR_OF_COUNT[count - 1]))
        draws = terms_given(count).sample((number_of,))
        structure = Structure({"count": count - 1})
        trace, _ = generate(summed, (3,), {"y": SEEN, **structure.observations}, number_of)
        trace = trace.at({f"term_{j}": draws[:, j].contiguous() for j in range(count)})
        founders = torch.arange(founded, founded + number_of)
        weights = torch.zeros(number_of, dtype=torch.float64)
        parts.append((structure, Population(trace, weights, founders=founders)))
        founded += number_of
    return Strata.of(parts, LOG_EVIDENCE)


def split(trace: Trace) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """The last term becomes two, the sum half kept: a map with Jacobian 3."""
    last = len(trace.choices) - 1
    part = pyro.sample("part", dist.Normal(0.2 * trace[f"term_{last}"], 0.8))
    return {
        f"term_{last}": trace[f"term_{last}"] - part,
        f"term_{last + 1}": 3.0 * part + trace[f"term_{last}"],
    }, {}


def merged(trace: Trace) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    last = len(trace.choices) - 2
    first, second = trace[f"term_{last}"], trace[f"term_{last + 1}"]
    # second = 3 part + (first + part)
    part = (second - first) / 4.0
    return {f"term_{last}": first + part}, {"part": part}


def more(structure: Structure) -> dict[str, int] | None:
    return {"count": structure["count"] + 1} if structure["count"] < 2 else None


def fewer(structure: Structure) -> dict[str, int] | None:
    return {"count": structure["count"] - 1} if structure["count"] > 0 else None


SLIPS, SLIP_SPREAD, NOISE = 0.15, 2.0, 0.7


def slipping(touches: int) -> None:
    """A place that is touched; before one of the touches it may slip, and is elsewhere from then on."""
    place, slipped = pyro.sample("place", dist.Normal(number(0.0), 1.5)), False
    for k in range(touches):
        if not slipped and structural(f"slips_{k}", dist.Bernoulli(SLIPS)):
            place, slipped = place + pyro.sample("slip", dist.Normal(number(0.0), SLIP_SPREAD)), True
        pyro.sample(f"y_{k}", dist.Normal(place, NOISE))


def slip_evidences(seen: Tensor) -> Tensor:
    """Log p(y, first touch after the slip) for each touch, and for no slip at all, (T + 1,)."""
    count = len(seen)
    logs = []
    for k in range(count + 1):
        after = (torch.arange(count) >= k).to(torch.float64)
        covariance = 1.5**2 + SLIP_SPREAD**2 * after[:, None] * after + NOISE**2 * torch.eye(count).double()
        normal = torch.distributions.MultivariateNormal(torch.zeros(count).double(), covariance)
        prior = k * math.log(1 - SLIPS) + (math.log(SLIPS) if k < count else 0.0)
        logs.append(normal.log_prob(seen) + prior)
    return torch.stack(logs)


def nudge(trace: Trace) -> None:
    """A random walk of all terms."""
    for address in trace.choices:
        pyro.sample(address, dist.Normal(trace[address], 0.6))


birth = Jump(more, fewer, split, merged)
