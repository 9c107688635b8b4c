"""What is wrong with a program or with what it is given is one sentence that names the address."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from bcppl.errors import InputError, NotANumberError, NoWeightError
from bcppl.inference.population import Population
from bcppl.traces import assess, extend, generate, simulate, update
from tests.invariance import number
from tests.small_programs import Felt, beside_the_plate, first_entry, line

N = 5


def growing(steps: int) -> None:
    x = pyro.sample("x", dist.Normal(number(0.0), 1.0))
    for k in range(steps):
        pyro.sample(f"a_{k}", dist.Normal(x, 1.0))


def latent_and_seen(*, scale: Any = 1.0) -> None:
    x = pyro.sample("x", dist.Normal(number(0.0), 1.0))
    pyro.sample("y", dist.Normal(x, scale))


def twice() -> None:
    pyro.sample("x", dist.Normal(number(0.0), 1.0))
    pyro.sample("x", dist.Normal(number(0.0), 1.0))


def stacked() -> None:
    pyro.sample("x", dist.Normal(torch.zeros(3, N), 1.0))


def plated(mean: Tensor, dim: int | None = None, name: str = "points", subsample: int | None = None) -> None:
    with pyro.plate(name, 3, subsample_size=subsample, dim=dim):
        pyro.sample("x", dist.Normal(mean, 1.0))


def sampled_from_a_function() -> None:
    pyro.sample("x", lambda: torch.zeros(N))


def enumerated() -> None:
    pyro.sample("x", dist.Bernoulli(number(0.5)), infer={"enumerate": "parallel"})


def refusing() -> None:
    pyro.sample("x", dist.Normal(number(0.0), 1.0))
    raise InputError("the scene has no part; give one.")


def vanishing(steps: int) -> None:
    if steps == 0:
        pyro.sample("x", dist.Normal(number(0.0), 1.0))


def wide() -> None:
    class Wide(Felt):
        def log_prob(self, value: Tensor) -> Tensor:
            return torch.zeros(3, N)

    pyro.sample("x", dist.Normal(number(0.0), 1.0))
    pyro.sample("y", Wide(torch.zeros(N)))


def branching() -> None:
    x = pyro.sample("x", dist.Bernoulli(number(0.5)))
    if bool((x == 1).all()):
        pyro.sample("only then", dist.Normal(number(0.0), 1.0))


def of_one_number(take: Callable[[Tensor], Any]) -> None:
    take(pyro.sample("x", dist.Normal(number(0.0), 1.0)))


def of_torch() -> None:
    pyro.sample("x", torch.distributions.Normal(number(0.0), 1.0))


def sampled_whole() -> None:
    pyro.sample("x", dist.Categorical(torch.tensor([0.5, 0.5])))


def updated(values: dict[str, Tensor]) -> Any:
    return update(generate(latent_and_seen, (), {"y": number(0.0)}, N)[0], values)


ones = torch.ones(N, dtype=torch.float64)
REFUSED: dict[str, tuple[Callable[[], Any], str]] = {
    "never visited": (
        lambda: generate(latent_and_seen, (), {"q": number(0.0)}, N),
        "'q'.* never visits.* x, y",
    ),
    "never visited, extend": (
        lambda: extend(generate(growing, (0,), {}, N)[0], (1,), {"a_9": number(0.0)}),
        "'a_9'.* never visits",
    ),
    "observed again": (
        lambda: extend(generate(growing, (1,), {"a_0": number(0.0)}, N)[0], (1,), {"a_0": number(0.0)}),
        "'a_0' was observed or sampled before",
    ),
    "vanished": (lambda: extend(simulate(vanishing, (0,), N), (1,), {}), "no longer visits address 'x'"),
    "no number": (lambda: generate(latent_and_seen, (), {"y": "x"}, N), "'y' is a str"),  # type: ignore[dict-item]
    "wrong shape": (
        lambda: generate(latent_and_seen, (), {"y": torch.zeros(3)}, N),
        "'y' has shape \\(3,\\)",
    ),
    "one observation for each": (
        lambda: generate(latent_and_seen, (), {"y": torch.zeros(N)}, N),
        "'y' has shape \\(5,\\).* the same for all particles",
    ),
    "twice": (lambda: simulate(twice, (), N), "'x' twice"),
    "batch (3, N)": (lambda: simulate(stacked, (), N), r"'x' has batch shape \(3, 5\)"),
    "batch (3,)": (
        lambda: simulate(beside_the_plate, (), N),
        "'x' has 3 entries where there are 5 particles; .*k.*to_event",
    ),
    "stacked in a plate": (
        lambda: simulate(plated, (torch.zeros(2, 3, 1),), N),
        r"'x' .* \(2, 3, 5\) .* \(3, 5\)",
    ),
    "parameters of a plate": (
        lambda: simulate(plated, (torch.zeros(3),), N),
        r"'x' has 3 entries at dimension -1 where plate 'particles' has 5.* \(`\[:, None\]`\)",
    ),
    "parameters of another plate": (
        lambda: simulate(plated, (torch.zeros(4, 1),), N),
        r"'x' has 4 entries at dimension -2 where plate 'points' has 3",
    ),
    "plate on the particles' dimension": (
        lambda: simulate(plated, (torch.zeros(3), -1), N),
        "'points' is put at dimension -1, .* 'particles'; leave its `dim` out",
    ),
    "plate of the particles' name": (
        lambda: simulate(plated, (torch.zeros(3, 1), None, "particles"), N),
        "same name .* rename",
    ),
    "subsampled plate": (
        lambda: simulate(plated, (torch.zeros(2, 1), None, "points", 2), N),
        "'x' .* subsampled plate",
    ),
    "observation of a plate": (
        lambda: generate(plated, (torch.zeros(3, 1),), {"x": torch.zeros(4)}, N),
        r"'x' has shape \(4,\); one value .* \(3,\), .* \(5, 3\)",
    ),
    "observation of a plate for each particle": (
        lambda: generate(plated, (torch.zeros(3, 1),), {"x": torch.zeros(N, 3)}, N),
        r"'x' has shape \(5, 3\), .* \(3,\); give one value",
    ),
    "no distribution": (lambda: simulate(sampled_from_a_function, (), N), "'x' .*function; give"),
    "enumerated": (lambda: simulate(enumerated, (), N), "'x' is enumerated"),
    "log-probabilities": (lambda: simulate(wide, (), N).log_prob(), r"'y' has log-probabilities .*\(3, 5\)"),
    "no such site": (lambda: simulate(latent_and_seen, (), N).log_prob("q"), "'q' .* never visits"),
    "update of an observation": (
        lambda: updated({"y": ones}),
        "'y' was given or asked for, which is no latent.* x",
    ),
    "update of nothing": (lambda: updated({"q": ones}), "'q' was given or asked for, which is no latent"),
    "update of wrong shape": (lambda: updated({"x": ones[:3]}), r"'x' has shape \(3,\), the old one \(5,\)"),
    "update that changes the addresses": (
        lambda: update(t := simulate(branching, (), 1), {"x": 1.0 - t["x"]}),
        "which addresses",
    ),
    "assess without a choice": (
        lambda: assess(latent_and_seen, (), {"x": ones}, N),
        "a value for address 'y'",
    ),
    "assess with one too many": (
        lambda: assess(latent_and_seen, (), {"x": ones, "y": ones, "q": ones}, N),
        "'q'.* never visits",
    ),
    "assess of wrong length": (
        lambda: assess(latent_and_seen, (), {"x": ones[:3], "y": ones}, N),
        r"'x' has shape \(3,\); .* particles \(5,\)",
    ),
    "no particles": (lambda: simulate(latent_and_seen, (), 0), "for 0 particles; give a whole number, 1"),
    "arguments that are no tuple": (lambda: simulate(growing, 5, 4), "of type int; give a tuple"),  # type: ignore[arg-type]
    "particles that are no number": (
        lambda: simulate(latent_and_seen, (), 2.5),  # type: ignore[arg-type]
        "for 2.5 particles; .* a whole number",
    ),
    "distribution of torch": (lambda: simulate(of_torch, (), N), "'x' .* torch.*; give .* `pyro.distri"),
    "data without a last axis": (
        lambda: simulate(line, (torch.zeros(3),), N),
        r"after site 'slope' .* tensor a \(5\) .* tensor b \(3\).*5 particles; .*`\[:, None\]`",
    ),
    "entry of a vector": (lambda: simulate(first_entry, (), N), r"'x' has 3 .* 5 particles; .*`\[:, k\]`"),
    "no such value": (lambda: simulate(latent_and_seen, (), N)["q"], "no value at address 'q'; it has x, y"),
    "update by a number": (lambda: updated({"x": 1.0}), "'x' has shape .., the old one"),
    "update by a word": (lambda: updated({"x": "one"}), "'x' is a str; give a tensor"),  # type: ignore[dict-item]
    "update of whole numbers by reals": (
        lambda: update(simulate(sampled_whole, (), N), {"x": ones}),
        "'x' is of torch.float64, the old one of torch.int64",
    ),
    "an error of the program itself": (
        lambda: simulate(refusing, (), N),
        "^the scene has no part; give one.$",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refusals_are_one_sentence_that_names_the_address(case: str) -> None:
    act, says = REFUSED[case]
    with pytest.raises(InputError, match=says) as caught:
        act()
    text = str(caught.value)
    assert "\n" not in text and text.endswith(".") and ". " not in text, text


@pytest.mark.parametrize(("bad", "said"), [(math.nan, "nan"), (math.inf, "inf")])
def test_a_log_probability_that_is_no_number_names_site_and_particles(bad: float, said: str) -> None:
    class Broken(Felt):
        def log_prob(self, value: Tensor) -> Tensor:
            return torch.tensor([0.0, bad, -math.inf, bad, 0.0], dtype=torch.float64)

    def program() -> None:
        x = pyro.sample("x", dist.Normal(number(0.0), 1.0))
        pyro.sample("felt", Broken(x))

    with pytest.raises(NotANumberError, match=rf"'felt' .* {said} for 2 of 5 particles \(first: 1, 3\)"):
        generate(program, (), {"felt": number(0.0)}, N)


@pytest.mark.parametrize(
    "take", [bool, float, int, math.sqrt, range, lambda x: x.item(), lambda x: 1 if x > 0 else 2]
)
def test_particles_are_no_single_number(take: Callable[[Tensor], Any]) -> None:
    with pytest.raises(InputError, match=r"after site 'x' .* 5 particles .*`torch.where`"):
        simulate(of_one_number, (take,), N)


def test_errors_of_the_program_that_particles_do_not_bring_about_stay_as_they_are() -> None:
    with pytest.raises(RuntimeError, match=r"tensor a \(3\) must match the size of tensor b \(2\)"):
        simulate(of_one_number, (lambda x: torch.zeros(3) + torch.zeros(2),), N)
    with pytest.raises(TypeError, match="unsupported operand"):
        simulate(of_one_number, (lambda x: x + "a",), N)  # type: ignore[operator]


@pytest.mark.parametrize("value", [number(0.7), torch.tensor(1)])
def test_a_choice_without_the_particle_axis_is_that_of_all_particles(value: Tensor) -> None:
    trace, weight = generate(latent_and_seen, (), {"y": number(0.5)}, N, {"x": value})
    whole, expected = generate(latent_and_seen, (), {"y": number(0.5)}, N, {"x": value * ones})
    torch.testing.assert_close(weight, expected)
    assert trace["x"].shape == (N,) and trace["x"].dtype == torch.float64
    torch.testing.assert_close(trace[[1, 3]].log_prob(), whole[[1, 3]].log_prob())
    longer, _ = extend(simulate(growing, (0,), N), (1,), {}, {"a_0": value})
    assert longer["a_0"].shape == (N,) and longer["a_0"].dtype == torch.float64
    moved = update(trace, {"x": torch.full((N,), 2)}).trace
    assert moved["x"].dtype == torch.float64


def test_an_observation_that_is_no_number_is_named() -> None:
    with pytest.raises(NotANumberError, match="observation at site 'y' is NaN in 1 of 1 entries"):
        generate(latent_and_seen, (), {"y": number(math.nan)}, N)


def test_what_no_particle_can_explain_is_named() -> None:
    def program() -> None:
        x = pyro.sample("x", dist.Normal(number(0.0), 1.0))
        pyro.sample("near", dist.Normal(x, 1.0))
        pyro.sample("far", dist.Uniform(x, x + 1.0))

    trace, weights = generate(program, (), {"near": number(0.0), "far": number(99.0)}, N)
    assert trace.impossible() == trace[[0, 1]].impossible() == ["far"]
    with pytest.raises(NoWeightError, match="'far' is impossible at every particle; widen the prior"):
        _ = Population(trace, weights).effective_sample_size


def test_a_scaled_or_masked_site_is_refused_by_name() -> None:
    """A handler's scale would be dropped silently."""

    def scaled() -> None:
        with pyro.poutine.scale(scale=0.5):
            pyro.sample("x", dist.Normal(torch.tensor(0.0), 1.0))

    def masked() -> None:
        with pyro.poutine.mask(mask=torch.tensor(False)):
            pyro.sample("x", dist.Normal(torch.tensor(0.0), 1.0))

    for program in (scaled, masked):
        with pytest.raises(InputError, match="'x'"):
            simulate(program, (), 3)
