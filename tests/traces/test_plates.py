"""Plates that a program opens itself, continuous and discrete sites in them, under all verbs."""

from __future__ import annotations

import math
from typing import Any

import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from bcppl.errors import InputError
from bcppl.inference.kernels import hmc, metropolis_hastings, moved_by, sequence
from bcppl.inference.population import Population
from bcppl.inference.proposals import drift
from bcppl.inference.targets import POSTERIOR
from bcppl.traces import Trace, assess, extend, generate, propose, regenerate, simulate, update
from bcppl.traces.differentiation.programs import log_prob_with_grad

N, POINTS, GROUPS = 4, 5, 3
WIDTHS = torch.linspace(0.5, 1.5, POINTS, dtype=torch.float64)


def normal_log(value: Tensor, mean: Tensor | float, scale: Tensor | float) -> Tensor:
    scale = torch.as_tensor(scale, dtype=torch.float64)
    return -0.5 * ((value - mean) / scale) ** 2 - torch.log(scale * math.sqrt(2 * math.pi))


def scene(steps: int) -> Any:
    """A mean; points about it, each with a label and a width of its own; seen at every step in two axes."""
    mean = pyro.sample("mean", dist.Normal(torch.tensor(0.0, dtype=torch.float64), 2.0))
    with pyro.plate("points", POINTS):
        x = pyro.sample("x", dist.Normal(mean, WIDTHS[:, None]))
        label = pyro.sample("label", dist.Categorical(torch.tensor([0.2, 0.8], dtype=torch.float64)))
        for k in range(steps):
            centre = torch.stack([x, x + label], -1)
            pyro.sample(f"seen_{k}", dist.Normal(centre, 1.0).to_event(1))
    return x


def seen(first: int, last: int) -> dict[str, Tensor]:
    return {
        f"seen_{k}": torch.linspace(-1, k + 1, 2 * POINTS, dtype=torch.float64).reshape(POINTS, 2)
        for k in range(first, last)
    }


def by_hand(trace: Trace, address: str) -> Tensor:
    """The log-probability (N,) of a site of `scene`, from the trace's own values."""
    if address == "mean":
        return normal_log(trace["mean"], 0.0, 2.0)
    if address == "x":
        return normal_log(trace["x"], trace["mean"][:, None], WIDTHS).sum(1)
    if address == "label":
        return torch.tensor([0.2, 0.8], dtype=torch.float64).log()[trace["label"]].sum(1)
    centre = torch.stack([trace["x"], trace["x"] + trace["label"]], -1)
    return normal_log(trace[address], centre, 1.0).sum((1, 2))


def check(trace: Trace) -> None:
    particles = len(trace)
    assert trace["x"].shape == trace["label"].shape == (particles, POINTS)
    for address in trace.addresses:
        assert trace.log_prob(address).shape == (particles,)
        torch.testing.assert_close(trace.log_prob(address), by_hand(trace, address))
    torch.testing.assert_close(trace.log_prob(), sum(by_hand(trace, a) for a in trace.addresses))


def test_particles_come_first_in_the_trace_and_last_in_the_program() -> None:
    trace = simulate(scene, (1,), N)
    assert trace.result.shape == (POINTS, N) and torch.equal(trace.result.T, trace["x"])
    assert trace["seen_0"].shape == (N, POINTS, 2)
    check(trace)


def test_all_verbs_weigh_plates_entry_by_entry() -> None:
    trace, weight = generate(scene, (1,), seen(0, 1), N)
    torch.testing.assert_close(weight, by_hand(trace, "seen_0"))
    trace, weight = extend(trace, (2,), seen(1, 2))
    torch.testing.assert_close(weight, by_hand(trace, "seen_1"))
    check(trace)
    moved = update(trace, {"x": trace["x"] + 0.3, "label": 1 - trace["label"]})
    check(moved.trace)
    expected = sum(by_hand(moved.trace, a) - by_hand(trace, a) for a in trace.addresses)
    torch.testing.assert_close(moved.log_ratio, expected)
    torch.testing.assert_close(update(moved.trace, moved.discarded).log_ratio, -expected)
    drawn = regenerate(trace, ["mean", "label"])
    check(drawn.trace)
    expected = sum(by_hand(drawn.trace, a) - by_hand(trace, a) for a in ("x", "seen_0", "seen_1"))
    torch.testing.assert_close(drawn.log_weight, expected)
    assert torch.equal(drawn.trace["x"], trace["x"])
    check(trace[torch.tensor([3, 3, 0])])
    mask = torch.tensor([True, False, False, True])
    mixed = trace.where(mask, moved.trace)
    check(mixed)
    torch.testing.assert_close(mixed.log_prob(), torch.where(mask, trace.log_prob(), moved.trace.log_prob()))
    proposed = propose(scene, (1,), N)
    torch.testing.assert_close(assess(scene, (1,), proposed.choices, N), proposed.log_prob)
    assert proposed.result.shape == (POINTS, N)


