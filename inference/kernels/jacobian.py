"""The Jacobian of a map between values of addresses, log|det J|, by autograd.

Every address has coordinates, those of the base measure of its density: a real value its entries, a point of
a simplex all entries but the last, a pose its free axes in the tangent space (translation in the frame the
pose maps to, rotation in the frame it maps from), a discrete value none. Never the seven numbers of a pose:
its density is with respect to Lebesgue x Haar (`bcppl.poses`), and Haar measure is that of the tangent space
up to a constant, the same at every rotation.

Cusumano-Towner, Lew and Mansinghka, Automating involutive MCMC using probabilistic and differentiable
programming, 2020: an output that is an input takes its row and its column out of the determinant; only the
rest is differentiated.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from bcppl import poses
from bcppl.distributions.support import freedom_of, support_of
from bcppl.errors import InferenceError, InputError
from bcppl.poses import Freedom, quaternions


@dataclass(frozen=True)
class Chart:
    """Coordinates of a value about itself; the base class is that of a discrete value, which has none."""

    dimension: int = 0

    def at(self, value: Tensor, tangent: Tensor) -> Tensor:
        """A value (N, *event) moved by a tangent (N, dimension): exact to first order, at 0 the value."""
        return value

    def read(self, value: Tensor) -> Tensor:
        """Coordinates (N, dimension) that change as those about the value do, to first order."""
        return value.new_zeros(len(value), 0, dtype=torch.float64)

    def apart(self, first: Tensor, second: Tensor) -> Tensor:
        """How far two values lie apart, (N,)."""
        return (first != second).reshape(len(first), -1).any(dim=1).to(torch.float64)


@dataclass(frozen=True)
class Real(Chart):
    """The entries of a real value."""

    def at(self, value: Tensor, tangent: Tensor) -> Tensor:  # noqa: D102
        return value + tangent.reshape(value.shape).to(value.dtype)

    def read(self, value: Tensor) -> Tensor:  # noqa: D102
        return value.reshape(len(value), -1).to(torch.float64)

    def apart(self, first: Tensor, second: Tensor) -> Tensor:  # noqa: D102
        gap = (first - second).abs() / (1.0 + first.abs())
        return gap.reshape(len(first), -1).amax(dim=1).to(torch.float64)


@dataclass(frozen=True)
class Simplex(Real):
    """All entries but the last of a vector that sums to 1."""

    def at(self, value: Tensor, tangent: Tensor) -> Tensor:  # noqa: D102
        step = tangent.reshape(*value.shape[:-1], value.shape[-1] - 1).to(value.dtype)
        return value + torch.cat([step, -step.sum(dim=-1, keepdim=True)], dim=-1)

    def read(self, value: Tensor) -> Tensor:  # noqa: D102
        return value[..., :-1].reshape(len(value), -1).to(torch.float64)


@dataclass(frozen=True)
class Tangent(Chart):
    """The free axes of a pose."""

    freedom: Freedom = poses.FREE

    def at(self, value: Tensor, tangent: Tensor) -> Tensor:  # noqa: D102
        whole = self.freedom.embed(tangent.reshape(*value.shape[:-1], self.freedom.dimension))
        half = 0.5 * whole[..., 3:]
        # The exponential map has the derivative of q (1, w / 2) at 0, and its gradient is no number there.
        turn = torch.cat([half, torch.ones_like(half[..., :1])], dim=-1)
        turned = quaternions.product(poses.quaternion_xyzw(value), turn)
        return poses.from_translation_quaternion_xyzw(value[..., :3] + whole[..., :3], turned)

    def read(self, value: Tensor) -> Tensor:  # noqa: D102
        quaternion = poses.quaternion_xyzw(value)
        about = quaternion.detach()
        turn = quaternions.product(quaternions.conjugate(about), quaternion)[..., :3]
        turn = 2.0 * turn / (about**2).sum(dim=-1, keepdim=True)
        tangent = torch.cat([value[..., :3], turn], dim=-1)
        return self.freedom.coordinates(tangent).reshape(len(value), -1)

    def apart(self, first: Tensor, second: Tensor) -> Tensor:  # noqa: D102
        return poses.local(first, second).abs().reshape(len(first), -1).amax(dim=1)


@dataclass(frozen=True)
class Uncharted(Chart):
    """Values on a surface whose volume is not computed here: they may be handed on, and nothing else."""

    surface: str = ""


# A density over these is not one over their entries.
_UNCHARTED = (
    "CorrCholesky",
    "CorrMatrix",
    "LowerCholesky",
    "LowerTriangular",
    "PositiveDefinite",
    "PositiveSemidefinite",
    "Square",
    "Symmetric",
    "Sphere",
)


def chart_of(address: str, distribution: Any, value: Tensor) -> Chart:
    """The coordinates of values (N, *event) of a site."""
    freedom = freedom_of(distribution)
    if freedom is not None:
        return Tangent(math.prod(value.shape[1:-1]) * freedom.dimension, freedom)
    support = support_of(distribution)
    if support.is_discrete or not value.is_floating_point():
        return Chart()
    name = type(support).__name__.strip("_")
    if name in _UNCHARTED:
        return Uncharted(math.prod(value.shape[1:]), name)
    if name == "Simplex":
        return Simplex(math.prod(value.shape[1:-1]) * (value.shape[-1] - 1))
    return Real(math.prod(value.shape[1:]))


class Charted(NamedTuple):
    """A value (N, *event) with its coordinates."""

    value: Tensor
    chart: Chart


# What kind of value it is ("latent", "choice", ...) and its address.
Key = tuple[str, str]
Point = Mapping[Key, Charted]


def charted(kind: str, values: Mapping[str, Tensor], distributions: Mapping[str, Any]) -> dict[Key, Charted]:
    """Values by address with the coordinates of their distributions."""
    return {(kind, a): Charted(v, chart_of(a, distributions[a], v)) for a, v in values.items()}


def log_abs_det_jacobian(
    again: Callable[[dict[Key, Tensor]], Mapping[Key, Tensor]],
    inputs: Point,
    outputs: Point,
    *,
    check: bool = False,
) -> Tensor:
    """Log of the absolute Jacobian determinant of a map, for every particle.

    Args:
        again: the map; called once more, with inputs that ask for gradients. Its outputs for a particle
            depend on that particle alone.
        inputs: where it is evaluated.
        outputs: its outputs there. An output that is the very tensor of an input is not differentiated.
        check: also check that particles are not mixed.

    Returns:
        (N,) float64; -inf for a particle where the map is not one-to-one. InputError where it has none: the
        map gives more coordinates than it takes or fewer, or uses values on a surface (a sphere, matrices).
    """
    columns, rows = _remaining(inputs, outputs)
    for key in (*columns, *rows):
        chart = (inputs if key in columns else outputs)[key].chart
        if isinstance(chart, Uncharted):
            raise InputError(
                f"a map uses {key[1]!r} ({key[0]}), whose values in {chart.surface} have a volume that is "
                "not computed here; hand them on as they are, or sample and move unconstrained values."
            )
    wide = sum(inputs[k].chart.dimension for k in columns)
    high = sum(outputs[k].chart.dimension for k in rows)
    if wide != high:
        more = "gives" if high > wide else "takes"
        raise InputError(
            f"a map takes {_listed(inputs, columns)} to {_listed(outputs, rows)}, so it {more} "
            f"{abs(high - wide)} coordinates too many; what goes in has to come out."
        )
    value = next(iter((*inputs.values(), *outputs.values()))).value
    if not rows:
        return value.new_zeros(len(value), dtype=torch.float64)
    leaves = [
        value.new_zeros(len(value), inputs[k].chart.dimension, dtype=torch.float64).requires_grad_()
        for k in columns
    ]
    with torch.enable_grad():
        lifted = {
            k: inputs[k].chart.at(inputs[k].value, leaf) for k, leaf in zip(columns, leaves, strict=True)
        }
        reached = again({**{k: v.value for k, v in inputs.items()}, **lifted})
        for kind, address in rows:
            if not reached[kind, address].requires_grad:
                raise InputError(
                    f"a map gives a value of {address!r} ({kind}) from which no gradient leads back, except "
                    "to what it also hands on as it is; compute it in torch, without `.detach()`, from "
                    "something that is not used up."
                )
        read = torch.cat([outputs[k].chart.read(reached[k]) for k in rows], dim=1)
        if check:
            _refuse_mixing(read, leaves)
        # One output each, of all particles: (high, N, high), the rows of the Jacobians first.
        each = torch.eye(high, dtype=torch.float64)[:, None].expand(high, *read.shape)
        jacobian = _gradient(read, leaves, each)
    finite = torch.isfinite(jacobian.sum(dim=(0, 2)))  # a sum of finite derivatives is taken not to overflow
    if not bool(finite.all()):
        bad = (~finite).nonzero().flatten().tolist()
        raise InferenceError(
            f"the Jacobian from {_listed(inputs, columns)} to {_listed(outputs, rows)} is not finite for "
            f"{len(bad)} of {len(value)} particles (first: {', '.join(map(str, bad[:5]))})."
        )
    # An affine map has the same for all.
    if bool((jacobian == jacobian[:, :1]).all()):
        jacobian = jacobian[:, :1]
    log_determinant = torch.linalg.slogdet(jacobian.movedim(0, 1)).logabsdet.expand(len(value))
    if bool((log_determinant == -torch.inf).all()):
        raise InputError(
            f"a map from {_listed(inputs, columns)} to {_listed(outputs, rows)} is not one-to-one for any "
            "particle, so that it has no inverse."
        )
    return log_determinant


def refuse_leaving(address: str, chart: Chart, old: Tensor, new: Tensor) -> None:
    """Refuse a new pose that has moved along an axis that is held."""
    if not isinstance(chart, Tangent) or new is old:
        return
    # A held axis may stray by rounding.
    strayed = chart.freedom.off_axis(poses.local(old, new)).reshape(len(old), -1).amax(dim=1) > 1e-9
    if bool(strayed.any()):
        raise InputError(
            f"a map moves {address!r} along an axis that its prior holds fixed "
            f"(particle {int(strayed.nonzero()[0])}); free are translation {chart.freedom.translation!r} "
            f"and rotation {chart.freedom.rotation!r}."
        )


def refuse_apart(what: str, first: Point, second: Mapping[Key, Tensor]) -> None:
    """Refuse a move and its reverse that do not end where they began."""
    real = [value for value, _ in first.values() if value.is_floating_point()]
    limit = torch.tensor(1e-6, dtype=torch.float64)
    for value in real:
        # Rounding is of the largest value that takes part.
        size = 1.0 + value.detach().abs().reshape(len(value), -1).amax(dim=1).double()
        limit = torch.maximum(limit, (16.0 * torch.finfo(value.dtype).eps * size).clamp(max=0.5))
    for (kind, address), (value, chart) in first.items():
        apart = ~(chart.apart(value, second[kind, address]) <= limit)
        if bool(apart.any()):
            particle = int(apart.nonzero()[0])
            raise InputError(
                f"{what} does not give {address!r} ({kind}) back: particle {particle} began at "
                f"{_short(value[particle])} and came to {_short(second[kind, address][particle])}."
            )


def refuse_unequal(what: str, forward: Tensor, reverse: Tensor, moved: Point) -> None:
    """Refuse log-Jacobians (N,) of a move of some values and of its reverse that do not cancel."""
    digits = [torch.finfo(v.dtype).eps for v, _ in moved.values() if v.is_floating_point()]
    # A map that stretches by much loses as many digits of what it stretches.
    limit = (64.0 * max(digits, default=0.0) * forward.detach().abs().exp()).clamp(1e-6, 0.05)
    # Both infinite where a map is singular: their sum is no number, and is refused.
    wrong = ~((forward + reverse).abs() <= limit)
    if bool(wrong.any()):
        particle = int(wrong.nonzero()[0])
        raise InputError(
            f"the Jacobian of {what} is exp({float(forward[particle]):.6g}) forward and "
            f"exp({float(reverse[particle]):.6g}) in reverse for particle {particle}; they have to cancel, "
            "so compute all values in torch, without `.detach()`."
        )


def _remaining(inputs: Point, outputs: Point) -> tuple[list[Key], list[Key]]:
    """The inputs and the outputs that are left when those that are one tensor are taken away."""
    columns = {k: v for k, v in inputs.items()}
    rows = []
    for key, (value, chart) in outputs.items():
        same = next((k for k, v in columns.items() if v.value is value), None)
        if same is None:
            rows.append(key)
        elif columns.pop(same).chart != chart:
            raise InputError(
                f"a map takes {same[1]!r} ({same[0]}) to {key[1]!r} ({key[0]}), which has other coordinates; "
                "give both sites the same support, and poses the same free axes."
            )
    return [k for k in columns if columns[k].chart.dimension], [k for k in rows if outputs[k].chart.dimension]


def _gradient(read: Tensor, leaves: list[Tensor], each: Tensor) -> Tensor:
    """Derivatives (K, N, D) of K weighted sums of the coordinates read; the weights `each` are (K, N, D)."""
    gradients = torch.autograd.grad(
        read, leaves, each, retain_graph=True, allow_unused=True, is_grads_batched=True
    )
    pairs = zip(gradients, leaves, strict=True)
    return torch.cat([x.new_zeros(len(each), *x.shape) if g is None else g for g, x in pairs], dim=2)


def _refuse_mixing(read: Tensor, leaves: list[Tensor]) -> None:
    first = torch.zeros_like(read)[None]
    first[:, 0] = 1.0
    if bool((_gradient(read, leaves, first)[:, 1:] != 0).any()):
        raise InputError(
            "a map mixes particles: its output for one depends on the values of another; "
            "let it act on every particle alone."
        )


def _listed(point: Point, keys: list[Key]) -> str:
    return ", ".join(f"{a!r} ({kind}, {point[kind, a].chart.dimension})" for kind, a in keys) or "nothing"


def _short(value: Tensor) -> str:
    return str([float(f"{x:.6g}") for x in value.flatten().tolist()[:8]])
