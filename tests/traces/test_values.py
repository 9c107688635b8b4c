"""Observations and values are tensors, arrays or numbers; a site that cannot be sampled is named."""

from __future__ import annotations

from typing import Any

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from bcppl.distributions.lazy import LazyDistribution
from bcppl.errors import InputError
from bcppl.inference import Observed, importance_sampling, tempered
from bcppl.inference.kernels import metropolis_hastings
from bcppl.inference.proposals import drift
from bcppl.traces import Series, assess, extend, generate, simulate, update
from bcppl.traces.anticipated import Anticipated
from bcppl.traces.differentiation.programs import log_prob_with_grad
from tests.invariance import number
from tests.small_programs import normal_log

N = 4


def program(count: int = 1) -> None:
    x = pyro.sample("x", dist.Normal(number(0.0), 1.0))
    for k in range(count):
        pyro.sample(f"y_{k}", dist.Normal(x, 1.0))
    pyro.sample("pair", dist.Normal(torch.zeros(2, dtype=torch.float64), 1.0).to_event(1))


PAIR = np.array([0.1, 0.2])
KINDS: dict[str, Any] = {
    "float": 0.25,
    "whole number": 2,
    "numpy float": np.float64(0.25),
    "numpy float32": np.float32(0.25),
    "array": np.array(0.25),
    "tensor": torch.tensor(0.25),
}


@pytest.mark.parametrize("kind", KINDS)
def test_every_verb_takes_numbers_and_arrays(kind: str) -> None:
    given, value = KINDS[kind], number(float(KINDS[kind]))
    torch.manual_seed(0)
    trace, weight = generate(program, (), {"y_0": given, "pair": PAIR}, N)
    expected = normal_log(value, trace["x"], 1.0)
    torch.testing.assert_close(weight - trace.log_prob("pair"), expected)
    assert trace["y_0"].dtype == (
        torch.float64 if kind in ("float", "numpy float", "array") else trace["y_0"].dtype
    )
    longer, more = extend(trace, (2,), {"y_1": given})
    torch.testing.assert_close(more, expected)
    torch.testing.assert_close(update(longer, observations={"y_1": given}).log_ratio, torch.zeros(N).double())
    moved = update(trace, {"x": np.full(N, 0.5)}).trace
    torch.testing.assert_close(moved["x"], torch.full((N,), 0.5, dtype=torch.float64))
    population = importance_sampling(program, (), {"y_0": given, "pair": PAIR}, N)
    torch.testing.assert_close(population.trace["y_0"], trace["y_0"])
    assert assess(program, (), {"x": np.zeros(N), "y_0": given, "pair": PAIR}, N).shape == (N,)


SHARES = torch.tensor([0.2, 0.5, 0.3], dtype=torch.float64)
DISCRETE: dict[str, tuple[Any, Any]] = {
    "Bernoulli": (dist.Bernoulli(number(0.3)), 1),
    "Bernoulli of logits": (dist.Bernoulli(logits=number(-0.4)), 0),
    "masked Bernoulli": (dist.Bernoulli(number(0.3)).mask(torch.tensor(True)), 1),
    "several Bernoullis": (dist.Bernoulli(SHARES).to_event(1), [1, 0, 1]),
    "mixture": (dist.MixtureSameFamily(dist.Categorical(SHARES), dist.Bernoulli(SHARES)), 1),
    "Binomial": (dist.Binomial(number(5.0), number(0.3)), 2),
    "BetaBinomial": (dist.BetaBinomial(number(2.0), number(1.0), 5), 2),
    "Categorical": (dist.Categorical(SHARES), 2),
    "Geometric": (dist.Geometric(number(0.3)), 2),
    "Poisson": (dist.Poisson(number(3.0)), 255),
    "GammaPoisson": (dist.GammaPoisson(number(2.0), number(1.0)), 2),
    "NegativeBinomial": (dist.NegativeBinomial(number(3.0), number(0.2)), 2),
    "ZeroInflatedPoisson": (dist.ZeroInflatedPoisson(number(3.0), gate=number(0.2)), 0),
    "OrderedLogistic": (dist.OrderedLogistic(number(0.2), torch.tensor([-1.0, 1.0]).double()), 1),
    "Multinomial": (dist.Multinomial(3, SHARES), [1, 0, 2]),
    "DirichletMultinomial": (dist.DirichletMultinomial(1.0 + SHARES, 3), [1, 0, 2]),
    "OneHotCategorical": (dist.OneHotCategorical(SHARES), [0, 1, 0]),
}


