"""Reversible jumps at their edges: from a structure without latent sites, and a volume that is cut."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from bcppl.errors import InputError
from bcppl.inference import importance_sampling, rejuvenate
from bcppl.inference.filters.smcp3 import Pair, move_and_weight
from bcppl.inference.kernels import involutive
from bcppl.inference.population import Population
from bcppl.inference.structures import Jump, Strata, generate_strata, jump, probabilities, resample_strata
from bcppl.inference.targets import POSTERIOR
from bcppl.traces import Structure, Trace, generate, structural
from tests.invariance import number

Given = tuple[dict[str, Tensor], dict[str, Tensor]]


def summed(least: int) -> None:
    count = structural("count", dist.Categorical(torch.tensor([0.4, 0.6]).double())) + least
    terms = [pyro.sample(f"x{j}", dist.Normal(number(0.0), 1.0)) for j in range(count)]
    pyro.sample("y", dist.Normal(sum(terms) + number(0.0), 0.5))


def more(structure: Structure) -> Mapping[str, int] | None:
    return {"count": 1} if structure["count"] == 0 else None


def fewer(structure: Structure) -> Mapping[str, int] | None:
    return {"count": 0} if structure["count"] == 1 else None


def posterior(least: int) -> float:
    """The probability of the larger structure at y = 1.7."""
    scales = [(0.25 + least + k) ** 0.5 for k in range(2)]
    each = [0.4 + 0.2 * k for k in range(2)]
    seen = [
        w * float(dist.Normal(0.0, s).log_prob(number(1.7)).exp()) for w, s in zip(each, scales, strict=True)
    ]
    return seen[1] / sum(seen)


@pytest.mark.parametrize("check", [False, True])
def test_a_structure_without_latent_sites_is_jumped_from_and_to(check: bool) -> None:
    torch.manual_seed(0)
    shares = []
    for _ in range(12):
        strata = resample_strata(generate_strata(summed, (0,), {"y": 1.7}, 2000), 300)
        for _ in range(2):
            strata, _ = jump(Jump(more, fewer, check=check))(strata, POSTERIOR)
        shares.append(probabilities(strata, "count").probabilities[-1])
    runs = torch.stack(shares)
    assert abs(float(runs.mean()) - posterior(0)) < 4.0 * float(runs.std()) / 12**0.5 + 1e-3


def split(trace: Trace, cut: bool) -> Given:
    apart = pyro.sample("apart", dist.Normal(number(0.0), 1.0))
    other = apart.detach() if cut else apart
    return {"x0": trace["x0"] / 2 - other, "x1": trace["x0"] / 2 + apart}, {}


def join(trace: Trace) -> Given:
    return {"x0": trace["x0"] + trace["x1"]}, {"apart": (trace["x1"] - trace["x0"]) / 2}


def in_two() -> Strata:
    return resample_strata(generate_strata(summed, (1,), {"y": 1.7}, 500), 100)


def test_a_check_sees_a_choice_that_is_detached_in_part() -> None:
    torch.manual_seed(0)
    whole = Jump(more, fewer, partial(split, cut=False), join, check=True)
    jump(whole)(in_two(), POSTERIOR)
    cut = Jump(more, fewer, partial(split, cut=True), join, check=True)
    with pytest.raises(InputError, match=r"Jacobian of a translator .* have to cancel"):
        jump(cut)(in_two(), POSTERIOR)


def test_a_check_of_a_pair_sees_a_value_that_is_detached_in_part() -> None:
    def program() -> None:
        pyro.sample("x", dist.Normal(number(0.0), 1.0))
        pyro.sample("z", dist.Normal(number(0.0), 1.0))

    def turned(trace: Trace, sign: float, cut: bool) -> Given:
        x, z = trace["x"], trace["z"]
        return {"x": 0.6 * x + sign * 0.8 * (z.detach() if cut else z), "z": 0.6 * z - sign * 0.8 * x}, {}

    torch.manual_seed(0)
    population = Population(generate(program, (), {}, 20)[0])
    back = partial(turned, sign=-1.0, cut=False)
    whole = move_and_weight(population, Pair(partial(turned, sign=1.0, cut=False), back, check=True))
    torch.testing.assert_close(whole.trace.log_prob(), population.trace.log_prob())
    with pytest.raises(InputError, match=r"Jacobian of a pair .* have to cancel"):
        move_and_weight(population, Pair(partial(turned, sign=1.0, cut=True), back, check=True))


@pytest.mark.parametrize("centre", [1.0, 20.0, 300.0])
def test_a_jump_in_single_precision_undoes_itself_to_rounding(centre: float) -> None:
    one = torch.tensor(1.0)

    def program() -> None:
        count = structural("count", dist.Categorical(torch.ones(2))) + 1
        means = [pyro.sample(f"mean_{j}", dist.Normal(centre * one, 10.0 * one)) for j in range(count)]
        pyro.sample("y", dist.Normal(torch.stack(means).mean(0), one))

    def split(trace: Trace) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        gap = pyro.sample("gap", dist.HalfNormal(one))
        return {"mean_0": trace["mean_0"] - gap, "mean_1": trace["mean_0"] + gap}, {}

    def merge(trace: Trace) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        first, second = trace["mean_0"], trace["mean_1"]
        return {"mean_0": (first + second) / 2}, {"gap": (second - first) / 2}

    torch.manual_seed(0)
    strata = generate_strata(program, (), {"y": torch.tensor(centre)}, 400)
    move = jump(
        Jump(
            to=lambda structure: {"count": 1} if structure["count"] == 0 else None,
            back=lambda structure: {"count": 0} if structure["count"] == 1 else None,
            forward=split,
            backward=merge,
        )
    )
    assert min(move(strata, POSTERIOR).acceptance) > 0.05


@pytest.mark.parametrize("kind", [torch.float32, torch.float64])
def test_a_map_that_stretches_is_right_in_single_precision_too(kind: torch.dtype) -> None:
    one = torch.ones((), dtype=kind)

    def weighed() -> None:
        x = pyro.sample("x", dist.Gamma(2.0 * one, one))
        pyro.sample("y", dist.Normal(x, 1.0))

    def choose(trace: Trace) -> None:
        pyro.sample("u", dist.Beta(2.0 * one, 2.0 * one))

    def odds(values: Any, choices: Any) -> Any:
        return {"x": choices["u"] / (1.0 - choices["u"])}, {"u": values["x"] / (1.0 + values["x"])}

    def wrong(values: Any, choices: Any) -> Any:
        return {"x": choices["u"] / (1.0 - choices["u"]).detach()}, {"u": values["x"] / (1.0 + values["x"])}

    torch.manual_seed(0)
    population = importance_sampling(weighed, (), {"y": one}, 4000)
    rejuvenate(population, involutive(choose, odds, check=True))
    with pytest.raises(InputError, match="they have to cancel"):
        rejuvenate(population, involutive(choose, wrong, check=True))
