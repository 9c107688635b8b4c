"""Repeated independent runs: their agreement, their pooled posterior, and the error of their evidence.

    import pyro
    import pyro.distributions as dist
    import torch
    from bcppl.inference import importance_sampling, repeated

    def weighed():
        mass = pyro.sample("mass", dist.Normal(torch.tensor(2.0).double(), 0.5))
        pyro.sample("reading", dist.Normal(mass, 0.3))

    runs = repeated(lambda seed: importance_sampling(weighed, (), {"reading": 2.4}, 1000), times=4)
    print(runs)

It prints the pooled evidence with its error, and how far the runs agree at each address.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from bcppl import poses
from bcppl.arguments import seed_number, whole_number
from bcppl.beliefs import Belief, normalised
from bcppl.cached import cached_property
from bcppl.errors import InferenceError, InputError, NoWeightError
from bcppl.inference.arviz import at_draws, check_alike, draw, import_arviz, population_of
from bcppl.inference.population import Population
from bcppl.inference.progress import watched
from bcppl.inference.resampling import seeded
from bcppl.inference.summaries import is_angle, is_pose, mean
from bcppl.sweeps import in_order
from bcppl.traces import Trace
from bcppl.traces.concatenation import concatenated

Run = Callable[[int], Any]


def repeated(run: Run, times: int, seed: int = 0, *, jobs: int = 1, progress: bool = True) -> Repeated:
    """Run the same inference several times, independently.

    Args:
        run: `run(seed)`: gives a population, something that has one (a `Step` of SMC), or an iterator over
            those, of which the last counts. Torch's generator is set to the seed before each call.
        times: how many runs.
        seed: the runs' own seeds are derived from it; torch's own generator is left as it was.
        jobs: how many at a time: above 1 in processes (`bcppl.sweeps`), but for the first, which is here.
            Runs of other processes come without `approximation`.
        progress: show a bar, on a terminal or in a notebook.

    Raises:
        InputError: `times`, `jobs` or the seed is out of range, `run` gives no population, it cannot be
            sent to another process, or the runs differ in addresses or observations.
        InferenceError: a run fails, or its process ends; names it and its seed.
    """
    times = whole_number("{} runs were asked for", times)
    jobs = min(whole_number("{} runs at a time were asked for", jobs), times)
    seeds = [int(s) for s in np.random.SeedSequence(seed_number(seed)).generate_state(times)]
    if jobs == 1:
        numbered = watched(list(enumerate(seeds, 1)), description="runs", progress=progress)
        populations = [_population(run, each, number) for number, each in numbered]
    else:
        populations = _distributed(run, seeds, jobs, progress)
    check_alike(populations)
    return Repeated(tuple(populations), tuple(seeds))


@dataclass(frozen=True, eq=False)
class Repeated:
    """Independent runs of one inference; print it for a table.

    A run in which no particle has any weight left estimates the evidence by 0, and counts as that, for the
    mean is biased without it. Means, R-hat and the pooled posterior are those of the other runs; they raise
    NoWeightError where all are dead.

    Attributes:
        populations: one for each run.
        seeds: of the runs.
    """

    populations: tuple[Population, ...]
    seeds: tuple[int, ...]

    def __len__(self) -> int:
        return len(self.populations)

    @cached_property
    def dead(self) -> tuple[int, ...]:
        """The numbers, from 1, of the runs in which no particle has any weight."""
        weightless = (not bool((p.log_weights > -torch.inf).any()) for p in self.populations)
        return tuple(number for number, none in enumerate(weightless, start=1) if none)

    @cached_property
    def _alive(self) -> tuple[Population, ...]:
        alive = [p for number, p in enumerate(self.populations, start=1) if number not in self.dead]
        if not alive:
            raise NoWeightError(
                f"no particle has any weight in any of {len(self)} runs: no particle explains the "
                "observations; widen the prior, or use more particles."
            )
        return tuple(alive)

    @cached_property
    def log_evidences(self) -> Tensor:
        """Log of each run's estimate of the evidence (R,), -inf of a dead one."""
        each = torch.tensor([p.log_evidence for p in self.populations], dtype=torch.float64)
        each[[number - 1 for number in self.dead]] = -torch.inf
        return each

    @property
    def log_evidence(self) -> float:
        """Log of the mean of the runs' estimates: the mean is unbiased where each estimate is."""
        return float(torch.logsumexp(self.log_evidences, 0)) - math.log(len(self))

    @property
    def standard_error(self) -> float:
        """Standard error of `log_evidence` by the delta method, error over mean; NaN of one run.

        It is too small where few runs dominate the mean: others like them are then likely to be missing.
        """
        if len(self) < 2:
            return math.nan
        share = torch.exp(self.log_evidences - self.log_evidence)
        return float(share.std() / math.sqrt(len(self)))

    @property
    def jackknife_error(self) -> float:
        """Standard error of `log_evidence` by leaving out one run at a time; NaN of one run alive.

        Efron and Stein, The jackknife estimate of variance, Annals of Statistics 9, 1981, eq. 1.3.
        """
        count = len(self)
        if count - len(self.dead) < 2:
            return math.nan
        others = self.log_evidences.expand(count, count).clone()
        others.fill_diagonal_(-torch.inf)
        without = torch.logsumexp(others, 1) - math.log(count - 1)
        return float(without.std(correction=0) * math.sqrt(count - 1))

    @cached_property
    def log_weights(self) -> Tensor:
        """Log weights of all particles of all runs, one run after another, each run with its evidence."""
        return torch.cat([_of_run(p, z) for p, z in zip(self.populations, self.log_evidences, strict=True)])

    def belief(self, address: str) -> Belief:
        """All particles of all runs read as a posterior over the pose at an address.

        Raises:
            InputError: no latent site has that address, or no pose is there.
        """
        first = self._alive[0].belief(address)
        each = torch.cat([p.trace.choices[address] for p in self.populations])
        seen = [p.apparent_pose(address) for p in self.populations]
        known = [one for one in seen if one is not None]

        def apparent(world_from_peg: Tensor, draws: int) -> Tensor:
            return torch.cat([one(world_from_peg, draws) for one in known])

        of_all = apparent if len(known) == len(seen) else None
        return Belief(each, self.log_weights, first.freedom, of_all)

    def mean(self, address: str) -> Tensor:
        """The weighted mean (*event) over all runs at a latent address, of poses the mean pose (7,).

        Raises:
            InputError: no latent site has that address.
        """
        alive = self._alive
        if is_pose(alive[0], address):
            return self.belief(address).mean
        if is_angle(alive[0], address):
            return mean(self.pooled, address)
        share = torch.softmax(self.log_evidences[self.log_evidences > -torch.inf], 0)
        return torch.einsum("r,r...->...", share, torch.stack([mean(p, address) for p in alive]))

    @cached_property
    def pooled(self) -> Population:
        """All particles of all runs, each run with the weight of its evidence.

        The error of its evidence is `standard_error`: `evidence_variance` does not apply to it.

        Raises:
            InputError: the runs are of a long series, whose traces depend on the steps before.
            NoWeightError: no particle has any weight in any run.
        """
        _refuse_series(self.populations[0])
        _ = self._alive
        # Simulators' states are left: pooled particles are read, and seldom moved.
        trace = concatenated([replace(p.trace, carried={}) for p in self.populations])
        before = np.cumsum([0, *(int(p.founders.max()) + 1 for p in self.populations)])
        founders = [p.founders + int(b) for p, b in zip(self.populations, before, strict=False)]
        return Population(trace, self.log_weights, self.log_evidence, torch.cat(founders), math.inf)

    def r_hat(self, draws: int | None = None, seed: int = 0) -> dict[str, Tensor]:
        """Rank-normalised split R-hat (D,) of every latent address: near 1 where the runs agree.

        Vehtari et al., Rank-normalization, folding, and localization: an improved R-hat, Bayesian Analysis
        16, 2021, as ArviZ computes it, of equal-weight draws. D is the free axes of a pose, in the tangent
        space at the pooled mean, and elsewhere the numbers of a value in reading order. NaN where no value
        differs.

        Args:
            draws: of each run; by default as many as it has particles.
            seed: of the draws.

        Raises:
            InputError: ArviZ is not installed, or there are fewer than two runs alive, or fewer than four
                draws.
        """
        arviz, alive = import_arviz(), self._alive
        if len(alive) < 2:
            alone = f" alive of {len(self)}" if self.dead else ""
            raise InputError(f"R-hat compares runs, but there is one{alone}; repeat it 2 times or more.")
        with seeded(seed):
            chosen = draw(alive, draws)
        if len(chosen[0]) < 4:
            raise InputError(f"R-hat of {len(chosen[0])} draws was asked for; give 4 or more.")
        ratios = {}
        for address in alive[0].trace.choices:
            values = at_draws([p.trace.choices[address] for p in alive], chosen)
            if is_pose(alive[0], address):
                belief = self.belief(address)
                values = belief.freedom.coordinates(poses.local(belief.mean, values))
            numbers = values.to(torch.float64).reshape(*values.shape[:2], -1).numpy()
            with np.errstate(invalid="ignore"):
                each = [float(arviz.rhat(numbers[..., k])) for k in range(numbers.shape[-1])]
            ratios[address] = torch.tensor(each, dtype=torch.float64)
        return ratios

    def __str__(self) -> str:
        """The runs, one to a line, their evidence together, and where ArviZ is installed their R-hat."""
        shares = torch.exp(self.log_evidences - self.log_evidence).div(len(self)).tolist()
        lines = [f"{'run':>4} {'seed':>11} {'log evidence':>14} {'particles':>10} {'ESS':>8} {'share':>7}"]
        for number, (population, seed, share) in enumerate(
            zip(self.populations, self.seeds, shares, strict=True), start=1
        ):
            size = "dead" if number in self.dead else f"{population.effective_sample_size:.1f}"
            lines.append(
                f"{number:>4} {seed:>11} {float(self.log_evidences[number - 1]):>14.4f} "
                f"{len(population):>10} {size:>8} {share:>7.3f}"
            )
        lines.append(
            f"log of the mean evidence {self.log_evidence:.4f}, standard error "
            f"{self.standard_error:.4f} (jackknife {self.jackknife_error:.4f})"
        )
        if self.dead:
            which = f"run{'s' * (len(self.dead) > 1)} {', '.join(map(str, self.dead))}"
            lines.append(
                f"in {which} no particle has any weight left: evidence 0, left out of the posterior; "
                "use more particles, or a wider prior."
            )
        return "\n".join([*lines, *self._agreement()])

    def _agreement(self) -> list[str]:
        try:
            ratios = self.r_hat()
        except (InputError, InferenceError):
            return []
        lines = []
        for address, ratio in ratios.items():
            numbers = " ".join(f"{value:.5g}" for value in self.mean(address).flatten().tolist()[:8])
            finite = ratio[~ratio.isnan()].tolist()
            agreed = f"R-hat at most {max(finite):.3f}" if finite else "the same in all draws"
            lines.append(f"{address}: {agreed}, mean {numbers}")
        return lines


