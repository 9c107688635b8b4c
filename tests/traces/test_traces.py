"""Traces and the verbs on them: what is evaluated, what is kept, and what is refused."""

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
from bcppl.distributions.poses import NormalPose, UniformPose
from bcppl.errors import InputError
from bcppl.traces import Trace, assess, extend, generate, propose, regenerate, simulate, update
from tests.invariance import number
from tests.small_programs import normal_log

N = 5


class Counted(LazyDistribution):
    """A normal about x that counts how often its log-probability is computed."""

    def __init__(self, calls: list[str], name: str, x: Tensor) -> None:
        self.calls, self.name, self.x = calls, name, x
        super().__init__(len(x), ())

    def log_prob(self, value: Tensor) -> Tensor:
        self.calls.append(self.name)
        return normal_log(value, self.x, 0.5)

    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        return self.x + 0.5 * torch.randn(len(self.x), dtype=torch.float64)


def counted(calls: list[str]) -> Callable[[int], None]:
    """Two latents, and one counted observation of each for every step."""

    def program(steps: int) -> None:
        x = pyro.sample("x", dist.Normal(number(0.0), 1.0))
        z = pyro.sample("z", dist.Normal(x, 2.0))
        for k in range(steps):
            pyro.sample(f"a_{k}", Counted(calls, f"a_{k}", x))
            pyro.sample(f"b_{k}", Counted(calls, f"b_{k}", z))

    return program


def seen(steps: int, first: int = 0) -> dict[str, Tensor]:
    return {f"{s}_{k}": number(0.3 * k + (s == "b")) for k in range(first, steps) for s in "ab"}


def several(steps: int) -> None:
    """Continuous, discrete, vector and pose latents, some of which come with time."""
    coin = pyro.sample("coin", dist.Bernoulli(number(0.3)))
    x = pyro.sample("x", dist.Normal(torch.zeros(3, dtype=torch.float64), 1.0).to_event(1))
    pose = pyro.sample("pose", UniformPose(poses.identity(), 0.1, 2.0))
    for k in range(steps):
        kind = pyro.sample(f"kind_{k}", dist.Categorical(torch.tensor([0.2, 0.3, 0.5], dtype=torch.float64)))
        pyro.sample(f"y_{k}", dist.Normal(x + pose[:, :3] + coin[:, None], 1.0 + kind[:, None]).to_event(1))


def several_seen(steps: int, first: int = 0) -> dict[str, Tensor]:
    return {f"y_{k}": torch.tensor([k, -1.0, 0.5], dtype=torch.float64) for k in range(first, steps)}


def test_tracing_costs_nothing_and_extending_only_the_new_sites() -> None:
    calls: list[str] = []
    trace, weight = generate(counted(calls), (0,), {}, N)
    assert calls == [] and torch.equal(weight, torch.zeros(N, dtype=torch.float64))
    trace, _ = extend(trace, (2,), seen(2))
    assert sorted(calls) == ["a_0", "a_1", "b_0", "b_1"]
    calls.clear()
    trace, weight = extend(trace, (3,), seen(3, 2))
    assert sorted(calls) == ["a_2", "b_2"]
    torch.testing.assert_close(weight, trace.log_prob("a_2", "b_2"))
    trace.log_prob()
    assert sorted(calls) == ["a_2", "b_2"], "what was known before is not computed again"


def test_extending_in_pieces_weighs_as_generating_all() -> None:
    latent = generate(several, (3,), {}, N)[0].choices
    latent = {a: v for a, v in latent.items() if not a.startswith("y")}
    whole, total = generate(several, (3,), several_seen(3), N)
    whole = whole.at(latent)
    observed = [f"y_{k}" for k in range(3)]
    start = {a: latent[a] for a in ("coin", "x", "pose")}
    pieces = simulate(several, (0,), N).at(start)
    by_hand = torch.zeros(N, dtype=torch.float64)
    for k in range(3):
        pieces, weight = extend(pieces, (k + 1,), several_seen(k + 1, k))
        mean = pieces["x"] + pieces["pose"][:, :3] + pieces["coin"][:, None]
        scale = 1.0 + pieces[f"kind_{k}"][:, None]
        expected = torch.stack(
            [normal_log(several_seen(3)[f"y_{k}"], mean[n], float(scale[n])).sum() for n in range(N)]
        )
        torch.testing.assert_close(weight, expected)
        by_hand += expected
    assert list(pieces.choices) == ["coin", "x", "pose", "kind_0", "kind_1", "kind_2"]
    torch.testing.assert_close(pieces.log_prob(*observed), by_hand)
    # The same values, all at once.
    again = whole.at({a: v for a, v in pieces.choices.items()})
    torch.testing.assert_close(again.log_prob(*observed), by_hand)
    torch.testing.assert_close(again.log_prob(), pieces.log_prob())
    assert total.shape == (N,)


