"""Strata against exact posteriors over structures: generated, resampled, extended, tempered."""

from __future__ import annotations

import math
from types import SimpleNamespace

import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from bcppl.errors import InputError
from bcppl.inference import Observed
from bcppl.inference.kernels import metropolis_hastings
from bcppl.inference.structures import (
    Jump,
    Strata,
    allotment,
    by_structure,
    extend_strata,
    generate_strata,
    generation,
    in_turn,
    jump,
    mean,
    probabilities,
    resample_strata,
    sample_strata,
    tempered_strata,
    within,
)
from bcppl.inference.structures.generation import allotted
from bcppl.inference.targets import POSTERIOR
from bcppl.traces import Series, Structure, structural
from tests.inference.structures.structural_programs import (
    EVIDENCES,
    LOG_EVIDENCE,
    POSTERIOR_OF_COUNT,
    SEEN,
    birth,
    exact_strata,
    nudge,
    slip_evidences,
    slipping,
    summed,
    terms_given,
)
from tests.invariance import matrix, number

OBSERVED = {"y": SEEN}


def z_of_counts(strata: Strata) -> Tensor:
    """How far the estimated evidence of each structure is from the exact one, in standard errors (3,)."""
    z = []
    for count, population in enumerate(strata.populations.values()):
        weights = torch.exp(population.log_weights - population.log_total)
        relative = float((weights.square().sum() - 1.0 / len(weights)).sqrt())
        z.append((math.exp(population.log_evidence - float(EVIDENCES[count])) - 1.0) / relative)
    return torch.tensor(z)


@pytest.mark.parametrize("shares", [None, lambda s: [1.0, 6.0, 3.0][s["count"]]])
def test_evidence_is_right_for_any_allotment(shares: object) -> None:
    torch.manual_seed(0)
    strata = generate_strata(summed, (3,), OBSERVED, 30_000, shares=shares)  # type: ignore[arg-type]
    sizes = [len(each) for each in strata.populations.values()]
    assert sizes == ([10_000] * 3 if shares is None else [3001, 17_999, 9000])
    assert float(z_of_counts(strata).abs().max()) < 3.5
    assert strata.log_evidence == pytest.approx(LOG_EVIDENCE, abs=0.03)
    values, estimated = probabilities(strata, "count")
    assert values.tolist() == [0, 1, 2]
    torch.testing.assert_close(estimated, POSTERIOR_OF_COUNT, rtol=0.0, atol=0.02)
    exact = sum(float(POSTERIOR_OF_COUNT[k]) * float(terms_given(k + 1).mean[0]) for k in range(3))
    assert float(mean(strata, "term_0")) == pytest.approx(exact, abs=0.04)


def test_mutant_without_the_allotments_share_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    forgets = SimpleNamespace(log=lambda x: 0.0 if isinstance(x, float) else math.log(x), inf=math.inf)
    monkeypatch.setattr(generation, "math", forgets)
    torch.manual_seed(0)
    strata = generate_strata(summed, (3,), OBSERVED, 30_000, shares=lambda s: [1.0, 6.0, 3.0][s["count"]])
    assert float(z_of_counts(strata).abs().max()) > 20.0


def test_structures_drawn_from_the_program() -> None:
    torch.manual_seed(0)
    strata = sample_strata(summed, (3,), OBSERVED, 30_000)
    torch.testing.assert_close(probabilities(strata, "count")[1], POSTERIOR_OF_COUNT, rtol=0.0, atol=0.03)
    assert strata.log_evidence == pytest.approx(LOG_EVIDENCE, abs=0.04)


def infinite() -> None:
    """As many events as a Poisson number with an uncertain rate, each with a mark; their sum is seen.

    A factor of the program's own turns the rate's prior, Gamma(2, .5), into Gamma(2, 1) over 4.
    """
    rate = pyro.sample("rate", dist.Gamma(number(2.0), 0.5))
    pyro.factor("steeper", -0.5 * rate)
    count = structural("events", dist.Poisson(rate))
    marks = [pyro.sample(f"mark_{j}", dist.Normal(number(1.0), 0.5)) for j in range(count)]
    total = torch.stack(marks).sum(dim=0) if marks else torch.zeros_like(rate)
    pyro.sample("y", dist.Normal(total, 0.5))


