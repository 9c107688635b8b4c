"""Touches of a bench with everything off: part, grasp, arm, clock and sizes drawn from the model's priors.

A block is touched at its top and at two of its sides by a peg that leans, so that a corner touches. Rows are
where the gap is what was drawn: that of the model, linear in the errors, or that of the displaced solids
themselves. Inference has the shipped likelihood, which integrates the errors out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import pyro
import torch
from torch import Tensor

from bcppl import poses
from bcppl.distributions.episodes import (
    ArmCompliance,
    ContactEpisodes,
    Delay,
    Grasp,
    Hypothesis,
    LinearError,
    LinearErrors,
)
from bcppl.distributions.episodes.displaced import lines_at
from bcppl.distributions.episodes.filter.branches import OF_CONTACT
from bcppl.distributions.episodes.rows import (
    COLUMNS,
    EARLIER,
    EPISODE,
    FELT,
    FORCE,
    NOISE,
    SECONDS,
    TIME,
    WRENCH,
    late,
)
from bcppl.distributions.poses import NormalPose
from bcppl.geometry.extrusion import block, box_peg
from bcppl.geometry.gap import PegGap
from bcppl.inference.calibration.ranks import ranks
from bcppl.inference.filters.step import Observed
from bcppl.inference.filters.tempered_smc import kernel as shipped
from bcppl.inference.filters.tempering import tempered
from bcppl.inference.kernels import moved_by
from bcppl.inference.population import Population
from bcppl.inference.resampling import systematic
from bcppl.inference.targets import POSTERIOR
from bcppl.sensors.likelihoods.bench_profiles import BenchProfile
from bcppl.traces import generate
from tests.calibration.case import AXES, DRAWS
from tests.distributions.touches.episode_errors import factors

HALF, HEIGHT, LENGTH = 0.03, 0.025, 0.05
GAP = PegGap(block((2.0 * HALF, 2.0 * HALF, HEIGHT)), box_peg(0.016, LENGTH))
SPREAD = torch.tensor([1e-3] * 3 + [0.01] * 3, dtype=torch.float64)
CENTER = poses.identity()
NOISE_OF_ROW, SHARED, DRIFT = 6e-5, 1e-5, 2e-5  # m
# About as wide as a posterior, m and rad.
ALIKE = torch.tensor([5e-4] * 3 + [3.6e-3] * 3, dtype=torch.float64)
STRAY = 1e-9  # of an episode: none is drawn
PARTICLES = 150
STILL, SUDDEN = BenchProfile(slips=0.0, slides=0.0), BenchProfile(slips=0.01, slides=0.01)
COMPLIANCE = 5e-6  # m/N


def design() -> tuple[Tensor, Tensor]:
    """Rows (R, COLUMNS) of a probe, pegs about where they touch, and the directions (R, 3) they come in."""
    rows, along = [], []
    # Away from the block's edges: past one, a gap is no smooth function of where the peg stops.
    tops = [(-0.014, -0.014), (0.014, -0.014), (0.0, 0.014)]
    sides = [((-1.0, 0.0), (0.0, -0.014)), ((-1.0, 0.0), (0.0, 0.014)), ((0.0, 1.0), (0.0, 0.0))]
    # Each place twice, the hand turned and leaning the other way: that tells the grasp from the part.
    for flip in (1.0, -1.0):
        turned = torch.tensor([0.0, 0.0, flip * 0.3], dtype=torch.float64)
        for x, y in tops:
            rows.append((torch.tensor([x, y, LENGTH]), turned, flip))
            along.append(torch.tensor([0.0, 0.0, -1.0]))
        for (nx, ny), (x, y) in sides:
            place = [x + nx * (HALF + 0.004), y + ny * (HALF + 0.004), LENGTH - 0.012]
            rows.append((torch.tensor(place), turned, flip))
            along.append(torch.tensor([-nx, -ny, 0.0]))
    return _rows_of(rows, along), torch.stack(along).double().repeat_interleave(len(FORCES), dim=0)


FORCES = (2.0, 5.0, 9.0, 6.0)  # N


def _rows_of(places: Sequence[Any], along: Sequence[Tensor]) -> Tensor:
    every = torch.zeros(len(places), len(FORCES), COLUMNS, dtype=torch.float64)
    for k, ((place, turned, flip), direction) in enumerate(zip(places, along, strict=True)):
        lean = torch.tensor([0.11 * flip, -0.08, 0.0], dtype=torch.float64)
        peg = poses.retract(poses.as_pose([*place.tolist(), 1.0, 0.0, 0.0, 0.0]), _twist(turned))
        peg = poses.retract(peg, _twist(lean))
        push = direction.double() @ poses.rotation_matrix(peg)  # in the peg's frame
        every[k, :, :7], every[k, :, FELT], every[k, :, NOISE] = peg, 1.0, NOISE_OF_ROW
        every[k, :, EPISODE] = float(k)
        for i, force in enumerate(FORCES):
            every[k, i, FORCE], every[k, i, TIME] = force, 0.5 * k + 0.03 * i
            every[k, i, WRENCH] = torch.cat([-force * push, torch.linalg.cross(0.01 * push.roll(1), push)])
            # It comes at 15 mm/s, and slower while it is pressed; a rocking hand turns.
            speed = 0.015 / (1.0 + i)
            for j, second in enumerate(SECONDS):
                back = torch.cat([-speed * second * push, 0.1 * flip * second * torch.ones(3)])
                every[k, i, EARLIER][6 * j : 6 * j + 6] = back
    return every.flatten(0, 1)


def _twist(turn: Tensor) -> Tensor:
    return torch.cat([torch.zeros(3, dtype=torch.float64), turn])


ROWS, ALONG = design()


def errors_of(profile: BenchProfile = STILL) -> tuple[LinearError, ...]:
    """The shipped errors of a profile."""
    return profile.errors((0.0, 0.0, 0.0), (0.0, 0.0, LENGTH))


class Truth(NamedTuple):
    """What was drawn: the part's pose (7,), the errors (M,) at the end, and the hypothesis."""

    pose: Tensor
    errors: Tensor
    hypothesis: Hypothesis


