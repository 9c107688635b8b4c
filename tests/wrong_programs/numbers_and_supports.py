"""Programs with wrong numbers, supports, densities and gradients."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, ClassVar

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor
from torch.distributions import constraints
from torch.distributions.transforms import Transform

from bcppl.traces import Fault
from tests.invariance import number
from tests.small_programs import normal_log
from tests.wrong_programs.catalogue import WRONG, Reads, Wrong, normal, wrong

# ---- numbers and supports


class Bounded(Reads):
    log_prob_bound = -2.0


@wrong(Fault.BOUND)
def too_low_a_bound() -> None:
    pyro.sample("y", Bounded(normal("x"), lambda: 0.0))


@wrong(Fault.NOT_A_NUMBER)
def negative_scale() -> None:
    normal("y", normal("x"), normal("scale", 2.0, 1.0))


@wrong(Fault.NOT_A_NUMBER)
def root_of_a_normal() -> None:
    normal("y", normal("x").sqrt())


class Custom(dist.TorchDistribution):
    """A distribution of one number, as users write them: subclasses sample and give densities."""

    arg_constraints: ClassVar[dict[str, Any]] = {}
    support = constraints.real

    def __init__(self, shape: Any = ()) -> None:
        super().__init__(torch.Size(shape), validate_args=False)

    def expand(self, batch_shape: Any, _instance: Any = None) -> Any:
        return type(self)(batch_shape)

    def uniform(self, sample_shape: Any) -> Tensor:
        return torch.rand(torch.Size(sample_shape) + self.batch_shape, dtype=torch.float64)


class DeclaredReal(Custom):
    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        return -self.uniform(sample_shape).log()

    def log_prob(self, value: Tensor) -> Tensor:
        return torch.where(value > 0.0, -value, -torch.inf)


class NoNumberBelowZero(DeclaredReal):
    def log_prob(self, value: Tensor) -> Tensor:
        return -value + 0.0 * value.log()


class DrawsOutside(Custom):
    support = constraints.unit_interval

    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        return 1.2 * self.uniform(sample_shape)

    def log_prob(self, value: Tensor) -> Tensor:
        return torch.zeros_like(value)


class UnitVector(Custom):
    def __init__(self, shape: Any = ()) -> None:
        dist.TorchDistribution.__init__(self, torch.Size(shape), torch.Size([3]), validate_args=False)

    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        shape = (*sample_shape, *self.batch_shape, 3)
        return torch.nn.functional.normalize(torch.randn(shape, dtype=torch.float64), dim=-1)

    def log_prob(self, value: Tensor) -> Tensor:
        return torch.full(value.shape[:-1], -math.log(4.0 * math.pi), dtype=torch.float64)


class Truncated(Custom):
    support = constraints.interval(-1.0, 1.0)

    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        low, high = torch.special.ndtr(torch.tensor([-1.0, 1.0], dtype=torch.float64))
        return torch.special.ndtri(low + (high - low) * self.uniform(sample_shape))

    def log_prob(self, value: Tensor) -> Tensor:
        return normal_log(value, 0.0, 1.0)


class WithoutConstant(Custom):
    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        return torch.randn(torch.Size(sample_shape) + self.batch_shape, dtype=torch.float64)

    def log_prob(self, value: Tensor) -> Tensor:
        return -0.5 * value.square()


class VarianceForScale(WithoutConstant):
    def log_prob(self, value: Tensor) -> Tensor:
        return normal_log(value, 0.0, 2.0)

    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        return math.sqrt(2.0) * super().sample(sample_shape)


class TenPercentTooWide(WithoutConstant):
    def log_prob(self, value: Tensor) -> Tensor:
        return normal_log(value, 0.0, 1.1)


class OneDrawForAll(WithoutConstant):
    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        return torch.randn(1, dtype=torch.float64).expand(torch.Size(sample_shape) + self.batch_shape).clone()

    def log_prob(self, value: Tensor) -> Tensor:
        return normal_log(value, 0.0, 1.0)


class Dice(Custom):
    support = constraints.integer_interval(0, 5)

    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        return (6 * self.uniform(sample_shape)).floor().long()

    def log_prob(self, value: Tensor) -> Tensor:
        return torch.where(value == 5, 0.25, 0.15).double().log()


class WithoutJacobian(Transform):
    domain, codomain, bijective = constraints.real, constraints.positive, True

    def _call(self, x: Tensor) -> Tensor:
        return x.exp()

    def _inverse(self, y: Tensor) -> Tensor:
        return y.log()

    def log_abs_det_jacobian(self, x: Tensor, y: Tensor) -> Tensor:
        return torch.zeros_like(x)


def without_jacobian() -> Any:
    return dist.TransformedDistribution(dist.Normal(number(0.0), 1.0), [WithoutJacobian()])


def custom(fault: Fault, make: Callable[[], Any]) -> None:
    def program() -> None:
        x = pyro.sample("x", make())
        normal("y", x[..., 0] if x.ndim > 1 else x)

    WRONG[make.__name__] = Wrong(fault, "x", program)


class SeedsItself(VarianceForScale):
    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        generator = torch.Generator().manual_seed(0)
        return torch.randn(torch.Size(sample_shape) + self.batch_shape, generator=generator).double()


custom(Fault.RANDOMNESS, SeedsItself)
for make in (DeclaredReal, NoNumberBelowZero, DrawsOutside, UnitVector):
    custom(Fault.SUPPORT, make)
for make in (
    WithoutConstant,
    VarianceForScale,
    TenPercentTooWide,
    Truncated,
    OneDrawForAll,
    Dice,
    without_jacobian,
):
    custom(Fault.DENSITY, make)


# ---- gradients


@wrong(Fault.GRADIENT)
def detached() -> None:
    x = normal("x")
    normal("y", x + x.detach().square())


@wrong(Fault.GRADIENT)
def detached_scale() -> None:
    x = normal("x")
    normal("y", x, x.detach().exp())


@wrong(Fault.GRADIENT)
def detached_altogether() -> None:
    x = normal("x")
    normal("y", torch.tensor(x.detach().numpy()))


@wrong(Fault.GRADIENT)
def listed() -> None:
    x = normal("x")
    normal("y", torch.tensor(x.tolist(), dtype=torch.float64))


@wrong(Fault.GRADIENT)
def detached_from_one_of_two() -> None:
    x, z = normal("x"), normal("z")
    normal("y", x.detach().sin() + z)
