"""Structural sites: one value for all particles of a trace, on which the program branches."""

from __future__ import annotations

from typing import Any

import pyro
import pyro.distributions as dist
import pytest
import torch

from bcppl.errors import InputError, NoWeightError
from bcppl.inference.structures import generate_strata
from bcppl.traces import (
    ProgramError,
    Structure,
    check_program,
    extend,
    generate,
    simulate,
    structural,
    update,
)
from bcppl.traces.structural import UnchosenError
from tests.inference.structures.structural_programs import PRIOR, SEEN, SPREADS, slipping, summed
from tests.invariance import number
from tests.small_programs import normal_log


def test_a_trace_is_conditioned_on_its_structure() -> None:
    trace, log_weight = generate(summed, (3,), {"count": torch.tensor(1), "y": SEEN}, 5)
    assert list(trace.choices) == ["term_0", "term_1"] and trace.structure == {"count": 1}
    total = trace["term_0"] + trace["term_1"]
    expected = PRIOR[1].log() + normal_log(SEEN, total[:, None], 1.0).sum(1)
    torch.testing.assert_close(log_weight, expected)
    latent = sum(normal_log(trace[f"term_{j}"], 0.0, SPREADS[j]) for j in range(2))
    torch.testing.assert_close(trace.log_prob(), expected + latent)
    assert trace[[3, 0]].structure == trace.structure
    assert update(trace, {"term_0": trace["term_0"] + 1.0}).trace.structure == trace.structure


@pytest.mark.parametrize(
    "site", [dist.Bernoulli(0.2), dist.Poisson(1.0), dist.Binomial(3, 0.5), dist.Categorical(torch.ones(2))]
)
def test_values_are_whole_numbers_whatever_the_type_of_the_site(site: dist.TorchDistribution) -> None:
    def program() -> int:
        return structural("k", site)

    expected = site.log_prob(torch.tensor(1.0)).to(torch.float64).expand(4)
    for observed in (Structure({"k": 1}).observations, {"k": torch.tensor(1)}):
        trace, log_weight = generate(program, (), observed, 4)
        assert trace.result == 1 and type(trace.result) is int
        torch.testing.assert_close(log_weight, expected, rtol=1e-6, atol=1e-6)


def test_a_structure_without_value_is_refused_and_names_what_to_use() -> None:
    with pytest.raises(UnchosenError, match=r"'count' determines which sites .* generate_strata"):
        simulate(summed, (3,), 4)
    with pytest.raises(InputError, match="generate_strata"):
        generate(summed, (3,), {"y": SEEN}, 4)
    trace, _ = generate(slipping, (0,), {}, 4)
    with pytest.raises(UnchosenError) as raised:
        extend(trace, (1,), {"y_0": number(0.3)})
    assert raised.value.address == "slips_0" and torch.equal(raised.value.values["place"], trace["place"])


def test_one_value_for_each_particle_is_refused() -> None:
    with pytest.raises(InputError, match="'count' is given values that differ"):
        generate(summed, (3,), {"y": SEEN}, 3, {"count": torch.tensor([0.0, 1.0, 0.0])})


def test_a_structural_site_may_depend_on_what_came_before() -> None:
    def program() -> None:
        rate = pyro.sample("rate", dist.Gamma(number(2.0), 1.0))
        if structural("k", dist.Poisson(rate)):
            pyro.sample("x", dist.Normal(number(0.0), 1.0))

    trace, log_weight = generate(program, (), Structure({"k": 2}).observations, 6)
    torch.testing.assert_close(log_weight, dist.Poisson(trace["rate"]).log_prob(number(2.0)))
    assert list(trace.choices) == ["rate", "x"]


def test_an_update_to_another_structure_weighs_what_vanishes_and_what_is_new() -> None:
    trace, _ = generate(summed, (3,), {"count": torch.tensor(2), "y": SEEN}, 5)
    to = {"y": SEEN, **Structure({"count": 0}).observations}
    updated = update(trace, args=(3,), observations=to)
    assert updated.trace.structure == {"count": 0} and list(updated.trace.choices) == ["term_0"]
    torch.testing.assert_close(updated.log_ratio, updated.trace.log_prob() - trace.log_prob())
    back = update(updated.trace, args=(3,), observations=Structure({"count": 2}).observations)
    assert back.drawn == {"term_1", "term_2"}


def test_structures_compare_by_their_values() -> None:
    first, second = Structure({"a": 1, "b": 0}), Structure({"b": 0, "a": 1})
    assert first == second == {"a": 1, "b": 0} and hash(first) == hash(second)
    assert first != Structure({"a": 1}) and len({first, second, Structure({"a": 1})}) == 2
    assert repr(first) == "Structure(a=1, b=0)"


def test_a_program_is_checked_for_each_structure_by_itself() -> None:
    for count in range(3):
        check_program(summed, (3,), {"y": SEEN, **Structure({"count": count}).observations})

    def writes(places: int) -> None:
        """One structure is right, the other writes into the value of a site."""
        x = pyro.sample("x", dist.Normal(number(0.0), 1.0))
        if structural("doubled", dist.Bernoulli(0.5)):
            x *= 2.0
        pyro.sample("y", dist.Normal(x, 1.0))

    check_program(writes, (1,), {"y": number(0.4), "doubled": number(0.0)})
    with pytest.raises(ProgramError, match="'x'"):
        check_program(writes, (1,), {"y": number(0.4), "doubled": number(1.0)})


@pytest.mark.parametrize("site", [dist.Categorical, dist.Bernoulli], ids=["categorical", "bernoulli"])
def test_a_structure_of_prior_zero_has_no_weight(site: Any) -> None:
    """Torch rounds a probability of 0 up to e^-36, all the weight of a structure that is asked for alone."""
    probabilities = torch.tensor([1.0, 0.0]).double() if site is dist.Categorical else number(0.0)

    def program() -> None:
        pyro.sample("y", dist.Normal(number(float(structural("on", site(probabilities)))), 1.0))

    trace, log_weight = generate(program, (), {"on": 1, "y": 0.2}, 5)
    assert bool((log_weight == -torch.inf).all()) and bool((trace.log_prob("y") > -torch.inf).all())
    assert generate_strata(program, (), {"y": 0.2}, 10).shares[Structure({"on": 0})] == 1.0
    with pytest.raises(NoWeightError, match="the value at 'on' is impossible"):
        _ = generate_strata(program, (), {"y": 0.2, "on": 1}, 10).shares