@dataclass(frozen=True)
class Bench:
    """What inference takes the bench to be; a world has errors of a profile, and noise as stated.

    Attributes:
        errors: that all touches share.
        noise: factor of the rows' noise.
    """

    errors: tuple[LinearError, ...] = field(default_factory=errors_of)
    noise: float = 1.0

    def site(self, pose: Tensor, rows: Tensor) -> ContactEpisodes:
        """The likelihood of rows at poses (N, 7)."""
        hypotheses = STILL.hypotheses(COMPLIANCE)
        return ContactEpisodes(
            GAP,
            pose,
            len(rows),
            NOISE_OF_ROW,
            SHARED,
            DRIFT,
            STRAY,
            compliance=COMPLIANCE,
            bench=LinearErrors(self.errors),
            hypotheses=tuple(h._replace(noise=h.noise * self.noise) for h in hypotheses),
        )

    def program(self, rows: Tensor) -> Callable[[int], None]:
        """The part's pose, and where the count is 1 the touches."""

        def touched(count: int) -> None:
            part = pyro.sample("part", NormalPose(CENTER, SPREAD))
            if count:
                pyro.sample("touch", self.site(part, rows))

        return touched

    def infer(self, rows: Tensor) -> Population:
        """Particles given rows."""
        program = self.program(rows)
        trace, log_weights = generate(program, (0,), {}, PARTICLES)
        step = tempered(shipped("part"), sweeps=8, share=0.7)
        population = step(Population(trace, log_weights), Observed((1,), {"touch": rows})).population
        return moved_by(population, shipped("part"), POSTERIOR, 20).population


