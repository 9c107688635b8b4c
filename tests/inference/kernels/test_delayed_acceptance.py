"""Delayed acceptance: the same target, physics for the survivors only, and mutants that the tests find."""

from __future__ import annotations

import math
from collections.abc import Callable

import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from bcppl.distributions.lazy import LazyDistribution
from bcppl.errors import InputError
from bcppl.inference.kernels import (
    Kernel,
    cycle,
    delayed_acceptance,
    metropolis_hastings,
    mixture,
    moved_by,
    repeat,
    sequence,
    student_t,
    surrogate_transition,
)
from bcppl.inference.kernels.staged import Screened, Staged, SurrogateTarget
from bcppl.inference.population import Population
from bcppl.inference.proposals import drift
from bcppl.inference.targets import POSTERIOR, Target
from bcppl.traces import Trace, generate

DRAWS = 20_000
SOUND, BROKEN = 4.5, 8.0  # |z| of the worst expectation: below if invariant, above if not


def number(value: float) -> Tensor:
    return torch.tensor(value, dtype=torch.float64)


class Seen(LazyDistribution):
    """A Gaussian about a place, of scale 1, that notes by name how many particles it is asked for."""

    asked: list[tuple[str, int]] = []  # noqa: RUF012

    def __init__(self, name: str, value: Tensor, cost: int) -> None:
        self.name, self.value, self.cost = name, value, cost
        super().__init__(len(value), ())

    @property
    def log_prob_bound(self) -> float:
        return 0.0

    def log_prob(self, value: Tensor) -> Tensor:
        Seen.asked.append((self.name, len(self.value)))
        return -0.5 * (value - self.value) ** 2


def program() -> None:
    """Four precisions of 1 for x, prior included, and a depth between two touches."""
    x = pyro.sample("x", dist.Normal(number(0.0), 1.0))
    pyro.sample("touch_0", Seen("touch_0", x, 2))
    pyro.sample("depth_1", Seen("depth_1", x, 1))
    pyro.sample("touch_2", Seen("touch_2", x, 2))


OBSERVED = {"touch_0": number(1.0), "depth_1": number(-1.0), "touch_2": number(4.0)}
HALF = Target({"touch_0": 0.5, "touch_2": 0.5})


def exact(count: int, exponent: float = 1.0) -> Trace:
    """The posterior by Gauss: precision 2 + 2 exponent."""
    precision = 2.0 + 2.0 * exponent
    mean = (-1.0 + exponent * 5.0) / precision
    trace, _ = generate(program, (), OBSERVED, count)
    return trace.at({"x": mean + torch.randn(count, dtype=torch.float64) / math.sqrt(precision)})


def leaning(trace: Trace) -> None:
    """Not symmetric: the reverse move has another density."""
    pyro.sample("x", dist.Normal(0.6 * trace["x"] + 0.1, 0.5))


def worst_z(kernel: Kernel, target: Target = POSTERIOR, exponent: float = 1.0, times: int = 2) -> float:
    torch.manual_seed(1)
    move = kernel(Population(exact(500)))
    trace = exact(DRAWS, exponent)

    def functions(trace: Trace) -> Tensor:
        x = trace["x"]
        return torch.stack([x, x**2, torch.sin(2 * x), (x > 1.0).double()], dim=1)

    before = functions(trace)
    for _ in range(times):
        trace, _ = move(trace, target)
    change = functions(trace) - before
    assert bool((change != 0.0).any()), "nothing moved"
    return float((change.mean(dim=0) / (change.std(dim=0) / math.sqrt(DRAWS))).abs().max())


LEANING = metropolis_hastings(leaning)
WALK = metropolis_hastings(drift("x", (0.5, 2.0)))

