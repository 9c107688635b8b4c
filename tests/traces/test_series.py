"""Models that are a pair (init, step): the same numbers as the whole program, at the cost of one step."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from bcppl import poses
from bcppl.distributions.poses import NormalPose
from bcppl.errors import InputError
from bcppl.inference.filters.smc import smc
from bcppl.inference.filters.tempering import tempered
from bcppl.inference.kernels import metropolis_hastings
from bcppl.inference.proposals import drift
from bcppl.traces import Model, Series, Trace, assess, extend, generate, regenerate, simulate, update
from bcppl.traces.carried import carried
from tests.invariance import number
from tests.small_programs import normal_log

N, STEPS = 6, 5
SEEN = torch.linspace(-1.0, 2.0, STEPS + 1, dtype=torch.float64)
INDICES = [
    torch.tensor([0, 0, 1, 4, 4, 5]),
    None,
    torch.tensor([5, 4, 3, 2, 1, 0]),
    torch.tensor([2, 2, 2, 3, 3, 3]),
]


def init() -> dict[str, Any]:
    x = pyro.sample("x", dist.Normal(number(0.0), 1.0))
    return {"x": x, "kind": torch.zeros(N if len(x) == N else len(x), dtype=torch.int64), "runs": 0}


def step(state: dict[str, Any], push: float) -> dict[str, Any]:
    kind = pyro.sample("kind", dist.Categorical(torch.tensor([0.3, 0.7], dtype=torch.float64)))
    x = pyro.sample("x", dist.Normal(state["x"] + push * kind, 0.5))
    pyro.sample("y", dist.Normal(x + state["kind"], 0.3))
    return {"x": x, "kind": kind, "runs": state["runs"] + 1}


WALK = Series(init, step)


def unrolled(steps: int) -> None:
    """The same model as one program, with an address for each step."""
    x, before = pyro.sample("x/0", dist.Normal(number(0.0), 1.0)), 0
    for t in range(1, steps + 1):
        kind = pyro.sample(f"kind/{t}", dist.Categorical(torch.tensor([0.3, 0.7], dtype=torch.float64)))
        x = pyro.sample(f"x/{t}", dist.Normal(x + 0.1 * t * kind, 0.5))
        pyro.sample(f"y/{t}", dist.Normal(x + before, 0.3))
        before = kind


def filtered(series: Series = WALK) -> tuple[Any, list[Tensor]]:
    """A series with ancestors chosen between the steps, and the weight of each step."""
    trace, _ = generate(series, (), {}, N)
    weights = []
    for t in range(1, STEPS):
        trace, weight = extend(trace, (0.1 * t,), {"y": SEEN[t]})
        weights.append(weight)
        index = INDICES[t - 1]
        trace = trace if index is None else trace[index]
    return trace, weights


def paths(trace: Any) -> Trace:
    """The unrolled program at the values that the series' particles came by."""
    last = trace.steps
    values = {"x/0": trace["x", 0]}
    values |= {f"{a}/{t}": trace[a, t] for t in range(1, last + 1) for a in ("x", "kind")}
    observed = {f"y/{t}": SEEN[t] for t in range(1, last + 1)}
    return generate(unrolled, (last,), observed, len(trace))[0].at(values)


def test_a_series_weighs_as_the_program_that_it_unrolls_to() -> None:
    trace, _ = generate(WALK, (), {}, N)
    reference = simulate(unrolled, (0,), N).at({"x/0": trace["x"]})
    for t in range(1, STEPS):
        trace, weight = extend(trace, (0.1 * t,), {"y": SEEN[t]})
        reference, _ = extend(reference, (t,), {f"y/{t}": SEEN[t]})
        reference = reference.at({f"x/{t}": trace["x"], f"kind/{t}": trace["kind"]})
        torch.testing.assert_close(weight, reference.log_prob(f"y/{t}"))
        torch.testing.assert_close(trace.log_prob("kind", "x"), reference.log_prob(f"kind/{t}", f"x/{t}"))
        torch.testing.assert_close(trace.log_prob(), reference.log_prob())
        index = INDICES[t - 1]
        if index is not None:
            trace, reference = trace[index], reference[index]
    assert trace.addresses == ["kind", "x", "y"] and list(trace.observations) == ["y"]
    assert trace.state["runs"] == trace.steps == STEPS - 1


