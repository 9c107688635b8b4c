"""What it takes to rank candidate probes, beside the bare physics of the same probes, and whether they agree.

Thirty-two touches and slides of 2 s, laid out around the belief after vision of one scene of the accuracy
bench, for all its particles. Physics is MuJoCo at 2 ms, the free approach simulated for each particle; what a
ranking takes is measured by its time. Ranked are, by each way: Algorithm 1 of BayesContact (particles
reweighed, the entropy of their weights), and information added up in the tangent space; both on what physics
makes of each probe, and on what its quasi-static stand-in does. `--choices N` goes through N scenes: whether
Algorithm 1 on physics chooses the same probe as the default ranking, and where not, which of the two probes,
carried out in the world, leaves less entropy.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from report import Row, cores, finish, options, show
from scenes import model
from scipy.stats import spearmanr
from torch import Tensor

from bcppl import poses
from bcppl.contact.mujoco_model import ContactParameters
from bcppl.contact.physics import PegPhysics
from bcppl.distributions.episodes.rows import padded
from bcppl.inference.design import Ranking, expected_information_gain, linearised_information_gain
from bcppl.inference.filters.guided_smc import infer
from bcppl.inference.planning.candidate_layout import plan_candidates
from bcppl.inference.population import Population
from bcppl.inference.resampling import systematic
from bcppl.models.worlds.bench.scene import bench_scene
from bcppl.robot.plan import Plan, probe_of
from bcppl.sensors.candidates import action_of
from bcppl.sensors.likelihoods.contact_probe import PREDICTED
from bcppl.sensors.likelihoods.probe_rows import capacity, step_of
from bcppl.sensors.scene import Scene
from bcppl.sweeps import in_order
from bcppl.traces import Trace

PARTICLES, CANDIDATES = 75, 32
LASTING = 2.0  # s
BUDGET = 16  # outer samples of Algorithm 1, and of the small budget
FELT = 1.5  # N
MOST = 1.25  # times the bare rollouts
ADDRESS = "part"


class Setting(NamedTuple):
    """One scene after vision: the model's, the particles, what was done, and a physics of its own."""

    scene: Scene
    population: Population
    done: list[Any]
    physics: PegPhysics

    def arguments(self, plan: Plan) -> tuple[Any, ...]:
        """The model's, once a plan is carried out as well."""
        return self.scene, [*self.done, action_of(plan)]

    @property
    def touches(self) -> Any:
        """The likelihood of touches."""
        return self.scene.likelihoods["window"]


def after_vision(seed: int, particles: int) -> tuple[Setting, list[Plan]]:
    """A scene looked at, and candidates enough for all tables."""
    world = bench_scene(seed)
    recording = world.look()
    scene = model.prepare(recording)
    *_, last = infer(model, recording, particles=particles, seed=seed, scene=scene)
    physics = PegPhysics(world.part, world.peg, ContactParameters(time_step=0.002), share_free_motion=False)
    asked = {"touch": 80, "slide": 48}
    found = plan_candidates(
        last.belief, world.part, world.peg, asked, gap=scene.likelihoods["window"].gap, seed=seed
    )
    plans = [each for each in found if isinstance(each, Plan)]
    plans = [replace(each, times=each.times * (LASTING / each.times[-1])) for each in plans]
    order = np.random.default_rng(seed).permutation(len(plans))
    done = [each.action for each in recording.measurements]
    return Setting(scene, last.population, done, physics), [plans[k] for k in order]


def rolled_out(setting: Setting, plan: Plan, part: Tensor) -> Tensor:
    """What physics makes of a plan for poses (N, 7) of the part: (N, T, 8), without the sensors' noise."""
    probe = probe_of(plan)
    every = max(1, round(PREDICTED / step_of(probe)))
    rollout = setting.physics.start(part, probe).advance(len(probe.stamps))
    felt = np.linalg.norm(rollout.wrench[..., :3], axis=-1, keepdims=True) > FELT
    return torch.from_numpy(np.concatenate([rollout.world_from_peg, felt], axis=-1)[:, ::every])


class Physics:
    """What physics makes of each plan for all particles, kept, so that its time is known apart."""

    def __init__(self, setting: Setting, plans: Sequence[Plan]) -> None:
        begun = time.perf_counter()
        self.setting = setting
        part = setting.population[ADDRESS]
        self.rows = {id(plan): rolled_out(setting, plan, part) for plan in plans}
        self.seconds = time.perf_counter() - begun

    def at(self, plan: Plan, part: Tensor) -> Tensor:
        """With noise, at poses (H, 7) of particles."""
        among = self.setting.population[ADDRESS]
        which = (part[:, None] == among).all(dim=2).to(torch.uint8).argmax(dim=1)
        rows = self.rows[id(plan)][which].clone()
        sensor = self.setting.touches
        noise = sensor.settings.gap_noise * torch.randn(*rows.shape[:2], 3, dtype=torch.float64)
        whole = torch.cat([rows[..., :3] + noise, rows[..., 3:]], dim=-1)
        return padded(whole, capacity(action_of(plan)))

    def predict(self, plan: Plan, trace: Trace) -> dict[str, Tensor]:
        """What would be observed, for `expected_information_gain`."""
        return {f"touch_{len(self.setting.done)}": self.at(plan, trace[ADDRESS])}

    def information(self, plan: Plan, trace: Trace) -> Tensor:
        """The information of that, for `linearised_information_gain`."""
        window, part = action_of(plan), trace[ADDRESS]
        torch.manual_seed(0)
        return self.setting.touches.site(window, part).quadratic(self.at(plan, part)).information