def simulated(profile: BenchProfile = STILL, solids: bool = False) -> tuple[Truth, Tensor]:
    """A truth from a profile's prior, and the rows of the design where it is touched.

    The gap is linear in the errors, as the model's, or that of the displaced solids.
    """
    gap_of = _gap if solids else _linear_gap
    bench = Bench(errors_of(profile))
    pose = NormalPose(CENTER, SPREAD).sample()
    site = bench.site(pose[None], ROWS)
    every, errors = site._every, site.bench
    hypothesis = every[int(torch.multinomial(torch.tensor([h.log_weight for h in every]).exp(), 1))]
    deviations = hypothesis.scale * errors.variances.sqrt()
    value = errors.means + deviations * torch.randn(len(deviations), dtype=torch.float64)
    touches, held, moved = len(ROWS) // len(FORCES), len(FORCES), torch.zeros(len(ROWS), len(value))
    for jump in errors.jumps:
        happens = torch.rand(touches, 1, dtype=torch.float64) < jump.probability
        loading = torch.diff(torch.tensor([0.0, *FORCES], dtype=torch.float64).cummax(0).values) / max(FORCES)
        change = hypothesis.scale * (loading[:, None] * jump.variances).sqrt()
        drawn = change * torch.randn(touches, held, len(value), dtype=torch.float64)
        moved = moved + (happens[..., None] * drawn).flatten(0, 1).cumsum(dim=0)
    values = value + moved
    factor = factors(ROWS, site._row_errors, hypothesis)
    blocks = factor.unflatten(0, (-1, len(FORCES)))[..., : len(FORCES)]
    noise = (blocks @ torch.randn(len(blocks), len(FORCES), 1, dtype=torch.float64)).flatten()
    wanted = noise - hypothesis.compliance * ROWS[:, FORCE]
    rows, above = ROWS.clone(), torch.full((len(ROWS),), 0.03, dtype=torch.float64)
    below = -above
    for _ in range(40):  # the gap falls along the direction in which the peg comes
        middle = 0.5 * (below + above)
        rows[:, :3] = ROWS[:, :3] + middle[:, None] * ALONG
        over = gap_of(pose, rows, errors, values, hypothesis.delay) > wanted
        below, above = torch.where(over, middle, below), torch.where(over, above, middle)
    return Truth(pose, values[-1], hypothesis), rows


def _gap(pose: Tensor, rows: Tensor, errors: LinearErrors, values: Tensor, delay: int) -> Tensor:
    """Gaps (R,) of the solids where they truly are."""
    then, shift = late(rows, delay)
    effect = errors.effect(then)
    twist = shift + (effect.twist @ values[..., None])[..., 0]
    turn = poses.rotation_matrix(rows[:, :7])
    along = (turn @ twist[:, :3, None])[..., 0]
    true = poses.retract(rows[:, :7], torch.cat([along, twist[:, 3:]], dim=1))
    return GAP(pose[None], true).distance[0] + (effect.offset * values).sum(dim=1)


def _linear_gap(pose: Tensor, rows: Tensor, errors: LinearErrors, values: Tensor, delay: int) -> Tensor:
    """Gaps (R,) as the model has them."""
    lines, place = lines_at(GAP(pose[None], rows[:, :7]), pose[None], rows, errors), list(errors.delays)
    moved, columns = (each[0, place.index(delay)] for each in (lines.moved, lines.columns))
    return lines.distance[0] + moved + (columns * values).sum(dim=1)


OTHERS = ("the delay", "the contact's compliance", "the noise", "the scale of the errors")


def quantities(errors: tuple[LinearError, ...]) -> list[str]:
    """What is ranked."""
    named = [f"{e.name} [{k}]" for e in errors for k in range(len(e.means))]
    return [f"part {axis}" for axis in AXES] + named + list(OTHERS) + ["log-likelihood"]


def measured(pose: Tensor, errors: Tensor, which: Sequence[Hypothesis], log_likelihood: Tensor) -> Tensor:
    """The quantities (K, Q) of K poses (K, 7), errors (K, M) and hypotheses."""
    place = LinearErrors(errors_of()).slices["the time between wrench and pose"].start
    ends = (0.0, 0.0, *SECONDS)
    delays = [
        0.5 * (ends[h.delay + 1] + ends[h.delay])
        + 0.5 * (ends[h.delay + 1] - ends[h.delay]) * Delay().within * float(e[place])
        for h, e in zip(which, errors, strict=True)
    ]
    discrete = torch.tensor([[h.compliance, h.noise, h.scale] for h in which], dtype=torch.float64)
    return torch.cat(
        [
            poses.local(CENTER, pose),
            errors.round(decimals=6),  # what never jumped is 0 but for rounding, and a tie
            torch.tensor(delays, dtype=torch.float64)[:, None],
            discrete,
            log_likelihood[:, None],
        ],
        dim=1,
    )


