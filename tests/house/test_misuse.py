"""What a newcomer hands to the wrong place is refused in one sentence that states what to do."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from bcppl.errors import InputError
from bcppl.inference import collectors
from bcppl.inference.arviz import to_arviz
from bcppl.inference.calibration import Joint, calibrate
from bcppl.inference.chains import markov_chains
from bcppl.inference.filters.step import Observed, steps
from bcppl.inference.filters.tempering import tempered
from bcppl.inference.filters.waste_free import waste_free_moves
from bcppl.inference.importance import importance_sampling, tempered_importance_sampling
from bcppl.inference.kernels import (
    cycle,
    hmc,
    metropolis_hastings,
    mixture,
    moved_by,
    repeat,
    sequence,
)
from bcppl.inference.population import Population
from bcppl.inference.proposals import drift
from bcppl.inference.saved import load, save
from bcppl.inference.sizing import merge, replicate, resize
from bcppl.inference.structures import Jump, Strata, generate_strata, jump, save_strata
from bcppl.inference.summaries import mean
from bcppl.inference.targets import POSTERIOR
from bcppl.inference.verbs import rejuvenate, resample, update
from bcppl.sweeps import swept
from bcppl.traces import Trace, check_program, extend, generate, structural


def number(value: float) -> Tensor:
    return torch.tensor(value, dtype=torch.float64)


def program(count: int) -> None:
    mu = pyro.sample("mu", dist.Normal(number(0.0), 1.0))
    for k in range(count):
        pyro.sample(f"y_{k}", dist.Normal(mu, 0.5))


def start() -> Population:
    return importance_sampling(program, (0,), {}, 20)


def nudge(trace: Trace) -> None:
    pyro.sample("mu", dist.Normal(trace["mu"], 0.2))


def bold(trace: Trace) -> None:
    pyro.sample("mu", dist.Normal(trace["mu"], trace.distributions["mu"].scale))


def learning(population: Population) -> Callable[[Trace], None]:
    return nudge


def steadily(trace: Trace, size: float) -> None:
    pyro.sample("mu", dist.Normal(trace["mu"], size))


def switched() -> None:
    pyro.sample("x", dist.Normal(number(float(structural("on", dist.Bernoulli(number(0.5))))), 1.0))


def strata() -> Strata:
    return generate_strata(switched, (), {}, 10)


walk = metropolis_hastings(nudge)
SEEN = Observed((1,), {"y_0": number(0.4)})
WRAP = r"wrap a proposal in metropolis_hastings"
anything: Any = None

MISUSES: dict[str, tuple[Callable[[], Any], str]] = {
    "chains of a shipped proposal": (lambda: markov_chains(drift("mu"), start(), 2), WRAP),  # type: ignore[arg-type]
    "chains of a program": (lambda: markov_chains(nudge, start(), 2), rf"nudge gives no move.* {WRAP}"),  # type: ignore[arg-type]
    "chains of a program that reads more": (lambda: markov_chains(bold, start(), 2), rf"bold .* {WRAP}"),  # type: ignore[arg-type]
    "chains of a name": (lambda: markov_chains("mu", start(), 2), "given a str in place of a kernel"),  # type: ignore[arg-type]
    "chains of a program that learns": (lambda: markov_chains(steadily, start(), 2), rf"steadily.* {WRAP}"),  # type: ignore[arg-type]
    "sequence": (lambda: sequence(drift("mu")), rf"sequence is given a proposal.* {WRAP}"),  # type: ignore[arg-type]
    "cycle": (lambda: cycle([walk, drift("mu")]), rf"cycle is given a proposal.* {WRAP}"),  # type: ignore[list-item]
    "mixture": (lambda: mixture(walk, drift("mu")), rf"mixture is given a proposal.* {WRAP}"),
    "repeat": (lambda: repeat(drift("mu"), 2), rf"repeat is given a proposal.* {WRAP}"),  # type: ignore[arg-type]
    "tempered": (lambda: tempered(drift("mu")), rf"tempered is given a proposal.* {WRAP}"),  # type: ignore[arg-type]
    "rejuvenate": (lambda: moved_by(start(), drift("mu"), POSTERIOR), WRAP),  # type: ignore[arg-type]
    "waste free": (lambda: waste_free_moves(drift("mu"), 5), WRAP),  # type: ignore[arg-type]
    "a proposal that learns": (
        lambda: markov_chains(metropolis_hastings(learning), start(), 2),
        r"returns a function .* wrap it in Fittable",
    ),
    "a kernel twice": (
        lambda: markov_chains(metropolis_hastings(metropolis_hastings(nudge)), start(), 2),
        "if it is a kernel, use it as it is",
    ),
    "half a time": (lambda: repeat(walk, 3.0), "give a whole number"),  # type: ignore[arg-type]
    "a kernel as a step": (lambda: steps(walk, start(), [SEEN]), r"if it is a kernel, give tempered"),  # type: ignore[arg-type]
    "a tuple as a population": (
        lambda: steps(tempered(), generate(program, (0,), {}, 5), [SEEN]),  # type: ignore[arg-type]
        r"given a tuple .* Population\(\*\.\.\.\)",
    ),
    "one Observed": (lambda: steps(tempered(), start(), SEEN), "give a list of them"),  # type: ignore[arg-type]
    "a column of nothing": (
        lambda: list(collectors.collect(steps(tempered(), start(), [SEEN]), x=collectors.mean("nope"))),
        "'nope' was asked for, which is no latent address; latent are mu",
    ),
    "a belief over nothing": (lambda: start().belief("nope"), "'nope' .* no latent address; latent are mu"),
    "a belief over a number": (lambda: start().belief("mu"), r"'mu' .* no pose.* bcppl.inference.summaries"),
    "a value of nothing": (lambda: start()["nope"], "no value at address 'nope'; it has mu"),
    "a number for ArviZ": (lambda: to_arviz(3), "a int was given"),
    "names for ArviZ": (lambda: to_arviz(["mu"]), "a str was given in place of a population"),
    "arguments and observations exchanged": (
        lambda: generate(program, {"y_0": 0.4}, (0,), 5),  # type: ignore[arg-type]
        "values by address are given as a tuple; give a mapping",
    ),
    "a sample of exchanged ones": (
        lambda: importance_sampling(program, {"y_0": 0.4}, (0,), 5),  # type: ignore[arg-type]
        "values by address are given as a tuple; give a mapping",
    ),
    "a trace to update": (
        lambda: update(start().trace, SEEN),  # type: ignore[arg-type]
        r"update is given a Trace .* Population\(trace, log_weights\), or use a verb of bcppl.traces",
    ),
    "a population for the verbs of traces": (
        lambda: extend(start(), (1,), {"y_0": 0.4}),  # type: ignore[arg-type]
        r"extend is given a Population in place of a trace; give its `.trace`, or .* bcppl.inference.update",
    ),
    "a trace to enlarge": (lambda: resize(start().trace, 30), "resize is given a Trace"),  # type: ignore[arg-type]
    "a trace to copy": (lambda: replicate(start().trace, 2), "replicate is given a Trace"),  # type: ignore[arg-type]
    "a trace to merge": (lambda: merge(start().trace), "merge is given a Trace"),  # type: ignore[arg-type]
    "ancestors that are not there": (lambda: start().selected(torch.tensor([25])), "from 0 to 19"),
    "ancestors that are no numbers": (lambda: start().selected(torch.tensor([0.5])), "from 0 to 19"),
    "no job": (lambda: swept(abs, [1], jobs=0), "0 jobs at a time .* 1 or more, or -1"),
    "a number to run": (lambda: generate(3, (), {}, 4), "a program is a function, and int is given"),  # type: ignore[arg-type]
    "a trace to resample": (lambda: resample(start().trace), "resample is given a Trace"),  # type: ignore[arg-type]
    "a trace to move": (lambda: rejuvenate(start().trace, walk), "rejuvenate is given a Trace"),  # type: ignore[arg-type]
    "a name as a proposal": (
        lambda: markov_chains(metropolis_hastings("mu"), start(), 2),  # type: ignore[arg-type]
        r"'mu' is given in place of a proposal; .* drift\('x'\)",
    ),
    "a kernel to temper by": (
        lambda: tempered_importance_sampling(program, (0,), {}, 5, walk),  # type: ignore[arg-type]
        r"in place of a step that tempers; give tempered\(kernel\)",
    ),
    "tempered itself": (
        lambda: tempered_importance_sampling(program, (0,), {}, 5, tempered),  # type: ignore[arg-type]
        "tempered is given in place of a step that tempers",
    ),
    "a trace to save": (lambda: save(start().trace, "p.h5"), "save is given a Trace"),  # type: ignore[arg-type]
    "a path to save": (lambda: save("p.h5", start()), "save is given a str"),  # type: ignore[arg-type]
    "strata to save": (lambda: save(strata(), "p.h5"), "save them by `save_strata`"),  # type: ignore[arg-type]
    "a population as strata": (lambda: save_strata(start(), "p.h5"), "a population to `save`"),  # type: ignore[arg-type]
    "a program to load from": (lambda: load(program, "p.h5"), "there is no file <function"),  # type: ignore[arg-type]
    "a jump to a number": (
        lambda: jump(Jump(lambda s: s["on"] + 1, lambda s: None))(strata(), POSTERIOR),  # type: ignore[arg-type, return-value]
        r"leads from Structure\(on=0\) to 1; .* by address",
    ),
    "an inference to calibrate first": (
        lambda: calibrate(lambda data: start(), Joint(program, (1,), ("y_0",)), 5),  # type: ignore[arg-type]
        r"calibrate is given a function .* Joint\(program, args, observed\) .* first",
    ),
    "a joint of nothing": (lambda: Joint(program, (1,), ("typo",)), "'typo' is one the program never visits"),
    "a check of several structures": (lambda: check_program(switched), r"check_program\(..., \{'on': 1\}\)"),
    "a step of what is no series": (lambda: mean(start(), ("mu", 1)), "the program is no Series"),
}


@pytest.mark.parametrize("misuse", MISUSES)
def test_it_is_refused_in_one_sentence(misuse: str) -> None:
    call, message = MISUSES[misuse]
    with pytest.raises(InputError, match=message) as caught:
        call()
    assert "\n" not in str(caught.value)


def test_an_error_of_the_kernel_itself_is_left_alone() -> None:
    def broken(population: Population) -> Any:
        return number(0.0).nothing  # type: ignore[attr-defined]

    with pytest.raises(AttributeError, match="nothing"):
        markov_chains(broken, start(), 2)


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (mixture([walk, walk], weights=[0.3, 0.7]), mixture(walk, walk, weights=[0.3, 0.7])),
        (sequence([walk, walk]), sequence(walk, walk)),
        (cycle([walk, walk]), cycle(walk, walk)),
        (hmc(["mu"]), hmc("mu")),
    ],
    ids=["mixture", "sequence", "cycle", "hmc"],
)
def test_a_list_gives_the_same_as_one_by_one(one: Any, other: Any) -> None:
    found = []
    for kernel in (one, other):
        torch.manual_seed(1)
        found.append(markov_chains(kernel, start(), 5, addresses="mu").draws["mu"])
    assert torch.equal(*found) and bool((found[0][0] != found[0][-1]).any())


def test_a_population_is_told_in_a_line_and_read_by_address() -> None:
    (population, _) = next(steps(tempered(walk), start(), [SEEN]))
    assert torch.equal(population["mu"], population.trace["mu"]) and float(population["y_0"]) == 0.4
    shown = repr(population)
    assert shown.startswith("Population(20 particles, effective sample size ") and "tensor" not in shown
    assert shown.endswith("latent: mu, observed: y_0)") and f"{population.log_evidence:.4f}" in shown
    dead = Population(population.trace, torch.full((20,), -torch.inf, dtype=torch.float64))
    assert "effective sample size none" in repr(dead)


def test_a_population_of_copies_says_so() -> None:
    (population, _) = next(steps(tempered(walk), start(), [SEEN]))
    apart = population.with_trace(population.trace.at({"mu": torch.arange(20).double()}))
    assert apart.distinct == 20 and "distinct" not in repr(apart)
    copies = apart.selected(torch.zeros(20, dtype=torch.int64))
    assert repr(copies).startswith("Population(20 particles, 1 distinct, effective sample size 20.0, ")
    two = apart.selected(torch.tensor([3] * 5 + [7] * 15))
    assert repr(two).startswith("Population(20 particles, 2 distinct, effective sample size 20.0, ")
    dead = Population(two.trace, torch.full((20,), -torch.inf, dtype=torch.float64))
    assert "0 distinct, effective sample size none" in repr(dead)