def test_paths_are_traced_back_through_all_choices_of_ancestors() -> None:
    trace, _ = filtered()
    reference = paths(trace)
    torch.testing.assert_close(trace.log_prob(), reference.log_prob())
    for t in range(1, STEPS):
        torch.testing.assert_close(trace.log_prob(("x", t), ("y", t)), reference.log_prob(f"x/{t}", f"y/{t}"))
    # The last choice took the third and the fourth particle: two paths are left, three times each.
    assert len(trace["x", 1].unique()) == 2
    assert torch.equal(trace["x", -1], trace["x"]) and torch.equal(trace["y", 2], SEEN[2])
    # By hand: the indices, composed from the last to the first.
    back = INDICES[2][INDICES[3]]
    assert torch.equal(trace.ancestors(3), back) and torch.equal(trace.ancestors(2), back)
    back = INDICES[0][back]
    assert torch.equal(trace.ancestors(1), back) and torch.equal(trace.ancestors(0), back)


def test_asking_for_the_path_costs_the_same_after_every_step() -> None:
    evaluated = []

    class Seen(dist.Normal):  # type: ignore[misc]
        def log_prob(self, value: Tensor) -> Tensor:
            evaluated.append(len(self.loc))
            return super().log_prob(value)

        def expand(self, batch_shape: Any, _instance: Any = None) -> Any:
            return self

    def seen(x: Tensor) -> Tensor:
        ran.append(1)
        x = pyro.sample("x", dist.Normal(x, 1.0))
        pyro.sample("y", Seen(x, number(1.0)))
        return x

    ran: list[int] = []
    trace, _ = generate(Series(lambda: pyro.sample("x", dist.Normal(number(0.0), 1.0)), seen), (), {}, N)
    for t in range(1, 30):
        trace, _ = extend(trace, (), {"y": number(0.0)})
        trace.log_prob()
        trace = trace[torch.randint(0, N, (N,))]
        assert len(evaluated) == len(ran) == t, "one step is run and evaluated for each extension"


def test_a_proposals_choices_of_the_new_step_are_weighed_with_what_is_seen() -> None:
    trace, _ = filtered()
    before, new = trace["x"], torch.linspace(0, 1, N, dtype=torch.float64)
    kind = trace["kind"]
    longer, weight = extend(trace, (0.0,), {"y": number(0.2)}, {"x": new})
    assert torch.equal(longer["x"], new)
    torch.testing.assert_close(
        weight, normal_log(new, before, 0.5) + normal_log(number(0.2), new + kind, 0.3)
    )