SOUND_KERNELS: dict[str, Kernel] = {
    "two stages": delayed_acceptance(LEANING, first="depth_*"),
    "no site first": delayed_acceptance(LEANING, first=[]),
    "a stage for each site": delayed_acceptance(LEANING, stages=3),
    "more stages than sites": delayed_acceptance(WALK, ["touch_0"], stages=9),
    "surrogate": delayed_acceptance(LEANING, surrogate=student_t("x")),
    "bad surrogate": delayed_acceptance(LEANING, surrogate=lambda _: lambda trace: -2.0 * trace["x"]),
    "transition": surrogate_transition(cycle(LEANING, WALK), student_t("x")),
    "bad transition": surrogate_transition(repeat(LEANING, 2), lambda _: lambda trace: -2.0 * trace["x"]),
    "repeat": repeat(delayed_acceptance(WALK, surrogate=student_t("x")), 3),
    "around others": delayed_acceptance(cycle(LEANING, mixture([WALK, LEANING]))),
    "within others": mixture([cycle(delayed_acceptance(LEANING), WALK), delayed_acceptance(WALK, stages=3)]),
}


@pytest.mark.parametrize("name", SOUND_KERNELS)
def test_the_target_is_exact(name: str) -> None:
    assert worst_z(SOUND_KERNELS[name]) < SOUND


@pytest.mark.parametrize("name", ["two stages", "surrogate", "transition", "within others"])
def test_tempered_targets_are_exact(name: str) -> None:
    assert worst_z(SOUND_KERNELS[name], HALF, exponent=0.5) < SOUND
    assert worst_z(SOUND_KERNELS[name], POSTERIOR, exponent=0.5) > BROKEN


# ---- mutants

Accept = Callable[[Staged, Trace, Trace, Tensor], tuple[Tensor, Trace]]


def mutant(sign: float, ratio_in_all: bool, forgotten: int | None) -> Accept:
    """A staged decision by evaluating everything, with a mistake in it."""

    def accept(self: Staged, old: Trace, new: Trace, log_ratio: Tensor) -> tuple[Tensor, Trace]:
        taken = torch.ones(len(old), dtype=torch.bool)
        for k, addresses in enumerate(self.stages(new)):
            if k == forgotten:
                continue
            stage = self.part(new, addresses) - self.part(old, addresses)
            stage = (sign if k else 1.0) * stage + (log_ratio if k == 0 or ratio_in_all else 0.0)
            taken &= torch.log(torch.rand(len(old), dtype=torch.float64)) < stage
        index = taken.nonzero().flatten()
        return index, new[index]

    return accept


def test_mutants_of_stages(monkeypatch: pytest.MonkeyPatch) -> None:
    kernel = delayed_acceptance(LEANING)
    monkeypatch.setattr(Staged, "accept", mutant(1.0, False, None))
    assert worst_z(kernel) < SOUND, "the mutants' own frame is sound"
    for name, broken in {
        "the second stage's ratio upside down": mutant(-1.0, False, None),
        "the proposal's ratio in both stages": mutant(1.0, True, None),
        "a stage forgotten": mutant(1.0, False, 1),
    }.items():
        monkeypatch.setattr(Staged, "accept", broken)
        assert worst_z(kernel) > BROKEN, name


def test_mutant_that_does_not_undo_its_surrogate(monkeypatch: pytest.MonkeyPatch) -> None:
    above = Target.above

    def forgetful(self: Screened, new: Trace, needed: Tensor) -> tuple[Tensor, Trace]:
        return above(self, new, needed + (self.surrogate(last[0]) - self.surrogate(new)))

    last: list[Trace] = []

    def screened(self: Screened, old: Trace, new: Trace, log_ratio: Tensor) -> tuple[Tensor, Trace]:
        guessed = self.surrogate(new) - self.surrogate(old) + log_ratio
        index = (guessed > torch.log(torch.rand(len(old), dtype=torch.float64))).nonzero().flatten()
        last[:] = [old[index]]
        chance = torch.log(torch.rand(len(index), dtype=torch.float64))
        needed = chance + (self(old) + self.surrogate(new) - self.surrogate(old))[index]
        passed, survivors = self.above(new[index], needed)
        return index[passed], survivors

    kernel = delayed_acceptance(LEANING, surrogate=student_t("x"))
    monkeypatch.setattr(Screened, "accept", screened)
    assert worst_z(kernel) < SOUND, "the mutant's own frame is sound"
    monkeypatch.setattr(Screened, "above", forgetful)
    assert worst_z(kernel) > BROKEN


