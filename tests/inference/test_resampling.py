"""Resampling: every scheme is unbiased and right at a million particles, and when it is done."""

from __future__ import annotations

import math
from functools import cache

import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from bcppl.errors import InputError, NotANumberError, NoWeightError
from bcppl.inference.population import Population
from bcppl.inference.resampling import (
    Scheme,
    adaptive,
    always,
    multinomial,
    never,
    residual,
    ssp,
    stratified,
    systematic,
)
from bcppl.traces import generate

SCHEMES: dict[str, Scheme] = {
    "multinomial": multinomial,
    "residual": residual,
    "stratified": stratified,
    "systematic": systematic,
    "ssp": ssp,
}
UNEVEN = torch.tensor([-torch.inf, 0.0, -1.0, 2.0, -torch.inf, 0.5, -3.0, 1.0, -torch.inf]).double()


def copies(scheme: Scheme, count: int, runs: int) -> Tensor:
    """The number of offspring of each particle (runs, 9)."""
    return torch.stack(
        [torch.bincount(scheme(UNEVEN, count), minlength=len(UNEVEN)) for _ in range(runs)]
    ).double()


@cache
def drawn(name: str, count: int) -> Tensor:
    torch.manual_seed(0)
    return copies(SCHEMES[name], count, 2500 if count == 7 else 1200)


def standard_errors(found: Tensor, share: Tensor) -> float:
    error = (found.mean(0) - share).abs() / (found.std(0) / math.sqrt(len(found))).clamp_min(1e-9)
    return float(error.max())


@pytest.mark.parametrize("count", [7, 1, 40])
@pytest.mark.parametrize("name", SCHEMES)
def test_expected_copies_are_right(name: str, count: int) -> None:
    share = count * torch.softmax(UNEVEN, 0)
    found = drawn(name, count)
    assert standard_errors(found, share) < 4.5
    assert bool((found.sum(1) == count).all()), "as many as were asked for"
    assert float(found[:, torch.isneginf(UNEVEN)].sum()) == 0, "no weight, no copies"
    if name in ("systematic", "ssp"):
        assert bool((found >= share.floor()).all()) and bool((found <= share.floor() + 1).all())
    if name == "residual":
        assert bool((found >= share.floor()).all())
    if name == "stratified":
        assert float((found - share).abs().max()) < 2
    if name == "multinomial" and count > 1:
        exact = share * (1 - share / count)
        assert bool(((found.var(0) - exact).abs() <= 0.15 * exact).all())


def test_ssp_draws_are_negatively_associated() -> None:
    """The number in any stretch varies no more than the sum of the numbers of its particles."""
    found = drawn("ssp", 7)
    for first in range(1, 6):
        for last in range(first + 2, 9):
            stretch = found[:, first:last]
            assert float(stretch.sum(1).var()) <= float(stretch.var(0).sum()) + 0.03


def test_mutant_that_always_rounds_the_larger_part_up(monkeypatch: pytest.MonkeyPatch) -> None:
    torch.manual_seed(0)
    real = torch.rand
    monkeypatch.setattr(torch, "rand", lambda *size, **kind: real(*size, **kind) * 0.5)
    for scheme in (systematic, stratified, ssp):
        assert standard_errors(copies(scheme, 7, 500), 7 * torch.softmax(UNEVEN, 0)) > 8


@pytest.mark.parametrize("name", SCHEMES)
def test_a_million_particles(name: str) -> None:
    torch.manual_seed(0)
    count = 1_000_000
    log_weights = torch.linspace(0.0, 3.0, count, dtype=torch.float64)
    log_weights[::7] = -torch.inf
    log_weights[-3:] = -torch.inf
    ancestors = SCHEMES[name](log_weights)
    assert len(ancestors) == count and ancestors.dtype == torch.int64
    assert int(ancestors.min()) >= 0 and int(ancestors.max()) < count - 3
    got = torch.bincount(ancestors, minlength=count).double()
    assert float(got[log_weights == -torch.inf].sum()) == 0
    share = count * torch.softmax(log_weights, 0)
    furthest = {"systematic": 1.0, "ssp": 1.0, "stratified": 2.0, "residual": 12.0, "multinomial": 20.0}
    assert float((got - share).abs().max()) < furthest[name] + 1e-6
    tenth = torch.arange(count) // 100_000
    within = torch.zeros(10).double().index_add_(0, tenth, got - share)
    assert float(within.abs().max()) < 6 * math.sqrt(2e5)
    if name in ("systematic", "ssp"):
        assert torch.equal(SCHEMES[name](torch.zeros(count, dtype=torch.float64)), torch.arange(count))


def test_counting_gives_the_same_ancestors_as_searching() -> None:
    for seed in range(20):
        torch.manual_seed(seed)
        log_weights, count = torch.randn(1000, dtype=torch.float64) * seed, 1000 + 100 * seed
        state = torch.get_rng_state()
        found = systematic(log_weights, count)
        torch.set_rng_state(state)
        points = (torch.arange(count, dtype=torch.float64) + torch.rand((), dtype=torch.float64)) / count
        searched = torch.searchsorted(torch.softmax(log_weights, 0).cumsum(0), points, right=True)
        assert torch.equal(found, searched.clamp_max(999))


@pytest.mark.parametrize("name", ["systematic", "stratified"])
@pytest.mark.parametrize("count", [3, 1_000_000])
def test_the_last_point_falls_to_a_particle_with_weight(
    name: str, count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    def almost_one(*size: int, **_: object) -> Tensor:
        return torch.full(size if size and isinstance(size[0], int) else (), 1 - 2**-53, dtype=torch.float64)

    monkeypatch.setattr(torch, "rand", almost_one)
    log_weights = torch.full((count,), -1.2345, dtype=torch.float64)
    log_weights[-1] = -torch.inf
    assert int(SCHEMES[name](log_weights).max()) == count - 2


@pytest.mark.parametrize("name", SCHEMES)
def test_what_cannot_be_resampled(name: str) -> None:
    with pytest.raises(NoWeightError, match="no particle has any weight left"):
        SCHEMES[name](torch.full((4,), -torch.inf, dtype=torch.float64))
    with pytest.raises(NotANumberError, match="not a number"):
        SCHEMES[name](torch.tensor([0.0, torch.nan], dtype=torch.float64))
    with pytest.raises(InputError, match="the count 0"):
        SCHEMES[name](torch.zeros(4, dtype=torch.float64), 0)


def test_when_to_resample() -> None:
    def program() -> None:
        pyro.sample("x", dist.Normal(torch.tensor(0.0, dtype=torch.float64), 1.0))

    trace, _ = generate(program, (), {}, 4)
    even = Population(trace, torch.tensor([0.0, 0.0, 0.0, -0.1], dtype=torch.float64), -3.0)
    uneven = Population(trace, torch.tensor([0.0, -9.0, -9.0, -9.0], dtype=torch.float64), -3.0)
    assert never(uneven) == (uneven, None)
    assert adaptive(systematic, 0.5)(even) == (even, None)
    for resample, population in (
        (adaptive(systematic, 0.5), uneven),
        (always(), uneven),
        (always(), even),
    ):
        chosen, ancestors = resample(population)
        assert ancestors is not None and float(chosen.log_weights.abs().max()) == 0.0
        assert chosen.log_evidence == -3.0, "resampling leaves the evidence"
    assert float((always()(uneven)[0].trace["x"] == trace["x"][0]).double().mean()) == 1.0
