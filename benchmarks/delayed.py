"""What deciding in stages saves: simulated seconds per effective sample at a simulated probe's posterior.

By delayed acceptance and by surrogate transitions.

A probe is assimilated as usual. From its last population, moves of every particle go on at the posterior,
each half learning from the other before every sweep. Of the chains' tangent coordinates the one that mixes
worst gives the effective sample size; simulated seconds are those of the physics' own clock.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from matplotlib.figure import Figure
from report import Row, finish, options, show

from bcppl import poses
from bcppl.inference.filters.guided_smc import infer
from bcppl.inference.filters.screening import approximated
from bcppl.inference.kernels import (
    Kernel,
    Move,
    delayed_acceptance,
    metropolis_hastings,
    moved_by,
    repeat,
    student_t,
    surrogate_transition,
)
from bcppl.inference.population import Population
from bcppl.inference.proposals import differential_evolution, drift, independent
from bcppl.inference.resampling import always
from bcppl.inference.targets import POSTERIOR, FunctionTarget, Target
from bcppl.models.peg_in_hole import model
from bcppl.models.worlds.peg_in_hole import simulate_recording
from bcppl.sweeps import swept
from bcppl.traces import Trace

PARTICLES = 75
POSE = model.pose
ENOUGH = 0.05  # autocorrelation below which lags are noise


def thorough(kernel: Kernel) -> Kernel:
    """The kernel without early rejection: a plain function of the trace is evaluated at every proposal."""

    def fitted(population: Population) -> Move:
        move = kernel(population)

        def plain(trace: Trace, target: Target) -> tuple[Trace, torch.Tensor]:
            return move(trace, FunctionTarget(log_density=target))

        return plain

    return fitted


WALK = metropolis_hastings(drift(POSE, (0.2, 2.0)))
LONG_WALK = metropolis_hastings(drift(POSE, (0.7, 2.0)))
INDEPENDENT = metropolis_hastings(independent(POSE, 1))
EVOLUTION = metropolis_hastings(differential_evolution(POSE))
WINDOWS = 13  # the first stage, then one for each window of the probe

WITHOUT: dict[str, Kernel] = {
    "walk, all evaluated": thorough(WALK),
    "walk": WALK,
    "differential evolution": EVOLUTION,
    "independent": INDEPENDENT,
}
WITH: dict[str, Kernel] = {
    "delayed: walk, depth first": delayed_acceptance(WALK),
    "delayed: walk, window by window": delayed_acceptance(WALK, stages=WINDOWS),
    "delayed: 4 long walks, surrogate": repeat(delayed_acceptance(LONG_WALK, surrogate=student_t(POSE)), 4),
    "delayed: walk, geometry": delayed_acceptance(WALK, surrogate=approximated),
    "delayed: 4 long walks, geometry": repeat(delayed_acceptance(LONG_WALK, surrogate=approximated), 4),
    "delayed: independent, window by window": delayed_acceptance(INDEPENDENT, stages=WINDOWS),
    "delayed: 2 independent, surrogate": repeat(
        delayed_acceptance(INDEPENDENT, surrogate=student_t(POSE)), 2
    ),
    "transition: 10 long walks, surrogate": surrogate_transition(repeat(LONG_WALK, 10), student_t(POSE)),
    "transition: 10 long walks, geometry": surrogate_transition(repeat(LONG_WALK, 10), approximated),
}
KERNELS = {**WITHOUT, **WITH}


class Measured(NamedTuple):
    """One kernel at one posterior.

    Attributes:
        acceptance: the share of proposals accepted.
        simulated: seconds of physics for each particle and sweep.
        time: the integrated autocorrelation time of the worst coordinate, in sweeps.
        cost: simulated seconds per effective sample.
        displacement: the mean squared step of a sweep on the worst axis, in variances; 2 is independence.
        wall: seconds of wall time for each particle and sweep.
    """

    acceptance: float
    simulated: float
    time: float
    cost: float
    displacement: float
    wall: float


def autocorrelation_time(chains: npt.NDArray[np.float64]) -> float:
    """The integrated autocorrelation time of chains (T, N), all at their stationary law.

    Correlations at each lag are averaged over the N chains about their common mean, summed in pairs while
    these stay above noise (Geyer, Practical Markov chain Monte Carlo, Statistical Science 7, 1992, section
    3.3). Where half the chain is too short for that, the rest is taken to fall off geometrically.
    """
    length = len(chains)
    centred = chains - chains.mean()
    lags = length // 2
    rho = np.array([(centred[: length - k] * centred[k:]).mean() for k in range(lags)])
    rho /= rho[0]
    total = -1.0
    for k in range(0, lags - 1, 2):
        pair = rho[k] + rho[k + 1]
        if pair < 2 * ENOUGH:
            return max(1.0, float(total))
        total += 2.0 * pair
    rate = rho[lags - 1] ** (1.0 / (lags - 1))
    return float(total + 2.0 * rho[lags - 1] * rate / (1.0 - rate))


def chains(
    scene: Any, population: Population, kernel: Kernel, sweeps: int, seed: int = 0
) -> tuple[Measured, npt.NDArray[np.float64]]:
    """Run a kernel on from a population at the posterior, and measure it.

    Returns:
        What was measured, and the chains (sweeps + 1, N, d) along the free axes of the pose.
    """
    torch.manual_seed(seed)
    belief = population.belief(POSE)
    before, begun = scene.efforts["physics"].copy(), time.perf_counter()

    def where(population: Population) -> npt.NDArray[np.float64]:
        tangent: npt.NDArray[np.float64] = belief.freedom.coordinates(
            poses.local(belief.mean, population.trace[POSE])
        ).numpy()
        return tangent

    path, acceptances = [where(population)], []
    for _ in range(sweeps):
        moved = moved_by(population, kernel, POSTERIOR)
        population = moved.population
        acceptances.append(moved.acceptance)
        path.append(where(population))
    moves = sweeps * len(population)
    spent = scene.efforts["physics"].since(before).amount / moves
    wall = (time.perf_counter() - begun) / moves
    places = np.array(path)
    worst = max(autocorrelation_time(places[:, :, k]) for k in range(places.shape[2]))
    steps = np.square(np.diff(places, axis=0)).mean(axis=(0, 1)) / places.var(axis=(0, 1))
    return (
        Measured(float(np.mean(acceptances)), spent, worst, spent * worst, float(steps.min()), wall),
        places,
    )


def posterior(seed: int) -> tuple[Any, Population]:
    """The scene of a probe, and its particles given all measurements, equally weighted."""
    recording = simulate_recording(seed)
    scene = model.prepare(recording)
    *_, last = infer(model, recording, particles=PARTICLES, seed=seed, scene=scene)
    return scene, always()(last.population)[0]


def compare(task: tuple[int, int]) -> dict[str, Measured]:
    """All kernels at the posterior of a probe's seed, with so many sweeps."""
    seed, sweeps = task
    scene, population = posterior(seed)
    return {name: chains(scene, population, kernel, sweeps)[0] for name, kernel in KERNELS.items()}