@pytest.mark.parametrize("chosen", [False, True], ids=["as it is", "after choosing ancestors"])
def test_the_newest_step_can_be_moved(chosen: bool) -> None:
    trace, _ = filtered()
    trace, _ = extend(trace, (0.5,), {"y": SEEN[STEPS]})
    trace = trace[torch.tensor([1, 1, 0, 5, 2, 3])] if chosen else trace
    before = trace.log_prob()
    new = {"x": trace["x"] + 0.3, "kind": 1 - trace["kind"]}
    moved = update(trace, new)
    torch.testing.assert_close(moved.log_ratio, moved.trace.log_prob() - before)
    torch.testing.assert_close(moved.log_ratio, paths(moved.trace).log_prob() - paths(trace).log_prob())
    torch.testing.assert_close(moved.trace["x", 2], trace["x", 2])
    drawn = regenerate(trace, ["kind"])
    expected = normal_log(trace["x"], trace["x", STEPS - 1] + 0.5 * drawn.trace["kind"], 0.5)
    expected = expected - normal_log(trace["x"], trace["x", STEPS - 1] + 0.5 * trace["kind"], 0.5)
    torch.testing.assert_close(drawn.log_weight, expected)
    # Some particles moved, all of them with pasts of their own, and the series goes on from there.
    mask = torch.tensor([True, False, True, False, False, True])
    source = torch.tensor([2, 0, 1, 0, 0, 2])
    part = update(trace[torch.tensor([2, 2, 5])], {"x": torch.ones(3, dtype=torch.float64)}).trace
    mixed = part[source].where(mask, trace)
    assert torch.equal(mixed["x"], torch.where(mask, 1.0, trace["x"]))
    torch.testing.assert_close(mixed.log_prob(), paths(mixed).log_prob())
    origin = torch.where(mask, torch.tensor([5, 0, 2, 0, 0, 5]), torch.arange(N))
    assert torch.equal(mixed["x", 1], trace["x", 1][origin])
    torch.testing.assert_close(mixed.state["x"], mixed["x"])
    further, weight = extend(mixed, (0.0,), {"y": number(0.1)})
    torch.testing.assert_close(weight, normal_log(number(0.1), further["x"] + mixed["kind"], 0.3))


def test_without_history_only_the_newest_step_is_kept() -> None:
    torch.manual_seed(0)
    whole, weights = filtered()
    torch.manual_seed(0)
    short, again = filtered(Series(init, step, history=False))
    torch.testing.assert_close(weights, again)
    torch.testing.assert_close(short["x"], whole["x"])
    torch.testing.assert_close(short.log_prob("x", "y"), whole.log_prob("x", "y"))
    moved = update(short, {"x": short["x"] + 1.0})
    torch.testing.assert_close(moved.log_ratio, update(whole, {"x": whole["x"] + 1.0}).log_ratio)
    assert short.stage.before.stage.before is None, "the past is let go"
    for ask in (lambda: short["x", 1], short.log_prob, lambda: short.log_prob(("x", 2))):
        with pytest.raises(InputError, match=r"step \d of a series was asked for, which was not kept"):
            ask()


def test_a_carried_simulator_goes_on_from_step_to_step() -> None:
    started: list[int] = []

    class Counter:
        def __init__(self, owner: Tensor) -> None:
            self.owner = owner

        def __getitem__(self, index: Tensor) -> Counter:
            return Counter(self.owner[index])

        def where(self, mask: Tensor, other: Counter) -> Counter:
            return Counter(torch.where(mask, self.owner, other.owner))

    def begin() -> Tensor:
        return pyro.sample("pose", dist.Normal(number(0.0), 1.0))

    def probe(pose: Tensor) -> Tensor:
        def start() -> Counter:
            started.append(len(pose))
            return Counter(pose)

        assert torch.equal(carried("probe", start).owner, pose)
        pyro.sample("force", dist.Normal(pose, 1.0))
        return pose

    trace, _ = generate(Series(begin, probe), (), {}, N)
    for _ in range(3):
        trace, _ = extend(trace, (), {"force": number(0.0)})
        trace = trace[torch.tensor([5, 5, 1, 0, 2, 2])]
    assert started == [N]


def test_simulating_a_series_and_its_density() -> None:
    trace = simulate(WALK, (), N)
    torch.testing.assert_close(assess(WALK, (), trace.choices, N), normal_log(trace["x"], 0.0, 1.0))
    longer, weight = extend(trace, (0.0,), {})
    assert longer["y"].shape == (N,) and torch.equal(weight, torch.zeros(N, dtype=torch.float64))
    assert longer.since(trace) == ["kind", "x", "y"] and longer.since(longer[:2]) == []
    hidden = longer.hiding(["y"])[torch.tensor([0, 3])]
    with pytest.raises(InputError, match="'y' is hidden"):
        hidden.log_prob("y")
    hidden.log_prob("x")


