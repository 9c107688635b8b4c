"""Repeated runs: evidence with an error bar, pooled particles, agreement."""

from __future__ import annotations

import functools
import math
import os
import sys
import threading
from collections.abc import Iterator

import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from bcppl import poses
from bcppl.distributions.poses import UniformPose
from bcppl.errors import InferenceError, InputError, NoWeightError
from bcppl.inference.population import Population
from bcppl.inference.repetitions import Repeated, repeated
from bcppl.inference.summaries import mean
from bcppl.traces import generate


def number(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def program() -> None:
    x = pyro.sample("x", dist.Normal(number(0.0)[0], 1.0))
    pyro.sample("same", dist.Delta(number(2.0)[0]))
    pyro.sample("hole", UniformPose(poses.identity(), (0.02, 0.01, 0.0), 0.5, "z"))
    pyro.sample("y", dist.Normal(x, 0.5))


SEEN = {"y": number(0.7)[0]}
LOCK = threading.Lock()  # no other process can be sent it
LOG_EVIDENCE = -0.5 * math.log(2 * math.pi * 1.25) - 0.5 * 0.49 / 1.25


def importance(seed: int, particles: int = 100) -> Population:
    trace, log_weights = generate(program, (), SEEN, particles)
    return Population(trace, log_weights, float(torch.logsumexp(log_weights, 0)) - math.log(particles))


def of_evidences(*evidences: float) -> Repeated:
    trace, log_weights = generate(program, (), SEEN, 8)
    return Repeated(
        tuple(Population(trace, log_weights, math.log(z)) for z in evidences), tuple(range(len(evidences)))
    )


def test_evidence_and_its_errors_by_hand() -> None:
    runs = of_evidences(1.0, 3.0)
    assert runs.log_evidence == pytest.approx(math.log(2.0))
    # Standard deviation sqrt 2 over sqrt 2 over the mean 2; left out, the logs are log 3 and log 1.
    assert runs.standard_error == pytest.approx(0.5)
    assert runs.jackknife_error == pytest.approx(0.5 * math.log(3.0))
    shifted = of_evidences(1e-300, 3e-300)
    assert shifted.jackknife_error == pytest.approx(runs.jackknife_error)
    assert shifted.standard_error == pytest.approx(0.5)
    alone = of_evidences(2.0)
    assert math.isnan(alone.standard_error) and math.isnan(alone.jackknife_error)
    three = of_evidences(2.0, 2.0, 2.0)
    assert three.standard_error == three.jackknife_error == 0.0


def test_the_mean_evidence_is_unbiased_and_its_error_bar_right() -> None:
    ratios, errors, jackknifes, times = [], [], [], 60
    for seed in range(times):
        runs = repeated(functools.partial(importance, particles=10), 8, seed)
        ratios.append(math.exp(runs.log_evidence - LOG_EVIDENCE))
        errors.append(runs.standard_error)
        jackknifes.append(runs.jackknife_error)
    spread = float(torch.tensor(ratios).log().std())
    assert abs(sum(ratios) / times - 1) < 4 * spread / math.sqrt(times)
    for found in (errors, jackknifes):
        assert math.sqrt(sum(e**2 for e in found) / times) == pytest.approx(spread, rel=0.25)


def test_pooled_runs_weigh_by_their_evidence() -> None:
    few, many = of_evidences(1.0).populations[0], of_evidences(3.0).populations[0]
    few = Population(few.trace.at({"x": torch.zeros(8, dtype=torch.float64)}), few.log_weights, 0.0)
    many = Population(
        many.trace.at({"x": torch.ones(8, dtype=torch.float64)}), many.log_weights + 50.0, math.log(3.0)
    )
    pooled = Repeated((few, many), (0, 1)).pooled
    assert len(pooled) == 16 and pooled.log_evidence == pytest.approx(math.log(2.0))
    assert float(mean(pooled, "x")) == pytest.approx(0.75)
    both = Repeated((few, many), (0, 1))
    assert float(both.mean("x")) == pytest.approx(0.75)
    assert torch.equal(both.mean("hole"), pooled.belief("hole").mean)
    assert pooled.founders.tolist() == list(range(16)), "nobody descends from another run"
    expected = torch.cat([few.trace.log_prob(), many.trace.log_prob()])
    torch.testing.assert_close(pooled.trace.log_prob(), expected)
    assert pooled.trace["hole"].shape == (16, 7) and pooled[torch.arange(3)].trace.particles == 3


def test_agreeing_runs_have_r_hat_1_and_others_do_not() -> None:
    runs = repeated(functools.partial(importance, particles=400), 4, 1)
    ratios = runs.r_hat()
    assert set(ratios) == {"x", "same", "hole"} and ratios["hole"].shape == (3,)
    assert float(ratios["x"]) < 1.02 and float(ratios["hole"].max()) < 1.02
    assert math.isnan(float(ratios["same"]))
    first, *others = runs.populations
    turn = poses.retract(first.trace["hole"], number(0, 0, 0, 0, 0, 1.5))
    apart = Repeated((Population(first.trace.at({"hole": turn}), first.log_weights), *others), runs.seeds)
    ratios = apart.r_hat()
    assert float(ratios["hole"][2]) > 1.3 and float(ratios["hole"][:2].max()) < 1.02
    opposite = first.trace["hole"] * number(1, 1, 1, -1, -1, -1, -1)
    signs = Repeated((Population(first.trace.at({"hole": opposite}), first.log_weights), *others), runs.seeds)
    assert float(signs.r_hat()["hole"].max()) < 1.02, "q and -q are one pose"
    with pytest.raises(InputError, match="compares runs"):
        Repeated((first,), (0,)).r_hat()


def test_the_table_says_all_of_it(monkeypatch: pytest.MonkeyPatch) -> None:
    runs = repeated(importance, 3, 7)
    said = str(runs)
    assert len(said.splitlines()) == 1 + 3 + 1 + 3
    assert f"log of the mean evidence {runs.log_evidence:.4f}" in said and "hole: R-hat at most 1.0" in said
    assert "same: the same in all draws, mean 2" in said and "nan" not in said
    assert all(str(seed) in said for seed in runs.seeds)
    monkeypatch.setitem(sys.modules, "arviz", None)
    assert "R-hat" not in str(runs)


def steps(seed: int) -> Iterator[Population]:
    yield Population(importance(seed).trace, torch.zeros(100, dtype=torch.float64), 99.0)
    yield importance(seed)


def test_runs_hang_on_the_seed_alone_and_the_last_step_counts() -> None:
    before = torch.get_rng_state()
    one, two, other = (repeated(importance, 3, seed) for seed in (0, 0, 1))
    assert torch.equal(before, torch.get_rng_state())
    assert one.seeds == two.seeds and not set(one.seeds) & set(other.seeds)
    assert torch.equal(one.log_evidences, two.log_evidences)
    assert len(set(one.log_evidences.tolist())) == 3
    assert float(repeated(steps, 2).log_evidences.max()) < 1.0
    for run, times, jobs, said in (
        (lambda seed: 3.0, 1, 1, "a float was given in place of a population"),
        (importance, 0, 1, "0 runs were asked for"),
        (lambda seed, lock=LOCK: importance(seed), 2, 2, "cannot be sent to another process"),
    ):
        with pytest.raises(InputError, match=said):
            repeated(run, times, jobs=jobs)


def distributed(seed: int) -> Population:
    return importance(seed, 20)


@pytest.mark.long
def test_processes_change_nothing() -> None:
    one, two = repeated(distributed, 3, 4), repeated(distributed, 3, 4, jobs=2)
    assert torch.equal(one.log_evidences, two.log_evidences)
    for mine, other in zip(one.populations, two.populations, strict=True):
        assert torch.equal(mine.trace["x"], other.trace["x"])
        assert torch.equal(mine.trace.log_prob(), other.trace.log_prob())
    assert float(mean(one.pooled, "x")) == float(mean(two.pooled, "x"))
    own = repeated(lambda seed: importance(seed, 20), 3, 4, jobs=2)
    assert torch.equal(one.log_evidences, own.log_evidences)


@pytest.mark.long
def test_a_process_that_ends_is_named() -> None:
    here = os.getpid()

    def ends(seed: int) -> Population:
        if os.getpid() != here:
            os._exit(3)
        return importance(seed)

    with pytest.raises(InferenceError, match=r"run 2 \(seed \d+\): its process"):
        repeated(ends, 2, jobs=2)


def test_a_dead_run_counts_as_no_evidence_and_is_named() -> None:
    alive = [importance(seed, 40) for seed in (1, 2)]
    dead = Population(alive[0].trace, torch.full((40,), -torch.inf))
    runs = Repeated((alive[0], dead, alive[1]), (1, 2, 3))
    assert runs.dead == (2,)
    assert "in run 2 no particle has any weight left" in str(runs)
    both = Repeated(tuple(alive), (1, 3))
    assert runs.log_evidence == pytest.approx(both.log_evidence + math.log(2 / 3))
    torch.testing.assert_close(runs.mean("x"), both.mean("x"))
    assert math.isfinite(runs.standard_error) and math.isfinite(runs.jackknife_error)
    assert runs.pooled.effective_sample_size == pytest.approx(both.pooled.effective_sample_size)


def test_runs_that_all_died_say_so() -> None:
    dead = Population(importance(1, 5).trace, torch.full((5,), -torch.inf))
    runs = Repeated((dead, dead), (1, 2))
    assert "in runs 1, 2 no particle" in str(runs) and runs.log_evidence == -math.inf
    for ask in (lambda: runs.mean("x"), lambda: runs.r_hat(), lambda: runs.pooled):
        with pytest.raises(NoWeightError, match="in any of 2 runs"):
            ask()


def test_a_run_that_cannot_go_on_is_named() -> None:
    def run(seed: int) -> Population:
        return importance(1, 5).reweighed(torch.full((5,), -torch.inf, dtype=torch.float64))

    with pytest.raises(NoWeightError, match=r"run 1 \(seed \d+\): no particle has any weight left"):
        repeated(run, 2, progress=False)
