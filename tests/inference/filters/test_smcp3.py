"""SMCP3: weights that are right whatever was chosen on the way, and pairs that do not undo each other."""

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
from bcppl.distributions.poses import NormalPose
from bcppl.errors import InputError
from bcppl.inference.filters import smcp3
from bcppl.inference.filters.smcp3 import Pair, move_and_weight
from bcppl.inference.importance import importance_sampling
from bcppl.inference.kernels.jacobian import Charted, Real, Tangent
from bcppl.inference.population import Population
from bcppl.inference.proposals import drift
from bcppl.inference.proposals.proposal import Fittable
from bcppl.poses import Freedom
from bcppl.traces import Trace, simulate
from tests.inference.filters.smcp3_programs import flat, nothing, silent
from tests.invariance import largest_z, number

DRAWS = 20_000
SOUND, BROKEN, WIDEST = 4.5, 8.0, 5.0


# ---- at a fixed target: exact draws stay properly weighted

CENTER = poses.as_pose([0.1, -0.2, 0.3, 0.5, 0.5, -0.5, 0.5])
CAMERA = torch.tensor([0.1, -0.2, 1.0], dtype=torch.float64)
SPREAD = torch.tensor([0.2, 0.1, 0.3, 0.7, 0.6, 0.8], dtype=torch.float64)
PLANAR = Freedom("xy", "z")


def vector() -> None:
    pyro.sample("x", dist.Normal(number(0.5), torch.tensor([1.0, 1.5]).double()).to_event(1))


def which() -> None:
    kind = pyro.sample("kind", dist.Bernoulli(number(0.3)))
    pyro.sample("size", dist.LogNormal(torch.where(kind == 1, number(0.7), number(0.0)), 0.5))


def standing() -> None:
    pyro.sample("pose", NormalPose(CENTER, SPREAD))


def sliding() -> None:
    pyro.sample("pose", NormalPose(CENTER, torch.tensor([0.3, 0.2, 0.8]).double(), PLANAR))


def mix(trace: Trace) -> Any:
    """The old value and noise mixed into the new one, and into what is left over."""
    x = trace["x"]
    noise = pyro.sample("noise", dist.Normal(0.3 * x, 0.8).to_event(1))
    return {"x": 0.7 * x + 0.6 * noise + 0.1}, {"left over": 0.9 * noise - 0.3 * x}


def unmix(trace: Trace) -> Any:
    x = trace["x"] - 0.1
    rest = pyro.sample("left over", dist.Normal(0.25 * x, 0.8).to_event(1))
    volume = 0.7 * 0.9 + 0.6 * 0.3
    return {"x": (0.9 * x - 0.6 * rest) / volume}, {"noise": (0.3 * x + 0.7 * rest) / volume}


def switch(trace: Trace) -> Any:
    """A discrete value turned over, or not, by chance; the size follows, and a little more."""
    kind, size = trace["kind"], trace["size"]
    change = pyro.sample("change", dist.Bernoulli(torch.where(kind == 1, number(0.7), number(0.3))))
    factor = pyro.sample("factor", dist.LogNormal(number(0.35), 0.2))
    new = torch.where(change == 1, 1 - kind, kind)
    grown = size * factor * torch.exp(0.7 * (new - kind))
    return {"kind": new, "size": grown}, {"changed": change, "divisor": factor}


def switch_back(trace: Trace) -> Any:
    kind, size = trace["kind"], trace["size"]
    change = pyro.sample("changed", dist.Bernoulli(torch.where(kind == 1, number(0.6), number(0.4))))
    factor = pyro.sample("divisor", dist.LogNormal(number(0.3), 0.25))
    old = torch.where(change == 1, 1 - kind, kind)
    return {"kind": old, "size": size / factor * torch.exp(0.7 * (old - kind))}, {
        "change": change,
        "factor": factor,
    }


def scaled(pose: Tensor, log_factor: Tensor) -> Tensor:
    return torch.cat([CAMERA + (pose[:, :3] - CAMERA) * torch.exp(log_factor)[:, None], pose[:, 3:]], dim=1)


def farther(trace: Trace) -> Any:
    """Along the line of sight, and turned on about the part's own origin."""
    u = pyro.sample("u", dist.Normal(number(0.08), 0.1))
    w = pyro.sample("w", dist.Normal(torch.zeros(3).double(), 0.1).to_event(1))
    pose = poses.compose(scaled(trace["pose"], u), poses.retract(poses.identity(len(u)), lifted(w)))
    return {"pose": pose}, {"v": u, "w": w}