def test_infinitely_many_structures_are_drawn() -> None:
    """The number of events is negative binomial, and given it the sum is normal."""
    torch.manual_seed(0)
    strata = sample_strata(infinite, (), {"y": number(3.2)}, 40_000)
    counts = torch.arange(40, dtype=torch.float64)
    prior = (counts + 1.0) * 0.5 ** (counts + 2.0)
    exact = prior * torch.exp(dist.Normal(counts, 0.5 * torch.sqrt(counts + 1.0)).log_prob(number(3.2)))
    assert strata.log_evidence == pytest.approx(float(exact.sum().log()) - math.log(4.0), abs=0.06)
    for structure, share in strata.shares.items():
        assert share == pytest.approx(float(exact[structure["events"]] / exact.sum()), abs=0.025)
    with pytest.raises(InputError, match=r"'events' has no finite list of values.*sample_strata"):
        generate_strata(infinite, (), {"y": number(3.2)}, 100)


def nested(observed: int) -> None:
    """A site that exists only under one value of another."""
    if structural("tool", dist.Bernoulli(0.3)):
        kind = structural("kind", dist.Categorical(matrix([0.2, 0.5, 0.3])))
        length = pyro.sample("length", dist.Normal(number(float(kind)), 0.5))
    else:
        length = pyro.sample("length", dist.Normal(number(0.0), 2.0))
    for k in range(observed):
        pyro.sample(f"y_{k}", dist.Normal(length, 0.5))


def test_nested_structures() -> None:
    torch.manual_seed(0)
    strata = generate_strata(nested, (1,), {"y_0": number(1.6)}, 40_000)
    assert strata.structures == [
        {"tool": 0},
        {"tool": 1, "kind": 0},
        {"tool": 1, "kind": 1},
        {"tool": 1, "kind": 2},
    ]
    likelihood = [dist.Normal(m, s).log_prob(number(1.6)).exp() for m, s in ((0.0, 4.25**0.5),)]
    likelihood += [dist.Normal(float(k), 0.5**0.5).log_prob(number(1.6)).exp() for k in range(3)]
    exact = matrix([0.7, 0.3 * 0.2, 0.3 * 0.5, 0.3 * 0.3]) * torch.stack(likelihood)
    shares = matrix(list(strata.shares.values()))
    torch.testing.assert_close(shares, exact / exact.sum(), rtol=0.0, atol=0.01)
    values, share = probabilities(strata, "kind")
    assert values.tolist() == [0, 1, 2] and float(share.sum()) == pytest.approx(1 - float(shares[0]))
    assert strata["length"].shape == (40_000,) and strata["y_0"].shape == (40_000,)
    with pytest.raises(InputError, match="no value at 'kind'"):
        _ = strata["kind"]
    visiting = strata.visiting("kind")
    assert len(visiting.structures) == 3 and visiting["kind"].unique().tolist() == [0.0, 1.0, 2.0]
    given = strata.given({"tool": 1})
    assert given.log_evidence == pytest.approx(float(exact[1:].sum().log()), abs=0.03)
    assert sum(given.shares.values()) == pytest.approx(1.0)
    with pytest.raises(InputError, match="no stratum has"):
        strata.given({"tool": 7})
    with pytest.raises(InputError, match="no structural site"):
        probabilities(strata, "length")


def test_a_structural_site_that_is_observed_is_conditioned_on() -> None:
    torch.manual_seed(0)
    given = {"y_0": number(1.6), "tool": number(1.0)}
    strata = generate_strata(nested, (1,), given, 6000)
    assert [s["tool"] for s in strata.structures] == [1, 1, 1]
    likelihood = torch.stack([dist.Normal(float(k), 0.5**0.5).log_prob(number(1.6)).exp() for k in range(3)])
    exact = 0.3 * (matrix([0.2, 0.5, 0.3]) * likelihood).sum()
    assert strata.log_evidence == pytest.approx(float(exact.log()), abs=0.05)
    assert sample_strata(nested, (1,), given, 6000).log_evidence == pytest.approx(float(exact.log()), abs=0.1)


