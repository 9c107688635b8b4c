"""Update: values, arguments and observations changed at once; extend, its special case."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from bcppl.distributions.lazy import LazyDistribution
from bcppl.errors import InputError
from bcppl.traces import Series, Trace, Update, assess, extend, generate, simulate, update
from bcppl.traces.anticipated import Anticipated
from tests.invariance import number
from tests.small_programs import normal_log

N = 6


class Read(LazyDistribution):
    """A number about x with noise, which counts how often it is evaluated, and where."""

    asked: list[str] = []  # noqa: RUF012

    def __init__(self, name: str, x: Tensor, noise: float) -> None:
        self.name, self.x, self.noise = name, x, noise
        super().__init__(len(x), ())

    def log_prob(self, value: Tensor) -> Tensor:
        Read.asked.append(self.name)
        return normal_log(value, self.x, self.noise)

    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        return self.x + self.noise * torch.randn(len(self.x), dtype=torch.float64)


def program(steps: int, noise: float = 0.5) -> None:
    """Latent z_0, z_1, ... about x; readings of x, and with the program's noise of each z."""
    x = pyro.sample("x", dist.Normal(number(0.3), 1.0))
    for k in range(steps):
        z = pyro.sample(f"z_{k}", dist.Normal(0.8 * x, 1.0 + k))
        pyro.sample(f"a_{k}", Read(f"a_{k}", x, 0.7))
        pyro.sample(f"b_{k}", Read(f"b_{k}", z, noise))


def seen(first: int, last: int) -> dict[str, Tensor]:
    return {f"{name}_{k}": number(0.2 * k + (name == "b")) for k in range(first, last) for name in "ab"}


def made(steps: int = 2, noise: float = 0.5) -> Trace:
    torch.manual_seed(0)
    trace, _ = generate(program, (steps, noise), seen(0, steps), N)
    trace.log_prob()
    Read.asked.clear()
    return trace


def density(trace: Trace) -> Tensor:
    """Of all values of a trace, from nothing but them."""
    choices = {**trace.choices, **trace.observations}
    found = assess(trace.program, trace.args, choices, trace.particles)
    return found


def agrees(updated: Update) -> None:
    """The log ratio is that of the densities, but for what was drawn from the program."""
    expected = density(updated.trace) - density(updated.previous)
    if updated.drawn:
        expected = expected - updated.trace.log_prob(*updated.drawn)
    torch.testing.assert_close(updated.log_ratio, expected)


def new(trace: Trace, *addresses: str) -> dict[str, Tensor]:
    torch.manual_seed(1)
    return {a: trace[a] + torch.randn(N, dtype=torch.float64) for a in addresses}


def shown(**values: float) -> dict[str, Tensor]:
    return {address: number(value) for address, value in values.items()}


UPDATES: dict[str, tuple[Callable[[Trace], Update], set[str], set[str]]] = {
    "values": (lambda t: update(t, new(t, "x", "z_1")), {"x", "z_1"}, {"a_0", "a_1", "b_1"}),
    "no change": (lambda t: update(t), set(), set()),
    "the same values": (lambda t: update(t, {"x": t["x"].clone()}, args=t.args), {"x"}, set()),
    "arguments": (lambda t: update(t, args=(2, 0.9)), set(), {"b_0", "b_1"}),
    "an observation": (lambda t: update(t, observations=shown(b_0=-0.4)), {"b_0"}, {"b_0"}),
    "the same observation": (lambda t: update(t, observations={"b_0": t["b_0"].clone()}), {"b_0"}, set()),
    "more": (lambda t: update(t, args=(3,), observations=seen(2, 3)), set(), {"a_2", "b_2"}),
    "more, given": (
        lambda t: update(t, {"z_2": t["x"] + 0.1}, args=(3,), observations=seen(2, 3)),
        set(),
        {"a_2", "b_2"},
    ),
    "more, not observed": (lambda t: update(t, args=(3,)), set(), set()),
    "fewer": (lambda t: update(t, args=(1,)), {"z_1", "a_1", "b_1"}, set()),
    "all": (
        lambda t: update(
            t,
            {**new(t, "z_0"), "z_2": t["x"] - 0.1},
            args=(3, 0.9),
            observations={**seen(2, 3), **shown(a_1=0.8)},
        ),
        {"z_0", "a_1"},
        {"b_0", "b_1", "a_1", "a_2", "b_2"},
    ),
}