def test_a_site_that_the_program_observes_itself_is_weighed_once() -> None:
    def program(steps: int) -> None:
        x = pyro.sample("x", dist.Normal(number(0.0), 1.0))
        for k in range(steps):
            pyro.sample(f"y_{k}", dist.Normal(x, 1.0), obs=number(2.0))
            pyro.factor(f"f_{k}", -(x**2))

    trace, weight = generate(program, (1,), {}, N)
    one = normal_log(trace["x"], 2.0, 1.0) - trace["x"] ** 2
    torch.testing.assert_close(weight, one)
    trace, weight = extend(trace, (2,), {})
    torch.testing.assert_close(weight, one)
    assert list(trace.choices) == ["x"]


def test_the_log_ratio_is_that_of_the_densities() -> None:
    calls: list[str] = []
    trace, _ = generate(counted(calls), (2,), seen(2), N)
    x, z, new = trace["x"], trace["z"], trace["x"] + 0.7
    trace.log_prob()
    calls.clear()
    updated = update(trace, {"x": new})
    assert calls == [], "nothing is evaluated before the ratio is asked for"
    expected = normal_log(new, 0.0, 1.0) - normal_log(x, 0.0, 1.0)
    expected = expected + normal_log(z, new, 2.0) - normal_log(z, x, 2.0)
    for k in range(2):
        value = seen(2)[f"a_{k}"]
        expected = expected + normal_log(value, new, 0.5) - normal_log(value, x, 0.5)
    torch.testing.assert_close(updated.log_ratio, expected)
    assert set(calls) == {"a_0", "a_1"}, "sites that do not depend on x are kept"
    assert torch.equal(updated.discarded["x"], x) and set(updated.discarded) == {"x"}
    assert torch.equal(trace["x"], x), "the trace itself is as it was"
    back = update(updated.trace, updated.discarded)
    torch.testing.assert_close(back.log_ratio, -expected)


@pytest.mark.parametrize(
    "index",
    [
        torch.tensor([3, 3, 0]),
        torch.tensor([True, False, True, True, False]),
        slice(None, 3),
        [4, 1],
        (4, 1),
        2,
    ],
    ids=["ancestors", "mask", "slice", "list", "tuple", "one"],
)
def test_indexing_takes_everything_along(index: Any) -> None:
    calls: list[str] = []
    trace, _ = generate(counted(calls), (2,), seen(2), N)
    whole = trace.log_prob()
    rows = torch.arange(N)[index if isinstance(index, slice) else torch.as_tensor(index)].reshape(-1)
    calls.clear()
    part = trace[index]
    assert isinstance(part, Trace) and len(part) == len(rows)
    assert torch.equal(part["z"], trace["z"][rows])
    torch.testing.assert_close(part.log_prob(), whole[rows])
    assert calls == [], "known log-probabilities are indexed, not computed"
    # Evaluated for these particles they are the same: none was given to another particle.
    fresh = Trace(part.program, part.args, len(part), part.choices, part.observations)
    torch.testing.assert_close(fresh.log_prob(), whole[rows])


def test_where_takes_each_particle_whole() -> None:
    calls: list[str] = []
    trace, _ = generate(counted(calls), (1,), seen(1), N)
    other = update(trace, {"x": trace["x"] + 1.0, "z": trace["z"] - 1.0}).trace
    first, second = trace.log_prob(), other.log_prob()
    calls.clear()
    mask = torch.tensor([True, False, False, True, False])
    mixed = trace.where(mask, other)
    assert torch.equal(mixed["x"], torch.where(mask, trace["x"], other["x"]))
    torch.testing.assert_close(mixed.log_prob(), torch.where(mask, first, second))
    assert calls == []


def test_what_was_simulated_assesses_to_its_own_density() -> None:
    torch.manual_seed(0)
    trace = simulate(several, (2,), N)
    torch.testing.assert_close(assess(several, (2,), trace.choices, N), trace.log_prob())
    proposed = propose(several, (2,), N)
    torch.testing.assert_close(assess(several, (2,), proposed.choices, N), proposed.log_prob)
    assert propose(lambda: pyro.sample("x", dist.Normal(number(0.0), 1.0)), (), N).result.shape == (N,)
    # The latents' own part, written out: a coin, three normals, a uniform pose, two categoricals.
    coin = torch.where(trace["coin"] == 1, number(math.log(0.3)), number(math.log(0.7)))
    volume = 0.2**3 * (2.0 - math.sin(2.0)) / math.pi
    kinds = torch.tensor([0.2, 0.3, 0.5], dtype=torch.float64).log()
    expected = coin + normal_log(trace["x"], 0.0, 1.0).sum(-1) - math.log(volume)
    expected = expected + kinds[trace["kind_0"]] + kinds[trace["kind_1"]]
    torch.testing.assert_close(trace.log_prob("coin", "x", "pose", "kind_0", "kind_1"), expected)