def timed(work: Callable[[], Ranking]) -> tuple[Ranking, float]:
    begun = time.perf_counter()
    found = work()
    return found, time.perf_counter() - begun


def reweighed(setting: Setting, plans: Sequence[Plan], physics: Physics | None) -> Ranking:
    """Algorithm 1."""
    predictive = None if physics is None else physics.predict
    return expected_information_gain(
        setting.population, plans, setting.arguments, outer_samples=BUDGET, predictive=predictive, seed=0
    )


def added_up(
    setting: Setting, plans: Sequence[Plan], physics: Physics | None = None, outer_samples: int | None = None
) -> Ranking:
    information = None if physics is None else physics.information
    return linearised_information_gain(
        setting.population,
        plans,
        setting.arguments,
        ADDRESS,
        outer_samples=outer_samples,
        information=information,
        seed=0,
    )


def gains(ranking: Ranking) -> np.ndarray:
    return np.array([ranking.of(k).information_gain for k in range(len(ranking))])


def larger(setting: Setting, particles: int) -> Setting:
    """The same belief with another number of particles, each a little beside the one it was drawn from."""
    torch.manual_seed(particles)
    chosen = systematic(setting.population.log_weights, particles)
    trace = setting.population.trace.chosen(chosen)
    away = 1e-4 * torch.randn(particles, 6, dtype=torch.float64)
    moved = trace.at({ADDRESS: poses.retract(trace[ADDRESS], away)})
    return setting._replace(population=Population(moved))


def growth(counts: Sequence[int], seconds: Sequence[float]) -> float:
    """The exponent by which time grows."""
    return float(np.polyfit(np.log(counts), np.log(seconds), 1)[0])


class Choice(NamedTuple):
    """The probes that two rankings choose in one scene, and what came of each.

    Attributes:
        seed: of the scene.
        numbers: of the probes, by Algorithm 1 on physics and by the default ranking.
        lost: nats that each choice lacks to the best probe by the information that physics adds up.
        entropies: differential entropy of the belief after each probe, nats, by its Gaussian.
        adds: ADD averaged over the particles by weight, mm.
    """

    seed: int
    numbers: tuple[int, int]
    lost: tuple[float, float]
    entropies: tuple[float, float]
    adds: tuple[float, float]


def choice(seed: int, count: int) -> Choice:
    """What both rankings choose of `count` probes, and how each choice ends."""
    setting, plans = after_vision(seed, PARTICLES)
    some, world = plans[:count], bench_scene(seed)
    physics = Physics(setting, some)
    numbers = tuple(
        ranking.best.number for ranking in (reweighed(setting, some, physics), added_up(setting, some))
    )
    truth = gains(added_up(setting, some, physics))

    def carried_out(number: int) -> tuple[float, float]:
        recording = world.probe(some[number])
        *_, last = infer(model, recording, particles=PARTICLES, seed=seed)
        entropy = 0.5 * float(torch.logdet(2.0 * torch.pi * torch.e * last.belief.covariance))
        return entropy, 1e3 * last.belief.weighted_add(world.part.surface_points(), world.truth)

    ended = {number: carried_out(number) for number in set(numbers)}
    first, second = numbers
    return Choice(
        seed,
        (first, second),
        (float(truth.max() - truth[first]), float(truth.max() - truth[second])),
        (ended[first][0], ended[second][0]),
        (ended[first][1], ended[second][1]),
    )