@pytest.mark.parametrize("case", UPDATES)
def test_an_update_weighs_what_changed_and_evaluates_nothing_else(case: str) -> None:
    trace = made()
    before = {**trace.choices, **trace.observations}
    change, discarded, evaluated = UPDATES[case]
    updated = change(trace)
    assert Read.asked == [], "nothing is evaluated before the ratio is asked for"
    updated.log_ratio  # noqa: B018
    assert set(Read.asked) == evaluated and len(Read.asked) == len(evaluated)
    assert set(updated.discarded) == discarded
    assert all(torch.equal(value, before[a]) for a, value in updated.discarded.items())
    assert all(torch.equal({**trace.choices, **trace.observations}[a], v) for a, v in before.items())
    agrees(updated)


@pytest.mark.parametrize("case", UPDATES)
def test_an_update_is_undone_by_what_it_discarded(case: str) -> None:
    trace = made()
    updated = UPDATES[case][0](trace)
    old = updated.discarded
    back = update(
        updated.trace,
        {a: v for a, v in old.items() if a in trace.choices},
        args=trace.args,
        observations={a: v for a, v in old.items() if a in trace.observations},
    )
    there = updated.log_ratio
    if updated.drawn:
        there = there + updated.trace.log_prob(*updated.drawn)
    torch.testing.assert_close(back.log_ratio, -there)
    assert all(torch.equal(back.trace[a], trace[a]) for a in (*trace.choices, *trace.observations))
    torch.testing.assert_close(back.trace.log_prob(), trace.log_prob())


def test_two_updates_weigh_as_one() -> None:
    trace = made()
    moved = new(trace, "x")
    further = {"z_2": trace["x"] + 0.1}
    both = update(trace, {**moved, **further}, args=(3, 0.9), observations=seen(2, 3)).log_ratio
    first = update(trace, moved)
    second = update(first.trace, further, args=(3, 0.9), observations=seen(2, 3))
    torch.testing.assert_close(first.log_ratio + second.log_ratio, both)


def test_new_latent_values_are_drawn_given_the_new_values_of_others() -> None:
    trace = made()
    updated = update(trace, {"x": trace["x"] + 1e6}, args=(3,), observations=seen(2, 3))
    assert updated.drawn == {"z_2"} and float(updated.trace["z_2"].min()) > 1e5


def test_observations_are_copied() -> None:
    trace, values = made(), seen(2, 3)
    longer = update(trace, args=(3,), observations=values).trace
    values["a_2"] += 1.0
    assert float(longer["a_2"]) == pytest.approx(0.4)


def test_extending_weighs_old_sites_that_new_arguments_change() -> None:
    trace = made()
    longer, weight = extend(trace, (3, 0.9), seen(2, 3))
    torch.testing.assert_close(weight, density(longer) - density(trace) - longer.log_prob("z_2"))
    longer, weight = extend(trace, (3, 0.5), seen(2, 3))
    assert torch.equal(weight, longer.log_prob("a_2", "b_2"))
    weight += 1.0
    assert torch.equal(longer.log_prob("a_2", "b_2"), weight - 1.0), "the trace keeps its own"


def test_the_newest_step_of_a_series_takes_new_arguments_and_observations() -> None:
    def step(x: Tensor, noise: float) -> Tensor:
        x = pyro.sample("x", dist.Normal(0.9 * x, 1.0))
        pyro.sample("y", dist.Normal(x, noise))
        return x

    walk = Series(lambda: pyro.sample("x", dist.Normal(number(0.0), 1.0)), step)
    torch.manual_seed(0)
    trace, _ = generate(walk, (), {}, N)
    trace, _ = extend(trace, (0.5,), {"y": number(0.3)})
    trace = trace[torch.tensor([0, 0, 3, 4, 5, 1])]
    updated = update(trace, {"x": trace["x"] + 0.2}, args=(0.8,), observations={"y": number(0.6)})
    before, after = trace["x"], updated.trace["x"]
    expected = normal_log(after, 0.9 * trace["x", 0], 1.0) - normal_log(before, 0.9 * trace["x", 0], 1.0)
    expected = expected + normal_log(number(0.6), after, 0.8) - normal_log(number(0.3), before, 0.5)
    torch.testing.assert_close(updated.log_ratio, expected)
    assert updated.trace.steps == 1 and torch.equal(updated.trace["x", 0], trace["x", 0])
    torch.testing.assert_close(updated.trace.log_prob() - trace.log_prob(), expected)