def test_a_pose_update_is_weighed_by_the_pose_density() -> None:
    center = poses.as_pose([0.1, 0.0, 0.0, 0.8, 0.6, 0.0, 0.0])
    spread = torch.tensor([0.1, 0.1, 0.1, 0.8, 0.8, 0.8], dtype=torch.float64)

    def program() -> None:
        pyro.sample("pose", NormalPose(center, spread))

    trace = simulate(program, (), N)
    new = simulate(program, (), N)["pose"]
    ratio = update(trace, {"pose": new}).log_ratio
    prior = NormalPose(center, spread)
    torch.testing.assert_close(ratio, prior.log_prob(new) - prior.log_prob(trace["pose"]))
    assert float(ratio.abs().min()) > 1e-6
    # q and -q are one pose.
    torch.testing.assert_close(
        assess(program, (), {"pose": torch.cat([new[:, :3], -new[:, 3:]], -1)}, N), prior.log_prob(new)
    )


def test_verbs_leave_pyros_settings_and_draw_from_torchs_generator_only() -> None:
    torch.manual_seed(3)
    first = simulate(several, (2,), N)
    torch.manual_seed(3)
    second = simulate(several, (2,), N)
    assert all(torch.equal(first[a], second[a]) for a in first.choices)
    state = torch.get_rng_state()
    extend(generate(counted([]), (0,), {}, N)[0], (0,), {})
    assert not torch.equal(state, torch.get_rng_state())
    state = torch.get_rng_state()
    first.log_prob()
    update(first, {"x": first["x"] + 1}).log_ratio  # noqa: B018
    assert torch.equal(state, torch.get_rng_state()), "known values are not drawn again"


def test_a_hidden_site_stays_hidden_whatever_is_made_of_the_trace() -> None:
    calls: list[str] = []
    trace, _ = generate(counted(calls), (2,), seen(2), N)
    calls.clear()
    secret = trace.hiding(["a_1"])
    moved = secret.at({"x": secret["x"] + 1.0})
    for each in (
        secret,
        secret[:3],
        moved,
        moved.where(torch.ones(N, dtype=torch.bool), trace),
        trace.where(torch.ones(N, dtype=torch.bool), secret),
        secret.hiding(["b_0"]),
    ):
        for ask in (
            lambda t=each: t.distributions["a_1"],
            lambda t=each: dict(t.distributions),
            lambda t=each: t.log_prob("a_1"),
            lambda t=each: t.log_prob(),
        ):
            with pytest.raises(InputError, match=r"'(a_1|b_0)' is hidden"):
                ask()
        assert list(each.distributions) == each.addresses == list(trace.addresses)
        each.distributions["a_0"]
    torch.testing.assert_close(secret.log_prob("a_0", "x"), trace.log_prob("a_0", "x"))
    assert "a_1" not in calls and torch.equal(secret["a_1"], trace["a_1"])
    with pytest.raises(InputError, match=r"'q' .* never visits"):
        trace.hiding(["q"])
    assert trace.log_prob("a_1").shape == (N,), "the trace itself is as it was"


def test_regenerating_weighs_the_sites_that_were_not_sampled() -> None:
    calls: list[str] = []
    trace, _ = generate(counted(calls), (2,), seen(2), N)
    calls.clear()
    drawn = regenerate(trace, "x")
    assert calls == [] and set(drawn.discarded) == {"x"}
    x, z, new = trace["x"], trace["z"], drawn.trace["x"]
    assert torch.equal(drawn.trace["z"], z) and bool((new != x).all())
    # The prior's ratio cancels against the proposal's; z and what is seen of x remain.
    expected = normal_log(z, new, 2.0) - normal_log(z, x, 2.0)
    for k in range(2):
        value = seen(2)[f"a_{k}"]
        expected = expected + normal_log(value, new, 0.5) - normal_log(value, x, 0.5)
    torch.testing.assert_close(drawn.log_weight, expected)
    assert set(calls) == {"a_0", "a_1"}, "sites that do not depend on x are not evaluated"
    both = regenerate(trace, ["z", "x"])
    prior = both.trace.log_prob("x", "z") - trace.log_prob("x", "z")
    torch.testing.assert_close(both.log_weight, update(trace, both.trace.choices).log_ratio - prior)
    with pytest.raises(InputError, match="'a_0' was given or asked for, which is no latent"):
        regenerate(trace, ["x", "a_0"])