def test_mutants_of_transitions(monkeypatch: pytest.MonkeyPatch) -> None:
    kernel = surrogate_transition(repeat(LEANING, 2), student_t("x"))
    accept = SurrogateTarget.accept

    def one_way(self: SurrogateTarget, old: Trace, new: Trace, log_ratio: Tensor) -> tuple[Tensor, Trace]:
        return accept(self, old, new, torch.zeros_like(log_ratio))

    monkeypatch.setattr(SurrogateTarget, "accept", one_way)
    assert worst_z(kernel) > BROKEN, "the moves do not leave the surrogate invariant"
    monkeypatch.setattr(SurrogateTarget, "accept", accept)
    above = Target.above
    monkeypatch.setattr(
        Target, "above", lambda self, new, needed, *_: above(self, new, needed + 0.5 * new["x"])
    )
    assert worst_z(kernel) > BROKEN, "the decision leaves out a part of the ratio"


# ---- what is evaluated


def test_stages_run_in_order_and_late_sites_for_survivors_only() -> None:
    torch.manual_seed(0)
    trace = exact(2000)
    move = delayed_acceptance(LEANING, first="depth_*", stages=3)(Population(trace))
    POSTERIOR(trace)
    Seen.asked.clear()
    moved, accepted = move(trace, POSTERIOR)
    names, counts = zip(*Seen.asked, strict=True)
    assert names == ("depth_1", "touch_0", "touch_2")
    assert counts[0] == 2000
    assert int(accepted.sum()) < counts[2] < counts[1] < 2000
    assert torch.equal(accepted == 1.0, moved["x"] != trace["x"])
    fresh, _ = generate(program, (), OBSERVED, 2000)
    torch.testing.assert_close(moved.log_prob(), fresh.at({"x": moved["x"]}).log_prob())


def test_a_surrogate_decides_before_any_site() -> None:
    torch.manual_seed(0)
    trace = exact(2000)
    walk = metropolis_hastings(drift("x", (3.0, 4.0)))
    POSTERIOR(trace)
    Seen.asked.clear()
    delayed_acceptance(walk, surrogate=student_t("x"))(Population(trace))(trace, POSTERIOR)
    assert [name for name, _ in Seen.asked] == ["depth_1", "touch_0", "touch_2"]
    assert 0 < max(count for _, count in Seen.asked) < 1000


def test_a_transition_asks_each_costly_site_once_for_those_that_moved() -> None:
    torch.manual_seed(0)
    trace = exact(2000)
    POSTERIOR(trace)
    Seen.asked.clear()
    surrogate = lambda _: lambda each: each.log_prob("x", "depth_1")  # noqa: E731
    moved, accepted = surrogate_transition(repeat(WALK, 5), surrogate)(Population(trace))(trace, POSTERIOR)
    asked = [each for each in Seen.asked if each[0] != "depth_1"]
    assert [name for name, _ in asked] == ["touch_0", "touch_2"]
    assert int(accepted.sum()) < asked[1][1] < asked[0][1] < 2000
    assert torch.equal(accepted == 1.0, moved["x"] != trace["x"])
    fresh, _ = generate(program, (), OBSERVED, 2000)
    torch.testing.assert_close(moved.log_prob(), fresh.at({"x": moved["x"]}).log_prob())


IN_ORDER = sequence(LEANING, WALK)


@pytest.mark.parametrize(
    "kernel",
    [
        *(IN_ORDER, repeat(IN_ORDER, 2), cycle(IN_ORDER, WALK), mixture([WALK, IN_ORDER])),
        *(
            delayed_acceptance(WALK),
            surrogate_transition(WALK, student_t("x")),
            lambda population: WALK(population),
        ),
    ],
)
def test_a_transition_refuses_what_may_not_be_reversible_under_a_surrogate(kernel: Kernel) -> None:
    with pytest.raises(InputError, match="not known to be reversible"):
        surrogate_transition(kernel, student_t("x"))


def three_states() -> None:
    state = pyro.sample("x", dist.Categorical(torch.ones(3, dtype=torch.float64)))
    pyro.sample("y", dist.Bernoulli(THREE[state.long()]))


THREE = torch.tensor([0.6, 0.3, 0.1], dtype=torch.float64)


