"""Simulator states that traces carry: begun once, gone on with, indexed and merged with the particles."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from bcppl.distributions.lazy import LazyDistribution
from bcppl.traces import extend, generate, gradients, simulate, update
from bcppl.traces.carried import carried
from bcppl.traces.differentiation.programs import log_prob_with_grad
from tests.invariance import number
from tests.small_programs import normal_log

N = 5


@dataclass(eq=False)
class Counter:
    """Carried state: counts how far each particle was run, and remembers what it was started from."""

    start: Tensor
    steps: Tensor
    log: list[str]

    def __getitem__(self, index: Tensor) -> Counter:
        return Counter(self.start[index], self.steps[index], self.log)

    def where(self, mask: Tensor, other: Counter) -> Counter:
        self.log.append("merged")
        return Counter(
            torch.where(mask, self.start, other.start), torch.where(mask, self.steps, other.steps), self.log
        )


def carrying(log: list[str]) -> Callable[[int], Any]:
    """A program that carries a counter, which depends on x and not on z; windows advance it by one step."""

    def program(windows: int) -> Any:
        x = pyro.sample("x", dist.Normal(number(0.0), 1.0))
        pyro.sample("z", dist.Normal(number(0.0), 1.0))

        def start() -> Counter:
            log.append(f"started {len(x)}")
            return Counter(x.clone(), torch.zeros(len(x), dtype=torch.int64), log)

        state = carried("counter", start)

        class Window(LazyDistribution):
            def __init__(self, k: int) -> None:
                self.k = k
                super().__init__(len(x), ())

            def log_prob(self, value: Tensor) -> Tensor:
                assert torch.equal(state.start, x), "the state belongs to other particles"
                log.extend(["ran"] * int((self.k + 1 - state.steps).clamp_min(0).max()))
                state.steps = state.steps.clamp_min(self.k + 1)
                return normal_log(value, x, 1.0)

        for k in range(windows):
            pyro.sample(f"w_{k}", Window(k))
        return state

    return program


def test_carried_state_goes_on_and_is_indexed_and_merged_with_its_particles() -> None:
    log: list[str] = []
    trace, _ = generate(carrying(log), (1,), {"w_0": number(0.0)}, N)
    assert log == [f"started {N}", "ran"]
    trace, _ = extend(trace, (2,), {"w_1": number(0.0)})
    assert log == [f"started {N}", "ran", "ran"], "the second window goes on from the first"
    log.clear()
    trace = trace[torch.tensor([4, 4, 1, 0])]
    trace, _ = extend(trace, (3,), {"w_2": number(1.0)})
    assert log == ["ran"], "resampled particles keep their state"
    log.clear()
    moved = update(trace, {"z": trace["z"] + 1.0})
    moved.log_ratio  # noqa: B018
    assert log == [], "the state does not depend on z"
    moved = update(trace, {"x": trace["x"] + 1.0})
    moved.log_ratio  # noqa: B018
    assert log == ["started 4", "ran", "ran", "ran"], "a new x throws the state away"
    log.clear()
    mixed = moved.trace.where(torch.tensor([True, False, False, True]), trace)
    mixed, _ = extend(mixed, (4,), {"w_3": number(1.0)})
    assert log == ["merged", "ran"], "accepted and refused particles keep their own states"
    assert torch.equal(mixed.result.start, mixed["x"])


def test_a_state_started_for_other_inputs_is_not_merged_in() -> None:
    log: list[str] = []
    trace, _ = generate(carrying(log), (1,), {"w_0": number(0.0)}, N)
    moved = update(trace, {"x": trace["x"] + 1.0}).trace
    again = update(moved, {"x": trace["x"]}).trace
    mixed = again.where(torch.zeros(N, dtype=torch.bool), moved)
    mixed, _ = extend(mixed, (2,), {"w_1": number(0.0)})
    assert torch.equal(mixed.result.start, moved["x"])


def test_two_windows_of_one_run_share_the_state_that_the_first_began() -> None:
    started = []

    class State:
        def __getitem__(self, index: torch.Tensor) -> State:
            return self

        def where(self, mask: torch.Tensor, other: State) -> State:
            return self

    def start() -> State:
        started.append(1)
        return State()

    def twice() -> None:
        pyro.sample("x", dist.Normal(torch.tensor(0.0, dtype=torch.float64), 1.0))
        assert carried("state", start) is carried("state", start)

    simulate(twice, (), 5)
    assert len(started) == 1


class Doubled:
    """Carried state that passes gradients on."""

    def __init__(self, x: Tensor) -> None:
        self.twice = 2.0 * x

    def __getitem__(self, index: Tensor) -> Doubled:
        return Doubled(0.5 * self.twice[index])

    def where(self, mask: Tensor, other: Doubled) -> Doubled:
        return Doubled(0.5 * torch.where(mask, self.twice, other.twice))


def doubled() -> None:
    x = pyro.sample("x", dist.Normal(number(0.0), 1.0))
    for k in range(2):
        pyro.sample(f"y_{k}", dist.Normal(carried("doubled", partial(Doubled, x)).twice, 1.0))


def test_a_carried_state_passes_the_gradient_on_where_the_trace_is() -> None:
    torch.manual_seed(0)
    trace, _ = generate(doubled, (), {"y_0": 1.0, "y_1": 0.5}, N)
    for x in (trace["x"], trace["x"] + 1.0):
        x = x.clone().requires_grad_()
        (gradient,) = torch.autograd.grad(log_prob_with_grad(trace, {"x": x}).sum(), x)
        torch.testing.assert_close(gradient, (3.0 - 9.0 * x).detach())
        with gradients():
            moved = update(trace, {"x": x}).trace
            (kept,) = torch.autograd.grad(moved.log_prob().sum(), x)
        torch.testing.assert_close(kept, gradient)


def test_a_state_that_gradients_do_not_reach_is_gone_on_with() -> None:
    log: list[str] = []
    torch.manual_seed(0)
    trace, _ = generate(carrying(log), (1,), {"w_0": 1.0}, N)
    log_prob_with_grad(trace, {"z": trace["z"].clone().requires_grad_()})
    assert log == [f"started {N}", "ran"]  # by `generate` alone
