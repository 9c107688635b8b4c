"""Gradients through the verbs, against closed forms and finite differences; what cuts them is refused."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from bcppl import poses
from bcppl.distributions.lazy import LazyDistribution
from bcppl.distributions.poses import MixturePose, NormalPose
from bcppl.errors import InputError
from bcppl.traces import (
    Series,
    Trace,
    assess,
    extend,
    generate,
    gradients,
    propose,
    simulate,
    update,
)
from bcppl.traces.differentiation import graph
from tests.invariance import number

Program = Callable[..., None]


def leaf(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64, requires_grad=True)


def linear(weight: Tensor, noise: Tensor) -> Program:
    """Latent x, three observations in a plate."""

    def program() -> None:
        x = pyro.sample("x", dist.Normal(number(0.0), 2.0))
        with pyro.plate("rows", 3):
            pyro.sample("y", dist.Normal(weight * x, noise))

    return program


SEEN = torch.tensor([0.3, -1.0, 2.0], dtype=torch.float64)


def test_closed_forms_of_a_linear_gaussian_program() -> None:
    weight, noise, x, y = leaf(1.5), leaf(0.7), leaf(0.4, -0.2), SEEN.clone().requires_grad_()
    with gradients():
        _, log_weight = generate(linear(weight, noise), (), {"y": y}, 2, {"x": x})
    errors = SEEN - 1.5 * x.detach()[:, None]
    expected = {
        "x": -x.detach() / 4 + 1.5 * errors.sum(1) / 0.49,
        "weight": (x.detach()[:, None] * errors).sum()[None] / 0.49,
        "noise": (errors**2 / 0.7**3 - 1 / 0.7).sum()[None],
        "y": -errors.sum(0) / 0.49,
    }
    given = torch.autograd.grad(log_weight.sum(), [x, weight, noise, y])
    for gradient, exact in zip(given, expected.values(), strict=True):
        torch.testing.assert_close(gradient, exact)


def every_kind(a: Tensor, b: Tensor) -> Program:
    """Sites of several kinds that depend on two parameters and on one another."""

    def program() -> None:
        rate = pyro.sample("rate", dist.Gamma(a.exp(), number(2.0)))
        share = pyro.sample("share", dist.Dirichlet(torch.stack([b.exp(), a.exp(), b.exp()])))
        which = pyro.sample("which", dist.Categorical(logits=torch.stack([a, b, a + b])))
        with pyro.plate("rows", 2):
            z = pyro.sample("z", dist.Normal(rate * b, rate))
        pyro.sample("one", dist.Normal(z[0] + share[:, 1], torch.where(which == 1, a.exp(), 2.0)))

    return program


def posed(a: Tensor, b: Tensor) -> Program:
    center = poses.as_pose([0.1, -0.2, 0.3, 0.5, 0.5, -0.5, 0.5])

    def program() -> None:
        moved = poses.retract(center, torch.stack([a, b, a, b, a - b, a * b]))
        deviations = torch.stack([a.exp(), b.exp(), a.exp(), number(0.3), 0.2 * b.exp(), number(0.1)])
        pose = pyro.sample("pose", NormalPose(moved, torch.diag(deviations**2)))
        away = poses.local(pose, moved)
        pyro.sample("far", dist.Normal(away.norm(dim=-1), b.exp()))
        centers = torch.stack([moved, center])
        pyro.sample("mixed", MixturePose(torch.stack([a, b]), centers, torch.diag(deviations**2)))

    return program


def finite_difference(function: Callable[[], Tensor], value: Tensor, step: Tensor) -> Tensor:
    """The central difference of a function along a step of a tensor."""
    ends = []
    for sign in (1.0, -1.0):
        with torch.no_grad():
            value.add_(sign * step)
        ends.append(function().detach())
        with torch.no_grad():
            value.sub_(sign * step)
    return (ends[0] - ends[1]) / 2.0


@pytest.mark.parametrize("make", [every_kind, posed])
def test_gradients_are_those_of_finite_differences(make: Callable[[Tensor, Tensor], Program]) -> None:
    torch.manual_seed(0)
    a, b = (number(v).requires_grad_() for v in (0.2, -0.3))
    program = make(a, b)
    drawn = simulate(program, (), 6)
    values = {k: v.clone() for k, v in drawn.choices.items()}
    for address, value in values.items():
        if value.is_floating_point() and address not in ("share", "pose", "mixed"):
            value.requires_grad_()
    moving = [a, b, *(v for v in values.values() if v.requires_grad)]
    with gradients():
        inside = {
            "assess": lambda: assess(program, (), values, 6).sum(),
            "generate": lambda: generate(program, (), {}, 6, values)[1].sum(),
            "log_prob": lambda: assess_trace(program, values).log_prob().sum(),
            "update": lambda: update(drawn, values).trace.log_prob().sum(),
            "log_ratio": lambda: update(drawn, values).log_ratio.sum(),
        }
        given = {n: torch.autograd.grad(f(), moving, allow_unused=True) for n, f in inside.items()}
    for k, value in enumerate(moving):
        step = 1e-6 * torch.randn_like(value.detach())
        exact = finite_difference(lambda: assess(program, (), values, 6).sum(), value, step)
        for name, gradient in given.items():
            if name == "log_ratio" and k < 2:
                continue  # the old trace moves along
            directional = (gradient[k] * step).sum()
            torch.testing.assert_close(directional, exact, rtol=2e-5, atol=1e-11, msg=f"{name} {k}")


def assess_trace(program: Program, values: Any) -> Trace:
    return generate(program, (), {}, 6, values)[0]


def test_log_ratio_of_an_update_by_equal_numbers_has_a_gradient() -> None:
    """Sites that are the same to the bit cancel; their gradients do not."""
    program = linear(number(1.5), number(0.7))
    trace, _ = generate(program, (), {"y": SEEN}, 2)
    trace.log_prob()
    x = trace["x"].clone().requires_grad_()
    with gradients():
        ratio = update(trace, {"x": x}).log_ratio
        whole = trace.at({"x": x}).log_prob()
    torch.testing.assert_close(ratio.detach(), torch.zeros(2, dtype=torch.float64))
    exact = -x.detach() / 4 + 1.5 * (SEEN - 1.5 * x.detach()[:, None]).sum(1) / 0.49
    for attached in (ratio, whole):
        torch.testing.assert_close(torch.autograd.grad(attached.sum(), x)[0], exact)


def test_draws_are_reparameterised() -> None:
    """d/ds of E[x^2], x = s e: 2 s; and a thousand draws take torch's path in place of the fast one."""
    scale = leaf(1.3)

    def program() -> None:
        x = pyro.sample("x", dist.Normal(number(0.0), scale))
        pyro.sample("coin", dist.Bernoulli(torch.sigmoid(x)))

    torch.manual_seed(0)
    with gradients():
        proposed = propose(program, (), 20_000)
    assert not proposed.choices["coin"].requires_grad
    (gradient,) = torch.autograd.grad(proposed.choices["x"].square().mean(), scale)
    assert float(gradient) == pytest.approx(2.6, abs=5 * 2 * 1.3 * math.sqrt(2 / 20_000))