def test_plates_within_plates() -> None:
    def nested() -> None:
        with pyro.plate("groups", GROUPS, dim=-3):
            height = pyro.sample("height", dist.Normal(torch.tensor(0.0, dtype=torch.float64), 1.0))
            with pyro.plate("points", POINTS, dim=-2):
                pyro.sample("x", dist.Normal(height, WIDTHS[:, None]))

    trace = simulate(nested, (), N)
    # The outer plate alone leaves the inner one's place in the batch, of one entry.
    assert trace["height"].shape == (N, GROUPS, 1) and trace["x"].shape == (N, GROUPS, POINTS)
    torch.testing.assert_close(
        trace.log_prob("x"), normal_log(trace["x"], trace["height"], WIDTHS).sum((1, 2))
    )
    value = torch.linspace(0, 1, GROUPS * POINTS, dtype=torch.float64).reshape(GROUPS, POINTS)
    trace, weight = generate(nested, (), {"x": value}, N)
    torch.testing.assert_close(weight, normal_log(value, trace["height"], WIDTHS).sum((1, 2)))
    assert regenerate(trace, "height").trace["height"].shape == (N, GROUPS, 1)


@pytest.mark.parametrize("shape", [(POINTS,), (POINTS, 1)])
def test_what_the_program_observes_in_a_plate(shape: tuple[int, ...]) -> None:
    data = torch.linspace(-1, 1, POINTS, dtype=torch.float64)

    def program() -> None:
        mean = pyro.sample("mean", dist.Normal(torch.tensor(0.0, dtype=torch.float64), 1.0))
        with pyro.plate("points", POINTS):
            pyro.sample("y", dist.Normal(mean, 1.0), obs=data.reshape(shape))
            pyro.factor("tilt", 0.1 * mean.expand(POINTS, -1))

    trace, weight = generate(program, (), {}, N)
    expected = normal_log(data, trace["mean"][:, None], 1.0).sum(1) + 0.1 * POINTS * trace["mean"]
    torch.testing.assert_close(weight, expected)


def test_a_plate_as_large_as_the_population_is_told_apart_from_it() -> None:
    def program() -> None:
        mean = pyro.sample("mean", dist.Normal(torch.tensor(0.0, dtype=torch.float64), 1.0))
        with pyro.plate("points", POINTS):
            pyro.sample("x", dist.Normal(mean, WIDTHS[:, None]))

    trace = simulate(program, (), POINTS)
    torch.testing.assert_close(
        trace.log_prob("x"), normal_log(trace["x"], trace["mean"][:, None], WIDTHS).sum(1)
    )
    value = trace["x"] * torch.tensor([[1.0], [2.0], [3.0], [4.0], [5.0]], dtype=torch.float64)
    new = update(trace, {"x": value}).trace
    torch.testing.assert_close(new.log_prob("x"), normal_log(value, trace["mean"][:, None], WIDTHS).sum(1))


def test_counts_and_structure_that_differs_by_argument() -> None:
    def counts(kinds: tuple[str, ...]) -> None:
        rate = pyro.sample("rate", dist.Gamma(torch.tensor(2.0, dtype=torch.float64), 1.0))
        if "many" in kinds:
            with pyro.plate("cells", POINTS):
                pyro.sample("many", dist.Poisson(rate))
        if "one" in kinds:
            pyro.sample("one", dist.Poisson(rate))

    cells = torch.arange(POINTS, dtype=torch.float64)
    trace, weight = generate(counts, (("many",),), {"many": cells}, N)
    rate = trace["rate"]
    expected = (cells * rate.log()[:, None] - rate[:, None] - torch.lgamma(cells + 1)).sum(1)
    torch.testing.assert_close(weight, expected)
    trace, weight = extend(trace, (("many", "one"),), {"one": torch.tensor(3.0, dtype=torch.float64)})
    torch.testing.assert_close(weight, 3 * rate.log() - rate - math.log(6.0))
    assert generate(counts, (("one",),), {}, N)[0].addresses == ["rate", "one"]
    drawn = regenerate(simulate(counts, (("many",),), N), "many")
    assert drawn.trace["many"].shape == (N, POINTS)
    assert torch.equal(drawn.log_weight, torch.zeros(N, dtype=torch.float64)), "nothing depends on it"
    with pytest.raises(InputError, match="no longer visits address 'many'"):
        extend(trace, (("one",),), {})