def resampled_means(least: int, repeats: int = 400) -> Tensor:
    """Errors (repeats, 4) of the share of each structure and of a mean, after resampling to few."""
    torch.manual_seed(1)
    strata = generate_strata(summed, (3,), OBSERVED, 120, shares=lambda s: [3.0, 2.0, 1.0][s["count"]])
    weights = torch.softmax(strata.log_weights, 0)
    before = [*strata.shares.values(), float(weights @ strata["term_0"])]
    rows = []
    for _ in range(repeats):
        few = resample_strata(strata, 30, least=least)
        assert len(few) == 30 and few.log_evidence == strata.log_evidence
        shares = [few.shares.get(s, 0.0) for s in strata.structures]
        rows.append([*shares, float(mean(few, "term_0"))])
    return matrix(rows) - matrix(before)


@pytest.mark.parametrize("least", [0, 3, 10])
def test_resampling_across_strata_is_unbiased(least: int) -> None:
    errors = resampled_means(least)
    spread = errors.std(dim=0)
    if least:
        # The numbers of particles are fixed, so no structure's weight changes.
        assert float(errors[:, :3].abs().max()) < 1e-12
        errors, spread = errors[:, 3:], spread[3:]
    assert float((errors.mean(dim=0) / (spread / len(errors) ** 0.5)).abs().max()) < 3.5


def test_mutant_that_forgets_the_common_scale_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = allotment._drawn
    monkeypatch.setattr(allotment, "_drawn", lambda population, index, weight: drawn(population, index, 0.0))
    assert float(resampled_means(10, 5)[:, :3].abs().max()) > 0.05


def test_a_structure_with_few_particles_keeps_the_least_number() -> None:
    torch.manual_seed(0)
    strata = exact_strata(1000)
    strata = strata.reweighed(
        {s: torch.full((len(p),), -40.0 * s["count"]).double() for s, p in strata.populations.items()}
    )
    few = resample_strata(strata, 60, least=5)
    assert [len(each) for each in few.populations.values()] == [50, 5, 5]
    assert few.shares == pytest.approx(strata.shares, abs=1e-15)
    assert resample_strata(strata, 60).structures == [{"count": 0}]
    assert len(resample_strata(strata, 2, least=5)) == 2


def test_particles_are_allotted_to_sum_and_to_the_largest_remainders() -> None:
    assert allotted([1.0, 1.0, 1.0], 11) == [4, 4, 3]
    assert allotted([0.7, 0.2, 0.1], 10, least=2) == [5, 3, 2]
    assert allotted([1.0, 0.0], 5, least=1) == [4, 1]
    with pytest.raises(InputError, match="at least 1 each"):
        allotted([1.0] * 4, 3, least=1)


TOUCHED = matrix([0.4, -0.3, 0.1, 2.2, 2.9])


@pytest.mark.parametrize("particles", [None, 3000])
def test_slipped_at_a_touch_or_never(particles: int | None) -> None:
    """A linear Gaussian change point: each touch branches the stratum that has not slipped."""
    torch.manual_seed(0)
    exact = slip_evidences(TOUCHED)
    strata = generate_strata(slipping, (0,), {}, 3000)
    for k, y in enumerate(TOUCHED):
        strata = extend_strata(strata, Observed((k + 1,), {f"y_{k}": y}))
        if particles:
            strata = resample_strata(strata, particles, least=100)
        expected = slip_evidences(TOUCHED[: k + 1])
        assert strata.log_evidence == pytest.approx(float(torch.logsumexp(expected, 0)), abs=0.2)
    assert len(strata.structures) == len(TOUCHED) + 1
    for structure, share in strata.shares.items():
        slip = next((k for k in range(len(TOUCHED)) if structure[f"slips_{k}"]), len(TOUCHED))
        assert share == pytest.approx(float(torch.softmax(exact, 0)[slip]), abs=0.1)
    assert all(("slip" in p.trace) == (sum(s.values()) > 0) for s, p in strata.populations.items())


MOVE = in_turn(within(metropolis_hastings(nudge)), jump(birth))


def evidence_ratios(repeats: int, particles: int, least: int) -> Tensor:
    """Estimates of the evidence over the exact one, (repeats, 4): of each count, and their sum."""
    temper = tempered_strata(MOVE, exponents=[0.1, 0.4, 1.0], least=least, threshold=0.9)
    rows = []
    for _ in range(repeats):
        strata, _ = temper.generate(summed, (3,), OBSERVED, particles)
        each = [strata.shares.get(Structure({"count": k}), 0.0) for k in range(3)]
        total = math.exp(strata.log_evidence - LOG_EVIDENCE)
        rows.append([*(total * share / float(POSTERIOR_OF_COUNT[k]) for k, share in enumerate(each)), total])
    return matrix(rows)