def _of_run(population: Population, log_evidence: Tensor) -> Tensor:
    """Log weights (N,) of a run's particles that sum to its evidence; -inf of one that is dead."""
    if log_evidence == -torch.inf:
        return torch.full_like(population.log_weights, -torch.inf)
    return normalised(population.log_weights).log() + log_evidence


def _population(run: Run, seed: int, number: int) -> Population:
    try:
        with seeded(seed):
            return population_of(run(seed), "runs that return one, a step of SMC, or an iterator over those")
    except InferenceError as error:
        raise type(error)(f"run {number} (seed {seed}): {error}") from error


def _distributed(run: Run, seeds: Sequence[int], jobs: int, progress: bool) -> list[Population]:
    """The runs in several processes, the first in this one.

    A program and its simulators stay in their process: another process sends numbers only, which are put
    into the trace of the run of this process.
    """
    numbered = list(enumerate(seeds, 1))
    others = in_order(partial(_numbers, run), numbered[1:], jobs)
    populations: list[Population] = []
    for number, seed in watched(numbered, description="runs", progress=progress):
        if not populations:
            populations.append(_population(run, seed, number))
            _refuse_series(populations[0])
            continue
        try:
            populations.append(_put_into(populations[0], *next(others)))
        except BrokenProcessPool as error:
            what = f"run {number} (seed {seed}): its process, or one beside it, has ended ({error})"
            raise InferenceError(what) from error
    return populations