def test_a_series_is_differentiated_through_its_steps() -> None:
    weight = leaf(0.8)

    def init() -> Tensor:
        return pyro.sample("x", dist.Normal(number(0.0), 1.0))

    def step(x: Tensor) -> Tensor:
        x = pyro.sample("x", dist.Normal(weight * x, 0.5))
        pyro.sample("y", dist.Normal(x, 0.3))
        return x

    torch.manual_seed(0)
    with gradients():
        trace, total = generate(Series(init, step), (), {}, 3)
        for y in (0.3, -0.2):
            trace, gained = extend(trace, (), {"y": number(y)}, {"x": torch.full((3,), 0.4).double()})
            total = total + gained
        whole = trace.log_prob()
    assert trace.log_prob().requires_grad is False
    (gradient,) = torch.autograd.grad(total.sum(), weight, retain_graph=True)
    before = trace["x", 0].detach()
    exact = ((0.4 - 0.8 * before) * before / 0.25 + (0.4 - 0.32) * 0.4 / 0.25).sum()
    assert float(gradient) == pytest.approx(float(exact))
    torch.testing.assert_close(torch.autograd.grad(whole.sum(), weight)[0], gradient)


# ---- without the context


def test_without_the_context_nothing_carries_gradients() -> None:
    weight = leaf(1.5)
    program = linear(weight, number(0.7))
    torch.manual_seed(0)
    outside, log_weight = generate(program, (), {"y": SEEN}, 2, {"x": leaf(0.4, -0.2)})
    assert not log_weight.requires_grad and not outside.log_prob().requires_grad
    state = torch.get_rng_state()
    plain = simulate(program, (), 1500)
    torch.set_rng_state(state)
    with gradients():
        kept = simulate(program, (), 1500)
    assert not plain["y"].requires_grad and kept["y"].requires_grad
    assert torch.equal(plain["x"], kept["x"])
    assert not outside.log_prob().requires_grad and not kept.log_prob().requires_grad


def test_a_trace_that_was_made_outside_is_differentiated_whole() -> None:
    """Its sites hold a value that was given, but not what was computed of it without gradients."""
    weight, x = leaf(1.5), leaf(0.4, -0.2)
    outside, _ = generate(linear(weight, number(0.7)), (), {"y": SEEN}, 2, {"x": x})
    outside.log_prob()
    with gradients():
        inside = outside.log_prob()
    errors = SEEN - 1.5 * x.detach()[:, None]
    of_x, of_weight = torch.autograd.grad(inside.sum(), [x, weight])
    torch.testing.assert_close(of_x, -x.detach() / 4 + 1.5 * errors.sum(1) / 0.49)
    torch.testing.assert_close(of_weight, (x.detach()[:, None] * errors).sum()[None] / 0.49)