@pytest.mark.long
@pytest.mark.parametrize("least", [0, 4])
def test_tempered_evidence_is_unbiased_with_fixed_exponents(least: int) -> None:
    torch.manual_seed(0)
    ratios = evidence_ratios(20, 24, least)
    error = ratios.std(dim=0) / len(ratios) ** 0.5
    assert float(((ratios.mean(dim=0) - 1.0) / error).abs().max()) < 3.5


@pytest.mark.long
@pytest.mark.parametrize("least", [0, 4])
def test_tempered_evidence_is_unbiased_over_many_runs(least: int) -> None:
    torch.manual_seed(0)
    ratios = evidence_ratios(400, 18, least)
    error = ratios.std(dim=0) / len(ratios) ** 0.5
    assert float(((ratios.mean(dim=0) - 1.0) / error).abs().max()) < 3.5
    assert float(error[3]) < 0.02


def test_tempered_strata_with_adaptive_exponents() -> None:
    torch.manual_seed(0)
    temper = tempered_strata(in_turn(MOVE, times=2), share=0.7)
    for strata, info in (
        temper.generate(summed, (3,), OBSERVED, 3000),
        temper.sample(summed, (3,), OBSERVED, 3000),
    ):
        assert info.exponents[-1] == 1.0 and len(info.acceptance) == 3 and 0.1 < min(info.acceptance) < 1.0
        assert strata.log_evidence == pytest.approx(LOG_EVIDENCE, abs=0.1)
        torch.testing.assert_close(probabilities(strata, "count")[1], POSTERIOR_OF_COUNT, rtol=0.0, atol=0.05)


def test_tempered_strata_step_by_step() -> None:
    torch.manual_seed(0)
    walk = metropolis_hastings(nudge)
    temper = tempered_strata(within(by_structure(lambda structure: walk), sweeps=3), least=50)
    strata, _ = temper.generate(slipping, (0,), {}, 1500)
    for k, y in enumerate(TOUCHED):
        strata, info = temper.extend(strata, Observed((k + 1,), {f"y_{k}": y}), 1500)
    assert len(strata) == 1500 and info.resampled > 0
    exact = slip_evidences(TOUCHED)
    assert strata.log_evidence == pytest.approx(float(torch.logsumexp(exact, 0)), abs=0.2)
    for structure, share in strata.shares.items():
        slip = next((k for k in range(len(TOUCHED)) if structure[f"slips_{k}"]), len(TOUCHED))
        assert share == pytest.approx(float(torch.softmax(exact, 0)[slip]), abs=0.12)


def test_tempering_without_moves_reweighs_and_resamples() -> None:
    torch.manual_seed(0)
    strata, info = tempered_strata(share=0.9).generate(summed, (3,), OBSERVED, 6000)
    assert info.acceptance == () and len(info.exponents) > 1 and info.resampled > 0
    assert strata.log_evidence == pytest.approx(LOG_EVIDENCE, abs=0.15)


def test_strata_of_a_series_are_refused_where_their_pasts_would_be_mixed() -> None:
    def begin() -> Tensor:
        return structural("kind", dist.Bernoulli(0.5)) + pyro.sample("x", dist.Normal(number(0.0), 1.0))

    def step(state: Tensor) -> Tensor:
        pyro.sample("y", dist.Normal(state, 1.0))
        return state

    strata = generate_strata(Series(begin, step), (), {}, 20)
    assert strata.structures == [{"kind": 0}, {"kind": 1}]
    with pytest.raises(InputError, match="strata of a series cannot be extended"):
        extend_strata(strata, Observed((), {"y": number(0.0)}))
    other = Jump(lambda s: {"kind": 1 - s["kind"]}, lambda s: {"kind": 1 - s["kind"]})
    with pytest.raises(InputError, match="cannot be joined"):
        jump(other)(strata, POSTERIOR)


def test_tempering_refuses_exponents_that_do_not_end_with_1() -> None:
    with pytest.raises(InputError, match="end with 1"):
        tempered_strata(exponents=[0.5, 0.9])