@pytest.mark.parametrize("name", DISCRETE)
def test_whole_numbers_of_any_type_have_the_density_of_floats(name: str) -> None:
    distribution, value = DISCRETE[name]

    def counted() -> None:
        pyro.sample("x", dist.Normal(number(0.0), 1.0))
        pyro.sample("y", distribution)

    expected = distribution.log_prob(torch.tensor(value, dtype=torch.float64))
    kinds = [np.array(value), torch.tensor(value), np.array(value, np.uint8), torch.tensor(value).int()]
    kinds += [value, np.int64(value)] if isinstance(value, int) else []
    kinds += [torch.tensor(value).bool(), np.array(value, bool)] if set(np.ravel(value)) <= {0, 1} else []
    for given in kinds:
        trace, weight = generate(counted, (), {"y": given}, N)
        torch.testing.assert_close(weight, expected.expand(N), rtol=1e-12, atol=0.0)
        x = trace["x"].requires_grad_()
        torch.testing.assert_close(log_prob_with_grad(trace, {"x": x}), trace.log_prob("x"))
        assert trace["y"].dtype == torch.as_tensor(given).dtype  # the program may take it for an index


def test_a_class_of_a_user_gets_whole_numbers_as_they_are() -> None:
    class Table(dist.Categorical):
        def log_prob(self, value: Tensor) -> Tensor:
            return SHARES.log()[value]

    def looked_up() -> None:
        pyro.sample("y", Table(SHARES))

    _, weight = generate(looked_up, (), {"y": 1}, N)
    torch.testing.assert_close(weight, SHARES.log()[1].expand(N))


def test_steps_and_forward_kernels_take_numbers() -> None:
    torch.manual_seed(0)
    population = importance_sampling(program, (0,), {"pair": PAIR}, N)
    later, _ = tempered(metropolis_hastings(drift("x")))(population, Observed((1,), {"y_0": 0.25}))
    torch.testing.assert_close(later.trace["y_0"], number(0.25))
    assert torch.equal(Anticipated(population.trace, (1,), {"y_0": 0.25})["y_0"], number(0.25))


def test_a_step_of_a_series_takes_numbers() -> None:
    walk = Series(
        lambda: pyro.sample("x", dist.Normal(number(0.0), 1.0)),
        lambda x: pyro.sample("y", dist.Normal(x, 1.0)),
    )
    trace, _ = generate(walk, (), {}, N)
    longer, weight = extend(trace, (), {"y": 0.25})
    torch.testing.assert_close(weight, normal_log(number(0.25), trace["x"], 1.0))
    assert longer["y"].dtype == torch.float64


def test_an_array_that_is_written_to_again_changes_no_trace() -> None:
    pair = PAIR.copy()
    trace, _ = generate(program, (), {"y_0": 0.25, "pair": pair}, N)
    pair[:] = 7.0
    assert trace["pair"].tolist() == PAIR.tolist()


@pytest.mark.parametrize(
    ("value", "kind"), [("0.25", "str"), (np.array(["a"]), "<U1 array"), (None, "NoneType")]
)
def test_what_is_no_number_is_refused(value: Any, kind: str) -> None:
    with pytest.raises(
        InputError, match=f"address 'y_0' is a {kind}; give a tensor, a numpy array or a number"
    ):
        generate(program, (), {"y_0": value, "pair": PAIR}, N)


class NoSampler(LazyDistribution):
    def __init__(self, x: Tensor) -> None:
        self.x = x
        super().__init__(len(x), ())

    def log_prob(self, value: Tensor) -> Tensor:
        return normal_log(value, self.x, 1.0)


def test_a_site_that_cannot_be_sampled_is_named() -> None:
    def lazy() -> None:
        pyro.sample("y", NoSampler(pyro.sample("x", dist.Normal(number(0.0), 1.0))))

    sentence = (
        "site 'y' is to be sampled, but its distribution NoSampler defines no `sample`; give the site an"
    )
    with pytest.raises(InputError, match=sentence):
        simulate(lazy, (), N)
    with pytest.raises(InputError, match=sentence):
        generate(lazy, (), {}, N)
    assert generate(lazy, (), {"y": 0.25}, N)[1].shape == (N,)


@pytest.mark.parametrize("site", [dist.Normal(number(0.2), 1.0), dist.Bernoulli(number(0.2))])
def test_true_is_one(site: Any) -> None:
    def program() -> None:
        pyro.sample("y", site)

    _, log_weight = generate(program, (), {"y": True}, 3)
    torch.testing.assert_close(log_weight, site.log_prob(number(1.0)).expand(3))