def compare_choices(seeds: Sequence[int], count: int, jobs: int) -> list[Row]:
    """The table of choices, and their rows."""
    found: list[Choice] = []
    for one in in_order(partial(choice, count=count), seeds, jobs):
        found.append(one)
        print(*one, flush=True)
    same = [one.numbers[0] == one.numbers[1] for one in found]
    differ = [one for one, agreed in zip(found, same, strict=True) if not agreed]
    show(
        f"one of {count} probes, by Algorithm 1 on physics / by the default ranking",
        ["scene", "probe", "nats lost", "entropy after", "weighted ADD mm"],
        [
            [one.seed, *(" / ".join(f"{x:.3g}" for x in both) for both in one[1:])]  # type: ignore[attr-defined]
            for one in found
        ],
    )
    rows = [Row("the same choice", 100.0 * float(np.mean(same)), "%", 90.0, "min")]
    for k, name in enumerate(("Algorithm 1 on physics", "the default ranking")):
        lost = [one.lost[k] for one in found]
        rows.append(Row(f"{name}: nats lost by its choice, median", float(np.median(lost)), "nats"))
        rows.append(Row(f"{name}: nats lost by its choice, worst", max(lost), "nats"))
    if differ:
        gained = [one.entropies[0] - one.entropies[1] for one in differ]
        rows += [
            Row("where they differ: entropy less after the default's probe", float(np.mean(gained)), "nats"),
            Row("standard error of that", float(np.std(gained) / max(1, len(gained) - 1) ** 0.5), "nats"),
            Row("where they differ: it is less in", 100.0 * float(np.mean(np.array(gained) > 0)), "%"),
        ]
    return rows


def main() -> None:
    parser = options(__doc__ or "")
    parser.add_argument("--choices", type=int, metavar="N", help="compare the choices in N scenes")
    parser.add_argument("--jobs", type=int, default=1, help="of these at a time")
    arguments = parser.parse_args()
    torch.set_num_threads(
        1
    )  # its threads wait for one another where cores are shared; simulators have theirs
    particles = 25 if arguments.quick else PARTICLES
    count = 8 if arguments.quick else CANDIDATES
    if arguments.choices:
        seeds = range(arguments.seed, arguments.seed + arguments.choices)
        finish(compare_choices(seeds, count, arguments.jobs), arguments.json)
        return
    setting, plans = after_vision(arguments.seed, particles)
    some = plans[:count]
    added_up(setting, some[:1])  # what is compiled or built once

    physics = Physics(setting, some)
    ways = {
        "physics, reweighed": (timed(lambda: reweighed(setting, some, physics)), physics.seconds),
        "physics, added up": (timed(lambda: added_up(setting, some, physics)), physics.seconds),
        "quasi-static, reweighed": (timed(lambda: reweighed(setting, some, None)), 0.0),
        "quasi-static, added up": (timed(lambda: added_up(setting, some)), 0.0),
        f"quasi-static, added up, {BUDGET} outer samples": (
            timed(lambda: added_up(setting, some, outer_samples=BUDGET)),
            0.0,
        ),
    }
    truth = gains(ways["physics, added up"][0][0])
    rows = [Row("bare rollouts", physics.seconds, "s")]
    lines: list[list[Any]] = [["bare rollouts", physics.seconds, 1.0, "", "", "", ""]]
    for name, ((ranking, seconds), before) in ways.items():
        own, ratio = gains(ranking), (seconds + before) / physics.seconds
        best = ranking.best.number
        lost = float(truth.max() - truth[best])
        spread = float(own.max() - own.min())
        agreement = float(spearmanr(own, truth).statistic) if spread > 0.0 else float("nan")
        lines.append([name, seconds + before, ratio, best, lost, agreement, spread])
        judged = name == "quasi-static, added up"
        rows += [
            Row(f"{name}: time / bare rollouts", ratio, "", MOST if judged else None),
            Row(
                f"{name}: nats lost by its choice, as physics adds them up",
                lost,
                "nats",
                0.2 if judged else None,
            ),
            Row(f"{name}: rank correlation with physics, added up", agreement, "", direction="min"),
            Row(f"{name}: best less worst gain", spread, "nats", direction="min"),
        ]
    columns = ["way", "s", "/ bare", "its best", "nats lost", "rank corr.", "spread nats"]
    title = f"{count} probes of {LASTING:g} s, {particles} particles, {cores()} cores"
    show(title, columns, lines)

    counts = (4, 8) if arguments.quick else (8, 16, 32, 64, 128)
    taken = [timed(lambda n=n: added_up(setting, plans[:n]))[1] for n in counts]
    sizes = (25, 50) if arguments.quick else (25, 75, 150, 300)
    wider = [larger(setting, n) for n in sizes]
    grown = [timed(lambda one=one: added_up(one, some))[1] for one in wider]
    show("growth with candidates", ["candidates", *map(str, counts)], [["s", *taken]])
    show(f"growth with particles, {count} candidates", ["particles", *map(str, sizes)], [["s", *grown]])
    rows += [Row(f"{n} candidates", s, "s") for n, s in zip(counts, taken, strict=True)]
    rows += [Row(f"{n} particles", s, "s") for n, s in zip(sizes, grown, strict=True)]
    rows += [
        Row("time grows with candidates by the power", growth(counts, taken), "", 1.1),
        Row("time grows with particles by the power", growth(sizes, grown), "", 1.1),
    ]
    finish(rows, arguments.json)


if __name__ == "__main__":
    main()