def nearer(trace: Trace) -> Any:
    v = pyro.sample("v", dist.Normal(number(0.06), 0.12))
    w = pyro.sample("w", dist.Normal(torch.zeros(3).double(), 0.12).to_event(1))
    back = poses.compose(trace["pose"], poses.retract(poses.identity(len(v)), lifted(-w)))
    return {"pose": scaled(back, -v)}, {"u": v, "w": w}


def lifted(rotation: Tensor) -> Tensor:
    return torch.cat([torch.zeros_like(rotation), rotation], dim=1)


def further(pose: Tensor, amount: Tensor) -> Tensor:
    """The rotation away from the centre turned on, (0, pi) onto itself: Haar measure is not kept."""
    tangent = poses.local(CENTER, pose)
    angle = tangent[:, 3:].norm(dim=-1)
    share = torch.sigmoid(torch.logit(angle / math.pi) + amount)
    turned = tangent[:, 3:] * (math.pi * share / angle)[:, None]
    return poses.retract(CENTER, torch.cat([tangent[:, :3], turned], dim=1))


def turn_on(trace: Trace) -> Any:
    u = pyro.sample("u", dist.Normal(number(0.2), 0.1))
    return {"pose": further(trace["pose"], u)}, {"v": u}


def turn_off(trace: Trace) -> Any:
    v = pyro.sample("v", dist.Normal(number(0.17), 0.12))
    return {"pose": further(trace["pose"], -v)}, {"u": v}


def spread_out(trace: Trace) -> Any:
    u = pyro.sample("u", dist.Normal(number(0.2), 0.1))
    return {"pose": plane_scaled(trace["pose"], u)}, {"v": u}


def draw_in(trace: Trace) -> Any:
    v = pyro.sample("v", dist.Normal(number(0.17), 0.12))
    return {"pose": plane_scaled(trace["pose"], -v)}, {"u": v}


def plane_scaled(pose: Tensor, log_factor: Tensor) -> Tensor:
    moved_xy = CAMERA[:2] + (pose[:, :2] - CAMERA[:2]) * torch.exp(log_factor)[:, None]
    return torch.cat([moved_xy, pose[:, 2:]], dim=1)


def leaning(trace: Trace) -> None:
    """Returns nothing: read as a proposal of Metropolis-Hastings."""
    strong = pyro.sample("strong", dist.Bernoulli(number(0.3)))
    pyro.sample("x", dist.Normal(0.8 * trace["x"] + 0.2 * strong[:, None], 0.9).to_event(1))


def of_pose(trace: Trace) -> Tensor:
    tangent = poses.local(CENTER, trace["pose"])
    return torch.cat([tangent, tangent**2, tangent[:, 3:].norm(dim=-1, keepdim=True)], dim=1)


def of_vector(trace: Trace) -> Tensor:
    return torch.cat([trace["x"], trace["x"] ** 2, trace["x"].prod(-1, keepdim=True)], dim=1)


def of_kind(trace: Trace) -> Tensor:
    kind, size = trace["kind"], trace["size"]
    return torch.stack([kind, size, torch.log(size), kind * size], dim=1)


CASES: dict[str, tuple[Callable[[], None], Pair, Callable[[Trace], Tensor]]] = {
    "mixed with noise": (vector, Pair(mix, unmix, check=True), of_vector),
    "discrete": (which, Pair(switch, switch_back, check=True), of_kind),
    "line of sight": (standing, Pair(farther, nearer, check=True), of_pose),
    "turned on": (standing, Pair(turn_on, turn_off, check=True), of_pose),
    "in the plane": (sliding, Pair(spread_out, draw_in, check=True), of_pose),
    "nothing returned": (vector, Pair(leaning, leaning, check=True), of_vector),
    "drift": (sliding, Pair(drift("pose", (0.2, 0.4)), drift("pose", (0.2, 0.4))), of_pose),
}


def worst_z(case: str) -> float:
    """The largest |z| of E[w f(new)] - E[f(old)], the function 1 among them, over exact draws."""
    program, pair, functions = CASES[case]
    torch.manual_seed(1)
    trace = simulate(program, (), DRAWS)
    population = move_and_weight(Population(trace), pair)
    weights = torch.exp(population.log_weights)[:, None]
    one = torch.ones(DRAWS, 1, dtype=torch.float64)
    before = torch.cat([one, functions(trace)], dim=1)
    after = weights * torch.cat([one, functions(population.trace)], dim=1)
    assert not torch.equal(functions(trace), functions(population.trace))
    # Weights that spread so far have no mean that could be compared: that is no proper weighting either.
    return largest_z(before, after) if float(weights.std()) < WIDEST * float(weights.mean()) else math.inf


@pytest.mark.parametrize("case", CASES)
def test_exact_draws_stay_properly_weighted(case: str) -> None:
    assert worst_z(case) < SOUND