def exchanging(one: int, other: int) -> Kernel:
    """Proposes another of two states nearly always, and elsewhere the same."""
    rows = torch.full((3, 3), 0.02, dtype=torch.float64) + 0.94 * torch.eye(3, dtype=torch.float64)
    rows[[one, other]] = rows[[other, one]]
    return metropolis_hastings(lambda trace: pyro.sample("x", dist.Categorical(rows[trace["x"].long()])))


def test_a_transition_of_a_cycle_stays_exact_in_each_run() -> None:
    """An order of the moves that all particles shared would leave an error that does not fall with N."""
    kernel = surrogate_transition(cycle(exchanging(0, 1), exchanging(1, 2)), lambda _: lambda t: 0.0 * t["x"])
    count = 20_000
    for seed in range(4):
        torch.manual_seed(seed)
        drawn = torch.multinomial(THREE, count, replacement=True).double()
        trace, _ = generate(three_states, (), {"y": number(1.0)}, count, {"x": drawn})
        moved, _ = kernel(Population(trace))(trace, POSTERIOR)
        share = torch.bincount(moved["x"].long(), minlength=3) / count
        assert float(((share - THREE) / (THREE * (1 - THREE) / count).sqrt()).abs().max()) < SOUND


def test_an_order_that_reads_the_same_backwards_is_reversible() -> None:
    kernel = surrogate_transition(sequence(WALK, LEANING, WALK), lambda _: lambda trace: -2.0 * trace["x"])
    assert worst_z(kernel) < SOUND


def test_sites_that_count_for_nothing_are_not_asked() -> None:
    trace = exact(50)
    move = delayed_acceptance(LEANING, stages=3)(Population(trace))
    Seen.asked.clear()
    move(trace, Target({"touch_0": 0.0}))
    assert {name for name, _ in Seen.asked} == {"depth_1", "touch_2"}


def test_stages_are_what_was_asked_for() -> None:
    trace = exact(2)
    assert Staged().stages(trace) == [["x", "depth_1"], ["touch_0", "touch_2"]]
    assert Staged(first=("touch_2",), later=2).stages(trace) == [["x", "touch_2"], ["depth_1"], ["touch_0"]]
    assert Staged({"touch_0": 0.0}, None, 5).stages(trace) == [["x", "depth_1"], ["touch_2"]]
    assert Staged(first=("*",)).stages(trace) == [["x", "touch_0", "depth_1", "touch_2"]]


# ---- what is refused


def looking(site: str) -> Callable[[Trace], None]:
    def proposal(trace: Trace) -> None:
        wide = 1.0 + 0.1 * torch.tanh(trace.log_prob(site))
        pyro.sample("x", dist.Normal(trace["x"], wide))

    return proposal


def test_a_way_back_that_reads_a_later_stage_is_refused() -> None:
    trace = exact(50)
    population = Population(trace)
    touch, depth = metropolis_hastings(looking("touch_0")), metropolis_hastings(looking("depth_1"))
    for kernel in (delayed_acceptance(touch), delayed_acceptance(touch, surrogate=student_t("x"))):
        with pytest.raises(InputError, match="touch_0"):
            moved_by(population, kernel, POSTERIOR)
    with pytest.raises(InputError, match="depth_1"):
        moved_by(population, delayed_acceptance(depth, first="touch_*"), POSTERIOR)
    for kernel in (touch, delayed_acceptance(depth), delayed_acceptance(touch, first="touch_0")):
        moved_by(population, kernel, POSTERIOR)
    assert worst_z(delayed_acceptance(depth)) < SOUND


def test_what_cannot_be_is_refused() -> None:
    trace = exact(5)
    for make, message in (
        (lambda: delayed_acceptance(WALK, stages=1), "1 stages"),
        (lambda: delayed_acceptance(WALK, "depth_*", surrogate=student_t("x")), "a surrogate"),
        (lambda: student_t("x", degrees=0.0), "0.0 degrees"),
    ):
        with pytest.raises(InputError, match=message):
            make()
    with pytest.raises(InputError, match=r"'image_\*', which fits no address; .*depth_1"):
        delayed_acceptance(WALK, "image_*")(Population(trace))(trace, POSTERIOR)