def state_of(shape: tuple[int, ...]) -> Callable[[], Any]:
    return lambda: {"points": torch.zeros(shape)}


def in_a_plate() -> Tensor:
    with pyro.plate("points", 4):
        return pyro.sample("x", dist.Normal(number(0.0), 1.0))


PLATED = Series(in_a_plate, step)
REFUSED: dict[str, tuple[Callable[[Any], Any], str]] = {
    "never visited": (lambda t: extend(t, (0.0,), {"q": number(0.0)}), "'q'.* never visits"),
    "wrong shape": (lambda t: extend(t, (0.0,), {"y": torch.zeros(2)}), "'y' has shape"),
    "a step to come": (lambda t: t["x", STEPS], f"step {STEPS} of a series .* has run {STEPS - 1}"),
    "no latent": (lambda t: update(t, {("x", 1): t["x"]}), "no latent address"),
    "another past": (
        lambda t: t.where(torch.ones(N, dtype=torch.bool), filtered()[0]),
        "not begin from the same",
    ),
    "state": (lambda _: simulate(Series(state_of((3, N)), step), (), N), r"shape \(3, 6\) for 6 particles"),
    "state in a plate": (lambda _: simulate(PLATED, (), N), r"\(4, 6\) .*`.to_event\(1\)`"),
    "state in a plate of N": (lambda _: simulate(PLATED, (), 4), r"coincidence alone; .*\(4, 5\) .*to_event"),
    "no return": (
        lambda _: extend(simulate(Series(init, lambda x, *args: None), (), N), (0.0,), {}),
        "step returned nothing.* return the next state",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refusals_say_what_to_do(case: str) -> None:
    act, says = REFUSED[case]
    trace, _ = filtered()
    with pytest.raises(InputError, match=says) as caught:
        act(trace)
    assert ". " not in str(caught.value) and "\n" not in str(caught.value)


def test_smc_follows_a_pose_that_moves() -> None:
    """A pose carried along the x axis by the robot and seen each time: the filter keeps up with it."""
    spread = torch.tensor([0.01, 0.01, 0.01, 0.05, 0.05, 0.05], dtype=torch.float64)

    def place(scene: None, actions: list[float]) -> Tensor:
        return pyro.sample("pose", NormalPose(poses.identity(), spread))

    def carry(pose: Tensor, scene: None, actions: list[float]) -> Tensor:
        (moved,) = actions
        ahead = pose + torch.tensor([moved, 0, 0, 0, 0, 0, 0], dtype=torch.float64)
        pose = pyro.sample("pose", NormalPose(ahead, 0.1 * spread))
        pyro.sample("seen", dist.Normal(pose[:, :3], 0.005).to_event(1))
        return pose

    measurements = [
        SimpleNamespace(kind="look", action=0.1, observation=torch.tensor([0.1 * t, 0.0, 0.0]).double())
        for t in range(1, 6)
    ]
    model = Model(
        Series(place, carry),
        prepare=lambda recording: None,
        observe=lambda scene, taken: {"seen": taken[-1].observation},
        pose="pose",
    )
    recording = SimpleNamespace(measurements=measurements, truth=None)
    moved = tempered(metropolis_hastings(drift("pose")))
    for taken, each in enumerate(smc(model, recording, step=moved, particles=300)):
        mean = each.belief.mean[:3]
        assert float((mean - torch.tensor([0.1 * taken, 0.0, 0.0])).abs().max()) < 0.004, taken
    assert len(each.population.trace["pose", 0]) == 300 and each.population.trace.steps == 5


def test_a_series_may_have_no_state() -> None:
    def nothing() -> None:
        pyro.sample("x", dist.Normal(number(0.0), 1.0))

    def again(state: None) -> None:
        pyro.sample("x", dist.Normal(number(0.0), 1.0))

    assert extend(simulate(Series(nothing, again), (), N), (), {})[0].steps == 1