@pytest.mark.parametrize("series", [False, True])
def test_training_on_one_trace_reaches_the_exact_optimum(series: bool) -> None:
    """Each loss is that of the parameters' present values, though the trace and its run are of the first."""
    shift = torch.nn.Parameter(torch.tensor(0.0, dtype=torch.float64))

    def program(*_: Tensor) -> Tensor:
        x = pyro.sample("x", dist.Normal(number(0.0), 1.0))
        pyro.sample("y", dist.Normal(x + shift, 1.0))
        return x

    if series:
        start, _ = generate(Series(lambda: pyro.deterministic("none", number(0.0)), program), (), {}, 20)
        trace, _ = extend(start, (), {"y": number(2.0)})
    else:
        trace, _ = generate(program, (), {"y": number(2.0)}, 20)
    with gradients():
        for _ in range(60):
            (slope,) = torch.autograd.grad(-trace.log_prob("y").mean(), shift)
            shift.data -= 0.3 * slope
    assert float(shift.detach()) == pytest.approx(float(2.0 - trace["x"].mean()), abs=1e-6)


def test_the_context_ends_with_an_error() -> None:
    with pytest.raises(ZeroDivisionError), gradients():
        _ = 1 / 0
    assert not graph.kept()


# ---- what cuts the gradient


class Simulated(LazyDistribution):
    """A likelihood that leaves torch, or is cut within it."""

    def __init__(self, pose: Tensor, detached: bool) -> None:
        self.detached = detached
        self.pose = pose
        super().__init__(len(pose), ())

    def log_prob(self, value: Tensor) -> Tensor:
        if self.detached:
            return -((self.pose.detach() - value) ** 2)
        return torch.from_numpy(-((self.pose.numpy() - value.numpy()) ** 2))


@pytest.mark.parametrize(
    ("kind", "match"),
    [
        ("numpy", r"site 'seen' takes a value that carries gradients out of torch"),
        ("detached", r"site 'seen' depends on a tensor that asks for gradients and passes no gradient on"),
        ("program", r"the program, after site 'x', takes a value that carries gradients out of torch"),
    ],
)
def test_what_cuts_the_gradient_is_refused_by_name(kind: str, match: str) -> None:
    def program() -> None:
        x = pyro.sample("x", dist.Normal(number(0.0), 1.0))
        if kind == "program":
            x = torch.from_numpy(2.0 * x.numpy())
        pyro.sample("seen", Simulated(x, kind == "detached"))

    with pytest.raises(InputError, match=match) as caught, gradients():
        generate(program, (), {"seen": number(0.3)}, 4, {"x": leaf(0.1, 0.2, 0.3, 0.4)})
    assert "\n" not in str(caught.value)
    # Of values that carry none, a simulator is evaluated as ever; so is one of a detached value.
    with gradients():
        _, log_weight = generate(program, (), {"seen": number(0.3)}, 4, {"x": torch.zeros(4).double()})
    assert not log_weight.requires_grad


def test_a_uniform_density_has_the_gradient_zero_and_is_not_refused() -> None:
    def program() -> None:
        pyro.sample("x", dist.Uniform(number(0.0), 2.0))

    with gradients():
        assert not assess(program, (), {"x": leaf(0.5, 1.0)}, 2).requires_grad


def test_tensors_are_looked_for_in_closures_and_containers() -> None:
    parameter, empty = leaf(1.0), lambda: late
    assert graph.carries({"a": [(lambda: parameter,)]})
    assert graph.carries(torch.nn.Linear(2, 2)) and graph.carries(torch.nn.Linear(2, 2).forward)
    assert not graph.carries({"a": [parameter.detach(), "text", empty]})
    late = None


def test_what_is_evaluated_after_the_context_is_a_constant_and_what_within_is_present() -> None:
    shift = torch.nn.Parameter(torch.tensor(0.5, dtype=torch.float64))

    def program() -> Tensor:
        x = pyro.sample("x", dist.Normal(number(0.0), 1.0))
        pyro.factor("bonus", shift * x)
        return pyro.deterministic("moved", x + shift)

    with gradients():
        trace, _ = generate(program, (), {}, 3)
    assert not trace.log_prob().requires_grad
    shift.data += 1.0
    with gradients():
        for value in (trace["moved"], trace.result):
            torch.testing.assert_close(value.detach(), trace["x"] + 1.5)
            assert float(torch.autograd.grad(value.sum(), shift)[0]) == 3.0