def rank(bench: Bench, seed: int, profile: BenchProfile = STILL, solids: bool = False) -> Tensor:
    """One round: draw, infer, rank (Q,); what a mutant leaves out is drawn from its prior."""
    torch.manual_seed(seed)
    truth, rows = simulated(profile, solids)
    population = bench.infer(rows)
    chosen = systematic(population.log_weights)[torch.randperm(len(population))[:DRAWS]]
    pose = population.trace["part"][chosen]
    site = bench.site(pose, rows)
    branches = site.branches(rows)
    pick = torch.multinomial(torch.from_numpy(branches.weights), 1)[:, 0].numpy()
    shared = slice(0, -OF_CONTACT)
    mean = torch.from_numpy(branches.mean[..., shared])[range(DRAWS), pick]
    values, axes = torch.linalg.eigh(
        torch.from_numpy(branches.covariance[..., shared, shared])[range(DRAWS), pick]
    )
    standard = torch.randn(*mean.shape, 1, dtype=torch.float64)
    own = mean + ((axes * values.clamp(min=0.0).sqrt()[:, None]) @ standard)[..., 0]
    hypotheses = [site._every[k] for k in branches.which[range(DRAWS), pick]]
    whole = LinearErrors(errors_of())
    errors = whole.means + whole.variances.sqrt() * torch.randn(DRAWS, len(whole.means), dtype=torch.float64)
    for name, place in LinearErrors(bench.errors).slices.items():
        errors[:, whole.slices[name]] = own[:, place]
    exact = Bench(errors_of(profile)).site(torch.cat([truth.pose[None], pose]), rows).log_prob(rows)
    columns = measured(
        torch.cat([truth.pose[None], pose]),
        torch.cat([truth.errors[None], errors]),
        [truth.hypothesis, *hypotheses],
        exact,
    )
    return ranks(columns[0], columns[1:])


def rank_among_alike(seed: int, bench: Bench | None = None, count: int = 32) -> float:
    """The rank in (0, 1) of the truth's posterior density among poses that might as well have been the truth.

    All are drawn about a common centre, so they can be exchanged; no inference is made.
    """
    torch.manual_seed(seed)
    truth, rows = simulated()
    apart = ALIKE * torch.randn(count, 6, dtype=torch.float64)
    moved = poses.local(CENTER, truth.pose) - apart[0] + apart
    pose = poses.retract(CENTER.expand(count, 7), moved)
    density = (bench or Bench()).site(pose, rows).log_prob(rows) - 0.5 * ((moved / SPREAD) ** 2).sum(dim=1)
    weight = density.softmax(dim=0)
    return float(weight[density < density[0]].sum() + torch.rand(()) * weight[0])


@dataclass(frozen=True)
class Pulled(ArmCompliance):
    """An arm that yields towards the force."""

    def effect(self, rows: Tensor) -> Any:
        right = super().effect(rows)
        return right._replace(twist=-right.twist)


def without(kind: type) -> Bench:
    """A bench that knows nothing of one error."""
    return Bench(tuple(e for e in errors_of() if not isinstance(e, kind)))


def pulled() -> Bench:
    """A wrong sign of the arm's compliance."""
    return Bench(
        tuple(Pulled(e.translation, e.rotation) if isinstance(e, ArmCompliance) else e for e in errors_of())
    )


SLIPS, SOLIDS = "slips and slides", "slips and slides, displaced solids"
BENCHES: dict[str, Callable[[], Bench]] = {
    "sound": Bench,
    "the arm yields towards the force": pulled,
    "no grasp": lambda: without(Grasp),
    "noise doubled": lambda: replace(Bench(), noise=2.0),
}


def round_of(name: str, seed: int) -> Tensor:
    """The ranks of one round: of a mutant by name, or of inference as shipped in a world by name."""
    if name in BENCHES:
        return rank(BENCHES[name](), seed)
    return rank(Bench(errors_of(SUDDEN)), seed, SUDDEN, solids=name == SOLIDS)
