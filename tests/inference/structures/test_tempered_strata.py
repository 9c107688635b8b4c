"""Which sites tempered strata temper: new ones in every structure; what new arguments change counts once."""

from __future__ import annotations

import math

import pyro
import pyro.distributions as dist
import pytest
import torch

from bcppl.inference import Observed
from bcppl.inference.resampling import multinomial
from bcppl.inference.structures import (
    Jump,
    MovedStrata,
    Strata,
    extend_strata,
    generate_strata,
    in_turn,
    jump,
    resample_strata,
    tempered_strata,
)
from bcppl.inference.targets import POSTERIOR, Target
from bcppl.traces import structural
from tests.inference.structures.structural_programs import SEEN, exact_strata, summed
from tests.invariance import matrix, number

OBSERVED = {"y": SEEN}
ACROSS = Jump(
    to=lambda s: {"which": 1} if s["which"] == 0 else None,
    back=lambda s: {"which": 0} if s["which"] == 1 else None,
)


def test_old_sites_that_new_arguments_change_are_weighed_once() -> None:
    def widened(seen: bool) -> None:
        structural("s", dist.Categorical(matrix([0.5, 0.5])))
        x = pyro.sample("x", dist.Normal(number(0.0), 3.0 if seen else 1.0))
        if seen:
            pyro.sample("y", dist.Normal(x, 1.0))

    torch.manual_seed(0)
    strata = generate_strata(widened, (False,), {}, 200)
    observed = Observed((True,), {"y": number(2.5)})
    plain = extend_strata(strata, observed).log_evidence
    for temper in (tempered_strata(share=0.0), tempered_strata(exponents=[0.3, 1.0], threshold=0.0)):
        assert temper.extend(strata, observed).strata.log_evidence == pytest.approx(plain, abs=1e-9)


def test_sites_of_a_structure_that_a_jump_reaches_first_are_tempered() -> None:
    """Hardly a particle begins in the second structure, which has all of its likelihood in one factor."""

    def program() -> None:
        which = structural("which", dist.Categorical(matrix([0.99, 0.01])))
        x = pyro.sample("x", dist.Normal(number(0.0), 1.0))
        if which == 1:
            pyro.factor("bonus", math.log(99.0) + 0.0 * x)

    temper = tempered_strata(jump(ACROSS), exponents=[0.5, 1.0], least=0)
    estimates = []
    for seed in range(60):
        torch.manual_seed(seed)
        estimates.append(math.exp(temper.sample(program, (), {}, 40).strata.log_evidence))
    found = torch.tensor(estimates)
    assert abs(float(found.mean()) - 1.98) < 4.0 * float(found.std()) / math.sqrt(60)


def test_a_move_of_ones_own_is_given_the_tempered_target() -> None:
    def asked(strata: Strata, target: Target) -> MovedStrata:
        for population in strata.populations.values():
            trace, inside = population.trace, target.within(population.trace)
            assert torch.equal(target(trace), inside(trace))
            middle = inside(trace).median().expand(len(trace))
            assert torch.equal(target.above(trace, middle)[0], (inside(trace) > middle).nonzero().flatten())
            powers.append(float(((target(trace) - trace.log_prob()) / trace.log_prob("y")).mean()) + 1.0)
        return MovedStrata(strata, ())

    powers: list[float] = []
    torch.manual_seed(0)
    tempered_strata(asked, exponents=[0.3, 1.0]).generate(summed, (3,), OBSERVED, 60)
    assert powers == pytest.approx([0.3] * 3 + [1.0] * 3)


@pytest.mark.long
def test_old_sites_of_a_structure_that_was_lost_are_not_tempered() -> None:
    """Of ten particles two are left, mostly of the first structure: a jump reaches the other's factor."""

    def program(count: int) -> None:
        which = structural("which", dist.Categorical(matrix([0.95, 0.05])))
        x = pyro.sample("x", dist.Normal(number(0.0), 0.1))
        if which == 1:
            pyro.factor("old", 3.0 + 0.0 * x)
        for k in range(count):
            pyro.sample(f"y_{k}", dist.Normal(x, 1.0))

    temper = tempered_strata(jump(ACROSS), exponents=[0.1, 1.0], least=0, threshold=0.0)
    covariance = torch.eye(2, dtype=torch.float64) + 0.01
    seen = dist.MultivariateNormal(torch.zeros_like(covariance[0]), covariance).log_prob(matrix([0.3, 0.2]))
    exact = (0.95 + 0.05 * math.exp(3.0)) * math.exp(float(seen))
    ratios = []
    for seed in range(150):
        torch.manual_seed(seed)
        ten = generate_strata(program, (1,), {"y_0": number(0.3)}, 10)
        begun = resample_strata(ten, 2, least=0, scheme=multinomial)
        strata = temper.extend(begun, Observed((2,), {"y_1": number(0.2)})).strata
        ratios.append(math.exp(strata.log_evidence) / exact)
    found = torch.tensor(ratios)
    assert abs(float(found.mean()) - 1.0) < 4.0 * float(found.std()) / math.sqrt(150) + 1e-3


def test_a_jump_that_nobody_made_in_a_round_has_no_share_of_it() -> None:
    torch.manual_seed(0)
    rounds = iter([(math.nan, 0.5), (0.25, math.nan)] * 2)
    both = in_turn(lambda strata, target: MovedStrata(strata, next(rounds)), times=2)
    assert both(exact_strata(10), POSTERIOR).acceptance == (0.25, 0.5)


def test_a_particle_that_was_impossible_stays_so_where_new_arguments_allow_it() -> None:
    def program(bound: float, count: int) -> None:
        kind = structural("kind", dist.Bernoulli(number(0.5)))
        x = pyro.sample("x", dist.Normal(number(0.0), 1.0 + float(kind)))
        pyro.sample("y_0", dist.Uniform(x - bound, x + bound))
        for k in range(1, count):
            pyro.sample(f"y_{k}", dist.Normal(x, 1.0))

    strata = generate_strata(program, (1.0, 1), {"y_0": number(0.3)}, 200)
    observed = Observed((2.0, 2), {"y_1": number(0.3)})
    later = extend_strata(strata, observed)
    dead = torch.cat([p.log_weights == -torch.inf for p in strata.populations.values()])
    still = torch.cat([p.log_weights == -torch.inf for p in later.populations.values()])
    assert bool(dead.any()) and torch.equal(dead, still)
    tempered = tempered_strata(share=0.0).extend(strata, observed).strata
    assert tempered.log_evidence == pytest.approx(later.log_evidence)