def branching(on: bool) -> None:
    x = pyro.sample("x", dist.Bernoulli(number(0.5)))
    if on and bool((x == 1).all()):
        pyro.sample("y", dist.Normal(number(0.0), 1.0))


REFUSED: dict[str, tuple[Callable[[Trace], Any], str]] = {
    "observed latent": (
        lambda t: update(t, observations=shown(x=0.0)),
        "'x' is latent and given an observation",
    ),
    "given twice": (
        lambda t: update(t, {"a_2": t["x"]}, args=(3,), observations=seen(2, 3)),
        "'a_2' is latent and given an observation",
    ),
    "value of an observed address": (lambda t: update(t, {"a_0": t["x"]}), "'a_0'.* no latent address"),
    "the same, with arguments": (
        lambda t: update(t, {"a_0": t["x"]}, args=(3,)),
        "'a_0'.* no latent address",
    ),
    "value never visited": (lambda t: update(t, {"z_5": t["x"]}), "'z_5'.* no latent address"),
    "never visited, with arguments": (
        lambda t: update(t, {"z_5": t["x"]}, args=(3,)),
        "'z_5' is one the program never visits",
    ),
    "observation never visited": (
        lambda t: update(t, observations=shown(a_5=0.0)),
        "'a_5' is one the program never visits",
    ),
    "shape": (lambda t: update(t, {"x": t["x"][:2]}, args=(3,)), r"'x' has shape \(2,\)"),
    "shape of a new value": (lambda t: update(t, {"z_2": t["x"][:2]}, args=(3,)), r"'z_2' has shape \(2,\)"),
    "one for each": (lambda t: update(t, observations={"a_0": t["x"]}), "the same for all particles"),
    "no number": (lambda t: update(t, observations={"a_0": "x"}), "'a_0' is a str"),  # type: ignore[dict-item]
    "arguments": (lambda t: update(t, args=3), "arguments are of type int; give a tuple"),
    "vanished": (lambda t: extend(t, (1,), {}), "no longer visits address 'z_1'"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_does_not_fit_is_refused_in_one_sentence(case: str) -> None:
    change, match = REFUSED[case]
    with pytest.raises(InputError, match=match) as caught:
        change(made())
    assert "\n" not in str(caught.value) and ". " not in str(caught.value)


def test_values_may_change_which_addresses_are_visited_only_with_the_arguments() -> None:
    trace = simulate(branching, (False,), 3).at({"x": torch.ones(3, dtype=torch.float64)})
    on = update(trace, args=(True,))
    assert on.drawn == {"y"}
    with pytest.raises(InputError, match="changed which addresses"):
        update(on.trace, {"x": torch.zeros(3, dtype=torch.float64)})
    off = update(on.trace, {"x": torch.zeros(3, dtype=torch.float64)}, args=(True,))
    assert set(off.discarded) == {"x", "y"} and set(off.trace.choices) == {"x"}


# ---- masked sites


def masked(mask: bool, latent: str = "x") -> None:
    x = pyro.sample("x", dist.Normal(number(0.0), 1.0).mask(torch.tensor(mask or latent != "x")))
    normal = dist.Normal(x, 1.0).expand([2, N]).mask(torch.tensor([[True], [mask]]))
    with pyro.plate("readings", 2):
        pyro.sample("y", normal)


def test_a_masked_latent_site_is_refused() -> None:
    torch.manual_seed(0)
    values = torch.tensor([0.3, torch.nan], dtype=torch.float64)
    trace, weight = generate(masked, (False, "y"), {"y": torch.nan_to_num(values)}, N)
    torch.testing.assert_close(weight, normal_log(values[0], trace["x"], 1.0))
    trace.log_prob()
    sentence = "site '{}' is latent and its distribution is masked, .* ignore its value with `torch.where`"
    with pytest.raises(InputError, match=sentence.format("x")):
        generate(masked, (False,), {"y": torch.nan_to_num(values)}, N)
    with pytest.raises(InputError, match=sentence.format("y")):
        generate(masked, (False, "y"), {}, N)
    drawn = simulate(masked, (False, "y"), N)
    with pytest.raises(InputError, match=sentence.format("y")):
        drawn.log_prob("y")
    with pytest.raises(InputError, match=sentence.format("x")):
        assess(masked, (False,), drawn.choices, N)


# ---- what a forward kernel reads


def test_a_trace_with_the_next_measurement_shows_both_and_hides_what_was_drawn() -> None:
    trace = made()
    coming = Anticipated(trace, (3, 0.9), seen(2, 3))
    assert torch.equal(coming["b_2"], number(1.4)) and torch.equal(coming["x"], trace["x"])
    assert "b_2" in coming and "z_2" not in coming and set(coming.choices) == {"x", "z_0", "z_1"}
    assert set(coming.observations) == set(seen(0, 3)) and len(coming) == coming.particles == N
    assert coming.brought == ["z_2"] and coming.addresses == coming.updated.addresses
    torch.testing.assert_close(coming.log_prob("a_0", "x"), trace.log_prob("a_0", "x"))
    for address in ("z_2", "a_2", "b_2", "b_0"):
        with pytest.raises(InputError, match=f"'{address}' is hidden"):
            coming.log_prob(address)
    known = Anticipated(trace, (2, 0.9), shown(b_0=0.1))
    assert known.brought == []
    torch.testing.assert_close(known.log_prob("b_0"), normal_log(number(0.1), trace["z_0"], 0.9))


# ---- mutants


def values_alone(first: Any, second: Any, addresses: Any) -> Any:
    """Distributions are taken to be the same."""
    then, now = first._run.values, second._run.values
    return (a for a in addresses if not torch.equal(then[a], now[a]))


def distributions_alone(first: Any, second: Any, addresses: Any) -> Any:
    """Values are taken to be the same."""
    same = SAME()
    then, now = first._run.distributions, second._run.distributions
    return (a for a in addresses if not same(then[a], now[a]))


SAME = sys.modules["bcppl.traces.dependence.equality"].comparison


@pytest.mark.parametrize(
    ("mutant", "cases"),
    [(values_alone, ["arguments", "all"]), (distributions_alone, ["an observation", "values", "all"])],
)
def test_mutants_that_keep_what_changed(
    mutant: Any, cases: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("trace", "update"):
        monkeypatch.setattr(sys.modules[f"bcppl.traces.{name}"], "changed", mutant)
    for case in cases:
        with pytest.raises(AssertionError):
            agrees(UPDATES[case][0](made()))


def test_mutant_that_weighs_what_was_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Update, "__init__", without_drawn)
    updated = UPDATES["more"][0](made())
    expected = density(updated.trace) - density(updated.previous) - updated.trace.log_prob("z_2")
    assert float((updated.log_ratio - expected).abs().max()) > 0.1


sound = Update.__init__


def without_drawn(self: Update, trace: Trace, previous: Trace, discarded: Any, drawn: Any = None) -> None:
    sound(self, trace, previous, discarded)


def test_arguments_may_grow_in_place_from_step_to_step() -> None:
    """A trace keeps those that it was made with."""

    def program(deviations: list[float]) -> None:
        x = pyro.sample("x", dist.Normal(number(0.0), 1.0))
        for k, deviation in enumerate(deviations):
            pyro.sample(f"y_{k}", dist.Normal(x, deviation))

    deviations = [1.0]
    torch.manual_seed(0)
    trace, _ = generate(program, (deviations,), {"y_0": number(0.5)}, 4)
    deviations.append(2.0)
    for begun in (trace, trace[torch.tensor([2, 1])]):
        longer, log_weight = extend(begun, (deviations,), {"y_1": number(1.0)})
        torch.testing.assert_close(log_weight, dist.Normal(begun["x"], 2.0).log_prob(number(1.0)))
        assert begun.addresses == ["x", "y_0"] and longer.addresses == ["x", "y_0", "y_1"]


def test_what_was_impossible_stays_so_when_arguments_change() -> None:
    def program(width: float) -> None:
        x = pyro.sample("x", dist.Normal(number(0.0), 1.0))
        pyro.sample("y", dist.Uniform(x - width, x + width))

    torch.manual_seed(0)
    trace, before = generate(program, (1.0,), {"y": number(1.5)}, 200)
    ratio = update(trace, args=(0.8,)).log_ratio
    near = (trace["x"] - 1.5).abs() < 0.8
    assert bool((before == -torch.inf).any()) and bool((ratio[~near] == -torch.inf).all())
    torch.testing.assert_close(ratio[near], -number(0.8).log().expand(int(near.sum())))
