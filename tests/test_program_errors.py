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

from bcppl.distributions.lazy import LazyDistribution
from bcppl.errors import InferenceError, InputError
from bcppl.traces import assess, extend, generate, simulate, update

N = 5


def number(value: float) -> Tensor:
    return torch.tensor(value, dtype=torch.float64)


class Felt(LazyDistribution):
    """Anything that is felt at x; what its log-probability is, is said by those that inherit from it."""

    def __init__(self, x: Tensor) -> None:
        super().__init__(len(x), (), (x,))

    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        return torch.zeros(self.batch_shape)


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


def beside_the_plate() -> None:
    pyro.sample("x", dist.Normal(torch.zeros(3), 1.0))


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
    "no tensor": (lambda: generate(latent_and_seen, (), {"y": 1.0}, N), "'y' is a float"),  # type: ignore[dict-item]
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
    "no distribution": (lambda: simulate(sampled_from_a_function, (), N), "'x' is sampled from a function"),
    "enumerated": (lambda: simulate(enumerated, (), N), "'x' is enumerated"),
    "log-probabilities": (lambda: simulate(wide, (), N).log_prob(), r"'y' has log-probabilities .*\(3, 5\)"),
    "no such site": (lambda: simulate(latent_and_seen, (), N).log_prob("q"), "no address 'q'"),
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
    "no particles": (lambda: simulate(latent_and_seen, (), 0), "for 0 particles; give 1 or more"),
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

    with pytest.raises(InferenceError, match=rf"'felt' .* {said} for 2 of 5 particles \(first: 1, 3\)"):
        generate(program, (), {"felt": number(0.0)}, N)


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