def figure(results: Sequence[dict[str, Measured]]) -> Figure:
    """Simulated seconds per effective sample: a bar for each kernel (the median), a point for each probe."""
    picture = Figure(figsize=(7.0, 0.42 * len(KERNELS) + 1.2), layout="constrained")
    axes = picture.subplots()
    for place, name in enumerate(KERNELS):
        costs = [result[name].cost for result in results]
        axes.barh(place, float(np.median(costs)), color="#0072B2" if name in WITH else "#9DB4C8")
        axes.plot(costs, [place] * len(costs), "o", color="black", markersize=3)
    axes.set_yticks(range(len(KERNELS)), list(KERNELS))
    axes.invert_yaxis()
    axes.set_xlabel("simulated seconds per effective sample")
    axes.spines[["top", "right"]].set_visible(False)
    return picture


def main() -> None:
    parser = options(__doc__ or "")
    parser.add_argument("--jobs", type=int, default=1, help="probes at a time")
    parser.add_argument("--file", type=Path, help="where what comes of each probe is kept")
    parser.add_argument("--figure", type=Path, metavar="FILE", help="save a figure of the comparison")
    arguments = parser.parse_args()
    probes, sweeps = (1, 6) if arguments.quick else (4, 40)
    seeds = range(arguments.seed, arguments.seed + probes)
    results = []
    for (seed, _), found in swept(
        compare, [(seed, sweeps) for seed in seeds], file=arguments.file, jobs=arguments.jobs
    ):
        results.append({name: Measured(*values) for name, values in found.items()})
        print(f"probe {seed} done", flush=True)

    def median(name: str, field: str) -> float:
        return float(np.median([getattr(result[name], field) for result in results]))

    fields = Measured._fields
    show(
        f"at the posterior of {probes} simulated probes: {PARTICLES} chains of {sweeps} sweeps, medians",
        ["", "accepted", "simulated s/sweep", "time, sweeps", "simulated s/ES", "step, variances", "wall s"],
        [[name, *[median(name, field) for field in fields]] for name in KERNELS],
    )
    if arguments.figure is not None:
        figure(results).savefig(arguments.figure, dpi=150)

    def gain(without: str) -> float:
        """The median over probes of how many times less the best kernel with stages costs."""
        best = min(WITH, key=lambda name: median(name, "cost"))
        return float(np.median([result[without].cost / result[best].cost for result in results]))

    best = min(WITHOUT, key=lambda name: median(name, "cost"))
    unit = "simulated s/sample"
    finish(
        [
            *[Row(f"{name}, median", median(name, "cost"), unit) for name in KERNELS],
            Row(f"saved against the best without: {best}", gain(best), "x", 2.0, "min"),
            *[Row(f"saved against {name}", gain(name), "x", None, "min") for name in WITHOUT if name != best],
        ],
        arguments.json,
    )


if __name__ == "__main__":
    main()
