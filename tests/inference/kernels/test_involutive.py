"""Involutive moves: invariance from exact draws, volumes in the right coordinates, maps that are refused."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from bcppl import poses
from bcppl.distributions.poses import NormalPose, UniformPose
from bcppl.errors import InputError
from bcppl.inference.kernels import involutions, involutive
from bcppl.inference.kernels.jacobian import Charted, Real, Simplex, Tangent, log_abs_det_jacobian
from bcppl.inference.kernels.kernel import Kernel
from bcppl.inference.population import Population
from bcppl.inference.targets import POSTERIOR
from bcppl.poses import FREE, Freedom
from bcppl.traces import Trace, simulate
from tests.invariance import largest_z, number

DRAWS = 10_000
SOUND, BROKEN = 4.5, 8.0

Values = Mapping[str, Tensor]


def of_vectors(x: Tensor) -> Tensor:
    products = (x[:, :, None] * x[:, None, :]).flatten(1)
    return torch.cat([x, products, torch.sin(2 * x), x.abs()], dim=1)


CENTER = poses.as_pose([0.1, -0.2, 0.3, 0.5, 0.5, -0.5, 0.5])
CAMERA = torch.tensor([0.1, -0.2, 1.0], dtype=torch.float64)  # where the camera stands
SPREAD = torch.tensor([0.2, 0.1, 0.3, 1.1, 0.9, 1.3], dtype=torch.float64)
PLANAR = Freedom("xy", "z")


# ---- programs with exact draws


def vector() -> None:
    pyro.sample("x", dist.Normal(number(1.0), torch.tensor([1.0, 2.0]).double()).to_event(1))


def two_rates() -> None:
    pyro.sample("a", dist.Gamma(number(2.0), 1.0))
    pyro.sample("b", dist.Gamma(number(3.0), 2.0))


def which() -> None:
    kind = pyro.sample("kind", dist.Bernoulli(number(0.3)))
    pyro.sample("size", dist.LogNormal(torch.where(kind == 1, number(1.0), number(0.0)), 0.5))


def shares() -> None:
    pyro.sample("p", dist.Dirichlet(torch.tensor([2.0, 3.0, 4.0]).double()))


def standing() -> None:
    pyro.sample("pose", NormalPose(CENTER, SPREAD))


def sliding() -> None:
    turn = torch.tensor([0.3, 0.2, 0.8], dtype=torch.float64)
    pyro.sample("pose", NormalPose(CENTER, turn, PLANAR))


# ---- programs of auxiliary choices, and involutions


def factor(trace: Trace) -> None:
    pyro.sample("log_factor", dist.Normal(number(0.2), 0.4))


def nothing(trace: Trace) -> None:
    pass


def scales(trace: Trace) -> None:
    """Depends on where the particle is, so that the reverse move has another density."""
    pyro.sample("scale", dist.Normal(0.3 * torch.tanh(trace["x"].sum(-1)), 0.5))


def stretch(values: Values, choices: Values) -> tuple[Values, Values]:
    u = choices["scale"]
    x = values["x"]
    center = torch.tensor([0.5, -0.5]).double()
    return {"x": center + (x - center) * torch.exp(u)[:, None]}, {"scale": -u}


def trade(values: Values, choices: Values) -> tuple[Values, Values]:
    """The two exchanged, one longer and the other shorter by a factor: volumes are kept."""
    u = choices["log_factor"]
    return (
        {"a": values["b"] * torch.exp(u), "b": values["a"] * torch.exp(-u)},
        {"log_factor": u},
    )


def scale_both(values: Values, choices: Values) -> tuple[Values, Values]:
    u = choices["log_factor"]
    return {"a": values["a"] * torch.exp(u), "b": values["b"] * torch.exp(u) ** 2}, {"log_factor": -u}


def flip_kind(values: Values, choices: Values) -> tuple[Values, Values]:
    """The discrete choice is turned over and the size follows."""
    kind, size = values["kind"], values["size"]
    return {"kind": 1 - kind, "size": torch.where(kind == 1, size / 2.5, size * 2.5)}, {}


def tilt(values: Values, choices: Values) -> tuple[Values, Values]:
    """Shares in proportion to p_k e^{u k}."""
    u, p = choices["log_factor"], values["p"]
    tilted = p * torch.exp(u[:, None] * torch.arange(3))
    return {"p": tilted / tilted.sum(-1, keepdim=True)}, {"log_factor": -u}


def nearer(values: Values, choices: Values) -> tuple[Values, Values]:
    """The part moved along its line of sight: the distance to the camera times a factor."""
    u, pose = choices["log_factor"], values["pose"]
    return {"pose": torch.cat([CAMERA + (pose[:, :3] - CAMERA) * torch.exp(u)[:, None], pose[:, 3:]], 1)}, {
        "log_factor": -u
    }


def nearer_in_the_plane(values: Values, choices: Values) -> tuple[Values, Values]:
    u, pose = choices["log_factor"], values["pose"]
    moved = CAMERA[:2] + (pose[:, :2] - CAMERA[:2]) * torch.exp(u)[:, None]
    return {"pose": torch.cat([moved, pose[:, 2:]], 1)}, {"log_factor": -u}


HALF_TURN = poses.as_pose([0.03, -0.02, 0.0, 0.0, 0.0, 0.0, 1.0])


def symmetry(values: Values, choices: Values) -> tuple[Values, Values]:
    """A half turn about an axis of the part that is not through its origin."""
    return {"pose": poses.compose(values["pose"], HALF_TURN)}, {}


def more_turned(values: Values, choices: Values) -> tuple[Values, Values]:
    """The rotation away from the centre turned on: in the tangent space at the centre a map of its angle."""
    u = choices["log_factor"]
    tangent = poses.local(CENTER, values["pose"])
    angle = tangent[:, 3:].norm(dim=-1)
    # A map of (0, pi) onto itself, undone by -u.
    share = torch.tanh(0.5 * (torch.logit(angle / math.pi) + u)) * 0.5 + 0.5
    turned = tangent[:, 3:] * (math.pi * share / angle)[:, None]
    return {"pose": poses.retract(CENTER, torch.cat([tangent[:, :3], turned], 1))}, {"log_factor": -u}


def of_pose(pose: Tensor) -> Tensor:
    tangent = poses.local(CENTER, pose)
    angle = tangent[:, 3:].norm(dim=-1, keepdim=True)
    return torch.cat([of_vectors(tangent), torch.cos(angle), angle], dim=1)


def of_rates(trace: Trace) -> Tensor:
    return of_vectors(torch.stack([trace["a"], trace["b"]], 1))


CASES: dict[str, tuple[Any, Any, Any, Any]] = {
    "stretched about a point": (vector, scales, stretch, lambda t: of_vectors(t["x"])),
    "scaled unevenly": (two_rates, factor, scale_both, of_rates),
    "exchanged": (two_rates, factor, trade, of_rates),
    "discrete": (which, nothing, flip_kind, lambda t: of_vectors(torch.stack([t["kind"], t["size"]], 1))),
    "simplex": (shares, factor, tilt, lambda t: of_vectors(t["p"][:, :2])),
    "distance to the camera": (standing, factor, nearer, lambda t: of_pose(t["pose"])),
    "distance in the plane": (sliding, factor, nearer_in_the_plane, lambda t: of_pose(t["pose"])),
    "symmetry": (standing, nothing, symmetry, lambda t: of_pose(t["pose"])),
    "turned on": (standing, factor, more_turned, lambda t: of_pose(t["pose"])),
}
STRETCHING = [k for k in CASES if k not in ("symmetry", "exchanged")]


def worst_z(program: Any, kernel: Kernel, functions: Any, target: Any = POSTERIOR, times: int = 2) -> float:
    """The largest |z| of the change in expectations from exact draws, each draw compared with itself."""
    torch.manual_seed(1)
    trace = simulate(program, (), DRAWS)
    move = kernel(Population(trace[:100]))
    before = functions(trace)
    for _ in range(times):
        trace, accepted = move(trace, target)
        assert 0.05 < float(accepted.mean()) <= 1.0
    return largest_z(before, functions(trace))


@pytest.mark.parametrize("case", CASES)
def test_involutions_leave_the_target_invariant(case: str) -> None:
    program, auxiliary, involution, functions = CASES[case]
    assert worst_z(program, involutive(auxiliary, involution, check=True), functions) < SOUND


@pytest.mark.parametrize("case", STRETCHING)
def test_mutant_that_drops_the_jacobian(case: str, monkeypatch: pytest.MonkeyPatch) -> None:
    program, auxiliary, involution, functions = CASES[case]
    monkeypatch.setattr(
        involutions, "log_abs_det_jacobian", lambda *_, **__: torch.zeros(DRAWS, dtype=torch.float64)
    )
    assert worst_z(program, involutive(auxiliary, involution), functions) > BROKEN


@pytest.mark.parametrize("case", ["stretched about a point", "distance to the camera"])
def test_mutant_with_the_sign_of_the_jacobian_flipped(case: str, monkeypatch: pytest.MonkeyPatch) -> None:
    program, auxiliary, involution, functions = CASES[case]
    monkeypatch.setattr(involutions, "log_abs_det_jacobian", lambda *a, **k: -log_abs_det_jacobian(*a, **k))
    assert worst_z(program, involutive(auxiliary, involution), functions) > BROKEN


def test_mutant_that_forgets_the_way_back(monkeypatch: pytest.MonkeyPatch) -> None:
    program, auxiliary, involution, functions = CASES["stretched about a point"]
    monkeypatch.setattr(
        involutions, "assess", lambda program, args, choices, n: torch.zeros(n, dtype=torch.float64)
    )
    assert worst_z(program, involutive(auxiliary, involution), functions) > BROKEN


class SevenNumbers(Real):
    """Mutant: the volume is that of the numbers of a pose, all but the last: their own map is singular."""

    def at(self, value: Tensor, tangent: Tensor) -> Tensor:
        return super().at(value, torch.nn.functional.pad(tangent, (0, 1)))

    def read(self, value: Tensor) -> Tensor:
        return super().read(value)[:, :6]


def test_mutant_with_the_volume_of_the_seven_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    program, auxiliary, involution, functions = CASES["turned on"]
    real = involutions.charted

    def seven(kind: str, values: Any, distributions: Any) -> Any:
        found = real(kind, values, distributions)
        return {
            k: Charted(v, SevenNumbers(6) if isinstance(c, Tangent) else c) for k, (v, c) in found.items()
        }

    monkeypatch.setattr(involutions, "charted", seven)
    assert worst_z(program, involutive(auxiliary, involution), functions) > BROKEN


# ---- volumes by hand


def determinant(chart: Any, value: Tensor, function: Any) -> Tensor:
    key = ("latent", "x")
    return log_abs_det_jacobian(
        lambda point: {key: function(point[key])},
        {key: Charted(value, chart)},
        {key: Charted(function(value), chart)},
    )


def test_volumes_are_those_of_the_base_measure() -> None:
    torch.manual_seed(0)
    pose = UniformPose(CENTER, 0.2, math.pi).sample((50,))
    six = Tangent(6, FREE)
    other = poses.as_pose([0.4, 0.1, -0.2, 0.1, 0.7, 0.7, -0.1])
    other = other / torch.cat([torch.ones(3), other[3:].norm().expand(4)])
    zero = torch.zeros(50, dtype=torch.float64)
    # Haar measure is that of the group: composing and inverting keep it at every rotation.
    edge = poses.identity(50)
    for place in (pose, edge):
        for function in (
            lambda x: poses.compose(x, other),
            lambda x: poses.compose(other, x),
            poses.inverse,
            lambda x: poses.retract(x, torch.full((6,), 0.3, dtype=torch.float64)),
            lambda x: torch.cat([x[:, :3], -x[:, 3:]], dim=1),
        ):
            torch.testing.assert_close(determinant(six, place, function), zero, atol=1e-9, rtol=0)
    # Three translations stretched by 2, and the rotation vector by 2: with the density of Haar measure.
    far = UniformPose(CENTER, 0.2, 1.5).sample((50,))
    doubled = determinant(six, far, lambda x: poses.retract(CENTER, 2 * poses.local(CENTER, x)))
    angle = poses.local(CENTER, far)[:, 3:].norm(dim=-1)
    haar = FREE.log_base_density
    torch.testing.assert_close(doubled, 6 * math.log(2.0) + haar(2 * angle) - haar(angle))
    flat = Tangent(3, PLANAR)
    slid = NormalPose(CENTER, torch.tensor([0.3, 0.2, 0.5]), PLANAR).sample((50,))
    doubled = determinant(flat, slid, lambda x: poses.retract(CENTER, 2 * poses.local(CENTER, x)))
    torch.testing.assert_close(doubled, zero + 3 * math.log(2.0))
    # Shares: p -> p^2 / sum p^2 has, in the first two, a determinant that sympy gives as 4 p1 p2 p3 / S^3.
    p = dist.Dirichlet(torch.ones(3).double()).sample((50,))
    squared = determinant(Simplex(2), p, lambda p: p**2 / (p**2).sum(-1, keepdim=True))
    torch.testing.assert_close(squared, torch.log(4 * p.prod(-1) / (p**2).sum(-1) ** 3))


def test_maps_that_are_refused_name_the_address() -> None:
    def once(program: Any, auxiliary: Any, involution: Any, check: bool = False) -> None:
        torch.manual_seed(0)
        trace = simulate(program, (), 6)
        involutive(auxiliary, involution, check=check)(Population(trace))(trace, POSTERIOR)

    def refused(match: str, *args: Any, **kwargs: Any) -> None:
        with pytest.raises(InputError, match=match) as caught:
            once(*args, **kwargs)
        assert "\n" not in str(caught.value)

    grown = lambda v, a: ({"a": v["a"] * torch.exp(a["log_factor"])}, {})  # noqa: E731
    refused(r"applied twice.*'a' \(latent\) back: particle 0", two_rates, factor, grown, check=True)
    once(two_rates, factor, grown)
    refused(
        r"'c'.*too many.*a, b",
        two_rates,
        factor,
        lambda v, a: ({"c": v["a"], "a": 2 * v["a"]}, {"log_factor": v["b"]}),
    )
    refused(
        r"'a' \(latent\) from which no gradient leads back",
        two_rates,
        factor,
        lambda v, a: ({"a": 2 * v["a"], "b": 3 * v["b"]}, {"log_factor": v["a"]}),
    )
    refused(
        r"'a' \(latent\) from which no gradient leads back",
        two_rates,
        factor,
        lambda v, a: ({"a": 2 * v["a"].detach()}, {}),
    )
    refused(
        r"'a' \(latent, 1\), 'b'.* is not one-to-one for any particle",
        two_rates,
        nothing,
        lambda v, a: ({"a": v["a"] + v["b"], "b": (v["a"] + v["b"]) * 2}, {}),
    )
    refused(r"no new value.*a, b", two_rates, factor, lambda v, a: (v, {"log_factor": -a["log_factor"]}))
    refused(r"shape \(1,\)", two_rates, factor, lambda v, a: ({"a": v["a"][:1]}, {}))
    refused(
        r"mixes particles",
        two_rates,
        nothing,
        lambda v, a: ({"a": v["a"].mean() * 2 - v["a"]}, {}),
        check=True,
    )
    refused(r"moves 'pose' along an axis .* free are translation 'xy'", sliding, factor, nearer)
    refused(r"other coordinates", which, nothing, lambda v, a: ({"kind": v["size"], "size": v["kind"]}, {}))

    def matrix() -> None:
        pyro.sample("L", dist.LKJCholesky(3, number(1.0)))

    refused(
        r"'L' .latent., whose values in CorrCholesky", matrix, nothing, lambda v, a: ({"L": 1 * v["L"]}, {})
    )