Numbers = dict[str, Any]


def _numbers(run: Run, numbered: tuple[int, int]) -> tuple[Numbers, Numbers]:
    """A run's population as arrays: the trace's values, and its other fields."""
    number, seed = numbered
    population = _population(run, seed, number)
    trace = population.trace
    values = {"choices": trace.choices, "observations": trace.observations, "known": trace.known}
    # What an approximation is given of the program stays in its process, too.
    others = [f.name for f in fields(population) if f.name not in ("trace", "approximation")]
    rest = {name: getattr(population, name) for name in others}
    return (
        {name: {a: v.numpy() for a, v in part.items()} for name, part in values.items()},
        {name: v.numpy() if isinstance(v, Tensor) else v for name, v in rest.items()},
    )


def _refuse_series(population: Population) -> None:
    if type(population.trace) is not Trace:
        raise InputError(
            "runs of a long series cannot be pooled or distributed over processes; "
            "run them here and read each by itself."
        )


def _put_into(first: Population, values: Numbers, rest: Numbers) -> Population:
    back: Numbers = {name: {a: torch.as_tensor(v) for a, v in part.items()} for name, part in values.items()}
    other: Numbers = {
        name: torch.as_tensor(v) if isinstance(v, np.ndarray) else v for name, v in rest.items()
    }
    trace = replace(first.trace, particles=len(other["log_weights"]), carried={}, **back)
    return replace(first, trace=trace, approximation=None, **other)