MUTANTS = [
    (case, name, mutant)
    for name, mutant in (("log_abs_det_jacobian", flat), ("assessed", silent))
    for case in CASES
    if name == "assessed" or case not in ("nothing returned", "drift")
]


@pytest.mark.long
@pytest.mark.parametrize(("case", "name", "mutant"), MUTANTS)
def test_mutants_that_forget_a_volume_or_the_way_back(
    case: str, name: str, mutant: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(smcp3, name, mutant)
    assert worst_z(case) > BROKEN


class SevenNumbers(Real):
    """The numbers of a pose but the last: the map of all seven is singular."""

    def at(self, value: Tensor, tangent: Tensor) -> Tensor:
        return super().at(value, torch.nn.functional.pad(tangent, (0, 1)))

    def read(self, value: Tensor) -> Tensor:
        return super().read(value)[:, :6]

    def apart(self, first: Tensor, second: Tensor) -> Tensor:
        return Tangent(6).apart(first, second)


def test_mutant_with_the_volume_of_the_seven_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    real = smcp3.charted

    def seven(*args: Any) -> Any:
        found = real(*args)
        return {
            k: Charted(v, SevenNumbers(6) if isinstance(c, Tangent) else c) for k, (v, c) in found.items()
        }

    monkeypatch.setattr(smcp3, "charted", seven)
    with pytest.raises(InputError, match="have to cancel"):
        worst_z("turned on")
    monkeypatch.setattr(smcp3, "refuse_unequal", lambda *given: None)
    assert worst_z("turned on") > BROKEN


# ---- pairs that do not undo each other


def test_pairs_that_are_refused_name_the_address() -> None:
    torch.manual_seed(0)
    population = Population(simulate(vector, (), 7))

    def refused(match: str, forward: Any, backward: Any, check: bool = True) -> None:
        with pytest.raises(InputError, match=match) as caught:
            move_and_weight(population, Pair(forward, backward, check))
        assert "\n" not in str(caught.value)

    def shift(trace: Trace) -> Any:
        step = pyro.sample("step", dist.Normal(torch.zeros(2).double(), 1.0).to_event(1))
        return {"x": trace["x"] + step}, {"step": step}

    def wrong(trace: Trace) -> Any:
        step = pyro.sample("step", dist.Normal(torch.zeros(2).double(), 1.0).to_event(1))
        return {"x": trace["x"] + step}, {"step": step}

    def elsewhere(trace: Trace) -> Any:
        values, choices = unshift(trace)
        return values, {"stride": choices["step"]}

    def unshift(trace: Trace) -> Any:
        step = pyro.sample("step", dist.Normal(torch.zeros(2).double(), 1.0).to_event(1))
        return {"x": trace["x"] - step}, {"step": step}

    def mixing(trace: Trace) -> Any:
        values, choices = shift(trace)
        return {"x": values["x"] + trace["x"].mean(0)}, choices

    move_and_weight(population, Pair(shift, unshift, check=True))
    move_and_weight(population, Pair(shift, wrong))
    refused(r"backward program does not give 'x' \(old value\) back: particle 0", shift, wrong)
    refused(r"leaves out the forward choice 'step'", shift, elsewhere)
    refused(r"'step'.*for every choice", lambda t: ({"x": shift(t)[0]["x"]}, {}), unshift)
    refused(
        r"'step' \(forward choice, 2\) to 'x' \(new value, 2\), so it takes 2 coordinates",
        lambda t: (shift(t)[0], {}),
        nothing,
        check=False,
    )
    refused(r"'y'.*no latent address; latent are x", lambda t: ({"y": shift(t)[0]["x"]}, {}), nothing)
    refused(r"returns a dict that is no pair of mappings", lambda t: shift(t)[0], nothing)
    refused(r"shape \(7,\)", lambda t: ({"x": shift(t)[0]["x"][:, 0]}, {}), nothing)
    refused(
        r"mixes particles",
        mixing,
        unshift,
    )


def test_one_particle_is_moved_by_a_program_that_has_not_seen_it() -> None:
    """Where no other is apart, programs learn from draws of the model's."""
    seen: list[Tensor] = []

    def learning(population: Population) -> Callable[[Trace], None]:
        seen.append(population["x"].clone())
        return lambda trace: pyro.sample("x", dist.Normal(number(0.0), 1.0)) and None

    one = importance_sampling(normal, (), {}, 1)
    pair = Pair(Fittable(learning), Fittable(learning))
    move_and_weight(one, pair)
    assert len(seen) == 2 and not any(bool((each == one["x"]).any()) for each in seen)


def normal() -> None:
    pyro.sample("x", dist.Normal(number(0.0), 1.0))
