"""Watching a run: collectors and bars leave it as it was; and runs that are stopped and gone on with."""

from __future__ import annotations

import io
import math
from collections.abc import Iterator
from dataclasses import replace
from importlib.resources import files

import pyro
import pyro.distributions as dist
import pytest
import torch
from rich.console import Console
from torch import Tensor

from bcppl.errors import InputError
from bcppl.inference import progress
from bcppl.inference.collectors import (
    acceptance,
    collect,
    distinct,
    effective_sample_size,
    log_evidence,
    mean,
)
from bcppl.inference.filters import tempered_smc
from bcppl.inference.filters.smc import Step, smc
from bcppl.inference.filters.step import Observed, Stepped, steps
from bcppl.inference.filters.tempering import tempered
from bcppl.inference.importance import importance_sampling
from bcppl.inference.kernels import metropolis_hastings
from bcppl.inference.proposals import drift
from bcppl.inference.repetitions import repeated
from bcppl.inference.resampling import always
from bcppl.models.point_probe import model
from bcppl.recordings import Recording, load

SEEN = [torch.tensor(v, dtype=torch.float64) for v in (0.8, -0.3, 1.9)]


def static(count: int) -> None:
    x = pyro.sample("x", dist.Normal(torch.zeros(2, dtype=torch.float64), 1.0).to_event(1))
    for k in range(count):
        pyro.sample(f"y_{k}", dist.Normal(x[:, 0], 0.6))


def a_run(seed: int = 3) -> Iterator[Stepped]:
    torch.manual_seed(seed)
    start = importance_sampling(static, (0,), {}, 50)
    step = tempered(metropolis_hastings(drift("x")), resample=always(), share=0.7)
    return steps(step, start, [Observed((k + 1,), {f"y_{k}": y}) for k, y in enumerate(SEEN)])


def test_a_collector_changes_nothing_and_hands_everything_on() -> None:
    plain = list(a_run())

    def drawing(step: Stepped) -> Tensor:
        return torch.rand(3)

    watched = collect(
        a_run(),
        size=effective_sample_size,
        evidence=log_evidence,
        accepted=acceptance,
        different=distinct,
        x=mean("x"),
        drawn=drawing,
        label=lambda step: "word",
    )
    seen = [next(watched)]
    assert watched["size"].shape == (1,), "what went by so far"
    seen += list(watched)
    for (first, info), (second, again) in zip(plain, seen, strict=True):
        assert torch.equal(first.trace["x"], second.trace["x"])
        assert first.log_evidence == second.log_evidence and info.acceptance == again.acceptance
    columns = watched.columns
    assert columns["evidence"].tolist() == [p.log_evidence for p, _ in plain]
    assert columns["accepted"].tolist() == [i.acceptance for _, i in plain]
    assert columns["x"].shape == (3, 2) and columns["drawn"].shape == (3, 3)
    weights = torch.softmax(plain[1].population.log_weights, 0)
    torch.testing.assert_close(columns["x"][1], weights @ plain[1].population.trace["x"])
    assert columns["label"] == ["word"] * 3
    assert int(columns["different"][-1]) == len(torch.unique(plain[-1].population.trace["x"], dim=0))
    with pytest.raises(InputError, match=r"nothing was collected as 'ess'; there are size"):
        watched["ess"]


def test_a_step_says_what_happened() -> None:
    before = None
    for population, info in a_run():
        assert info.ancestors is not None and len(info.ancestors) == 50
        assert info.resampled == len(info.exponents) > 1 and info.exponents[-1] == 1.0
        assert info.effective_sample_size == pytest.approx(50) and info.effective_sample_size_before < 50
        if before is not None:
            assert population.log_evidence - before.log_evidence == pytest.approx(info.log_evidence)
            assert torch.equal(population.founders, before.founders[info.ancestors])
        before = population
    still = tempered(resample=lambda p: (p, None), share=0.0)
    start = importance_sampling(static, (0,), {}, 20)
    done, info = still(start, Observed((1,), {"y_0": SEEN[0]}))
    assert info.ancestors is None and info.resampled == 0 and math.isnan(info.acceptance)
    assert info.effective_sample_size == info.effective_sample_size_before == done.effective_sample_size


@pytest.fixture(scope="module")
def recording() -> Recording:
    whole = load(files("bcppl.models") / "recordings/point_probe_10_pushes.h5")  # type: ignore[arg-type]
    return replace(whole, measurements=whole.measurements[:3])


def test_a_run_goes_on_from_a_saved_step(recording: Recording) -> None:
    """From its population and its random state, nothing else of the run being left."""
    step = tempered(tempered_smc.kernel(model.pose), share=0.0)
    run = list(smc(model, recording, step=step, particles=10, seed=3))
    for taken in (0, 2):
        kept = run[taken]
        assert kept.taken == taken
        saved = Step(kept.belief, kept.info, kept.population, kept.random_state.clone(), kept.taken)
        torch.manual_seed(taken)
        rest = list(smc(model, recording, step=step, seed=3, start=saved))
        assert [s.taken for s in rest] == list(range(taken + 1, 4))
        for first, second in zip(run[taken + 1 :], rest, strict=True):
            assert torch.equal(first.belief.world_from_part, second.belief.world_from_part)
            assert torch.equal(first.random_state, second.random_state)
            assert first.info.log_evidence == second.info.log_evidence
            assert first.info.truth_gap == second.info.truth_gap
    belief, info = run[1]
    assert belief is run[1].belief and info is run[1].info
    short = replace(recording, measurements=recording.measurements[:1])
    with pytest.raises(InputError, match="after 2 measurements, but the recording has 1"):
        list(smc(model, short, step=step, start=run[2]))


def shown(monkeypatch: pytest.MonkeyPatch, terminal: bool) -> io.StringIO:
    written = io.StringIO()
    console = Console(file=written, force_terminal=terminal, width=80)
    monkeypatch.setattr(progress, "get_console", lambda: console)
    return written


def test_bars_are_for_terminals_and_only_one_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    quiet = shown(monkeypatch, False)
    assert list(progress.watched(range(4), description="moves")) == [0, 1, 2, 3]
    assert quiet.getvalue() == ""
    seen = shown(monkeypatch, True)
    for _ in progress.watched(["a", "b"], describe=lambda item: f"item {item}"):
        assert list(progress.watched(range(3), description="inner")) == [0, 1, 2]
    assert "item b" in seen.getvalue() and "inner" not in seen.getvalue()
    off = shown(monkeypatch, True)
    assert list(progress.watched(range(2), progress=False)) == [0, 1] and off.getvalue() == ""
    bar = shown(monkeypatch, True)
    torch.manual_seed(3)
    start = importance_sampling(static, (0,), {}, 20)
    observed = [Observed((1,), {"y_0": SEEN[0]})]
    assert len(list(steps(tempered(), start, observed, progress=True))) == 1
    assert "steps" in bar.getvalue() and "1/1" in bar.getvalue()
    repeated(lambda seed: start, 3)
    assert "runs" in bar.getvalue() and "3/3" in bar.getvalue()
    none = shown(monkeypatch, True)
    list(steps(tempered(), start, observed))
    repeated(lambda seed: start, 3, progress=False)
    assert none.getvalue() == ""
    # A run that is left half way takes its bar along.
    left = progress.watched(range(3))
    next(left)
    left.close()
    assert not progress._shown