def several(places: int) -> None:
    """Plates, one within the other, a vector site, and a site in a plate that depends on both."""
    mean = pyro.sample("mean", dist.Normal(torch.tensor(0.0, dtype=torch.float64), 2.0))
    width = pyro.sample("width", dist.Gamma(torch.tensor(2.0, dtype=torch.float64), 1.0))
    vector = pyro.sample("vector", dist.Normal(mean[:, None].expand(-1, places), width[:, None]).to_event(1))
    with pyro.plate("rows", places, dim=-3):
        row = pyro.sample("row", dist.Normal(vector.T[:, None], 1.0))
        with pyro.plate("columns", places, dim=-2):
            each = pyro.sample("each", dist.Normal(row, width))
            pyro.sample("y", dist.Normal(each, 1.0))


@pytest.mark.parametrize("particles", [1, 2, POINTS - 1, POINTS, POINTS + 1])
def test_particles_are_as_in_a_larger_population_however_many_entries_a_plate_has(particles: int) -> None:
    seen = {"y": torch.linspace(-1, 1, POINTS * POINTS, dtype=torch.float64).reshape(POINTS, POINTS)}
    large, _ = generate(several, (POINTS,), seen, 4 * POINTS)
    index = torch.arange(particles) + 3
    choices = {a: v[index] for a, v in large.choices.items()}
    small, log_weight = generate(several, (POINTS,), seen, particles, choices)
    torch.testing.assert_close(log_weight, large.log_prob()[index])
    for address in large.addresses:
        torch.testing.assert_close(small.log_prob(address), large.log_prob(address)[index])
    for address, value in large.choices.items():
        moved = update(large, {address: value * 1.1})
        torch.testing.assert_close(
            update(small, {address: value[index] * 1.1}).log_ratio, moved.log_ratio[index]
        )
        leaves = value.clone().requires_grad_(), value[index].clone().requires_grad_()
        for trace, leaf in zip((large, small), leaves, strict=True):
            log_prob_with_grad(trace, {address: leaf}).sum().backward()
        assert leaves[0].grad is not None and leaves[1].grad is not None
        torch.testing.assert_close(leaves[1].grad, leaves[0].grad[index])


@pytest.mark.long
@pytest.mark.parametrize("particles", [3, 5, 8])
def test_kernels_move_as_many_particles_as_a_plate_has_entries(particles: int) -> None:
    """A conjugate hierarchy: groups of chains as many as entries, or fewer, have its posterior means."""

    def hierarchy() -> None:
        mean = pyro.sample("mean", dist.Normal(torch.tensor(0.0, dtype=torch.float64), 2.0))
        with pyro.plate("points", POINTS):
            x = pyro.sample("x", dist.Normal(mean, 1.0))
            pyro.sample("y", dist.Normal(x, 0.5))

    y = torch.tensor([0.3, -1.0, 2.0, 1.1, 0.4], dtype=torch.float64)
    precision = 1 / 4 + POINTS / 1.25
    centre, wide = float(y.sum() / 1.25 / precision), precision**-0.5
    moved = []
    torch.manual_seed(0)
    for _ in range(60):
        mean = centre + wide * torch.randn(particles, dtype=torch.float64)
        x = (mean[:, None] + 4 * y) / 5 + 5**-0.5 * torch.randn(particles, POINTS, dtype=torch.float64)
        start, _ = generate(hierarchy, (), {"y": y}, particles, {"mean": mean, "x": x})
        population = Population(start)
        kernel = sequence([metropolis_hastings(drift("x")), hmc("mean", "x", steps=3)])
        trace = moved_by(population, kernel, POSTERIOR).population.trace
        before, after = (torch.cat([t["mean"][:, None], t["x"]], dim=1) for t in (start, trace))
        moved.append(torch.cat([after - before, after**2 - before**2], dim=1))
    change = torch.cat(moved)
    assert bool((change.std(dim=0) > 0.01).all())
    assert float((change.mean(dim=0) / (change.std(dim=0) / len(change) ** 0.5)).abs().max()) < 3.7


def test_a_factor_in_a_plate_counts_for_each_entry() -> None:
    def program() -> None:
        x = pyro.sample("x", dist.Normal(torch.zeros(()).double(), 1.0))
        with pyro.plate("points", POINTS):
            pyro.factor("for all", -(x**2))
            pyro.factor("for each", -WIDTHS[:, None] * x)

    trace, weight = generate(program, (), {}, N)
    torch.testing.assert_close(weight, -POINTS * trace["x"] ** 2 - WIDTHS.sum() * trace["x"])
    moved = update(trace[:2], {"x": trace["x"][2:]}).trace
    torch.testing.assert_close(moved.log_prob("for all", "for each"), weight[2:])
