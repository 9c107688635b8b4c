"""Programs that are wrong, each with the kind of mistake and the site where it shows."""

from __future__ import annotations

import math
import random
import time
from collections.abc import Callable, Mapping
from contextvars import ContextVar
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, ClassVar

import numpy as np
import pyro
import pyro.distributions as dist
import torch
from torch import Tensor
from torch.distributions import constraints
from torch.distributions.transforms import Transform

from bcppl.distributions.lazy import LazyDistribution
from bcppl.traces import Fault, Series, carried, simulate
from tests import small_programs
from tests.invariance import number
from tests.small_programs import normal_log

WRONG: dict[str, Wrong] = {}


@dataclass(frozen=True)
class Wrong:
    fault: Fault
    site: str | None
    program: Any
    args: tuple[Any, ...] = ()
    observations: Mapping[str, Any] = field(default_factory=lambda: {"y": 0.3})
    steps: tuple[Any, ...] = ()


def wrong(fault: Fault, site: str | None = "y", *args: Any, **more: Any) -> Callable[[Any], Any]:
    def register(program: Any) -> Any:
        WRONG[program.__name__] = Wrong(fault, site, program, args, **more)
        return program

    return register


def normal(address: str, mean: Any = 0.0, scale: Any = 1.0) -> Tensor:
    value: Tensor = pyro.sample(address, dist.Normal(torch.as_tensor(mean, dtype=torch.float64), scale))
    return value


class Reads(LazyDistribution):
    """A likelihood of x and of what a function returns."""

    def __init__(self, x: Tensor, read: Callable[[], Any]) -> None:
        self.x, self.read = x, read
        super().__init__(len(x), ())

    def log_prob(self, value: Tensor) -> Tensor:
        return normal_log(value, self.x + self.read(), 1.0)


# ---- randomness


@wrong(Fault.RANDOMNESS)
def torch_noise() -> None:
    x = normal("x")
    normal("y", x + 0.1 * torch.randn(len(x)))


@wrong(Fault.RANDOMNESS)
def numpy_noise() -> None:
    normal("y", normal("x") + 0.1 * np.random.normal())


@wrong(Fault.RANDOMNESS)
def python_noise() -> None:
    normal("y", normal("x"), random.choice([0.9, 1.0, 1.1]))


@wrong(Fault.RANDOMNESS)
def noise_in_the_density() -> None:
    x = normal("x")
    pyro.sample("y", Reads(x, lambda: torch.randn(len(x), dtype=torch.float64)))


@wrong(Fault.RANDOMNESS, None)
def seeding() -> None:
    torch.manual_seed(3)
    normal("y", normal("x"))


def noisy_step(x: Tensor) -> Tensor:
    normal("y", x)
    return x + torch.randn(len(x))


WRONG["noise in a state"] = Wrong(
    Fault.RANDOMNESS, None, Series(lambda: normal("x"), noisy_step), (), {}, (((), {"y": 0.3}),)
)


NETWORK = torch.nn.Sequential(torch.nn.Linear(1, 8), torch.nn.Dropout(0.5), torch.nn.Linear(8, 1)).double()


@wrong(Fault.RANDOMNESS)
def network_in_training() -> None:
    normal("y", NETWORK(normal("x")[:, None])[:, 0])


@wrong(Fault.RANDOMNESS)
def hidden_by_a_handler() -> None:
    with pyro.poutine.block():
        offset = normal("offset")
    normal("y", normal("x") + offset)


@wrong(Fault.RANDOMNESS)
def simulation_within() -> None:
    x = normal("x")
    normal("y", x + simulate(lambda: normal("noise"), (), len(x))["noise"])


# ---- state

BUFFER = torch.zeros(10_000, dtype=torch.float64)


class Buffered(Reads):
    def log_prob(self, value: Tensor) -> Tensor:
        BUFFER[: len(self.x)] = super().log_prob(value)
        return BUFFER[: len(self.x)]


@wrong(Fault.STATE)
def one_buffer_for_all_densities() -> None:
    pyro.sample("y", Buffered(normal("x"), lambda: 0.0))


class Shifting(Reads):
    def log_prob(self, value: Tensor) -> Tensor:
        self.x += 0.5
        return super().log_prob(value)


@wrong(Fault.STATE)
def density_that_writes_into_itself() -> None:
    pyro.sample("y", Shifting(normal("x") + 1.0, lambda: 0.0))


class Remembering(Reads):
    noise: Any = 0.0

    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        self.noise = torch.randn(len(self.x), dtype=torch.float64)
        return self.x + self.noise

    def log_prob(self, value: Tensor) -> Tensor:
        return super().log_prob(value - self.noise)


@wrong(Fault.STATE)
def sampler_that_changes_its_density() -> None:
    pyro.sample("y", Remembering(normal("x"), lambda: 0.0))


@wrong(Fault.STATE, "y_0", iter([1.0, 2.0]), observations={})
def exhausted_iterator(actions: Any) -> None:
    x = normal("x")
    for k, each in enumerate(actions):
        normal(f"y_{k}", x + each)


COUNTED = [0.0]
GENERATOR = np.random.default_rng(0)
TOTAL = 0.0


@wrong(Fault.STATE)
def counting_in_a_list() -> None:
    COUNTED[0] += 1.0
    normal("y", normal("x"), COUNTED[0])


@wrong(Fault.STATE)
def counting_in_a_global() -> None:
    global TOTAL
    TOTAL += 1.0
    normal("y", normal("x"), TOTAL)


@wrong(Fault.STATE)
def an_own_generator() -> None:
    normal("y", normal("x") + GENERATOR.normal())


@wrong(Fault.STATE)
def a_clock() -> None:
    normal("y", normal("x") + (1e3 * time.perf_counter()) % 1.0)


@wrong(Fault.STATE, "y", torch.zeros(3))
def adding_to_an_argument(offset: Tensor) -> None:
    offset += 0.1
    normal("y", normal("x") + offset.sum())


@wrong(Fault.STATE, "y_2", [1.0, 2.0, 3.0, 4.0], observations={})
def popping_an_argument(actions: list[float]) -> None:
    x = normal("x")
    actions.pop()
    for k, each in enumerate(actions):
        normal(f"y_{k}", x + each)


@wrong(Fault.STATE)
def counting_in_a_default(seen: list[int] = []) -> None:  # noqa: B006
    seen.append(1)
    normal("y", normal("x"), float(len(seen)))


LAST: list[Any] = [None]


def step_by_a_global(x: Tensor) -> Tensor:
    moved = normal("x", x if LAST[0] is None or len(LAST[0]) != len(x) else LAST[0])
    LAST[0] = moved
    normal("y", moved)
    return moved


WRONG["a global for a state"] = Wrong(
    Fault.STATE, "x", Series(lambda: normal("x"), step_by_a_global), (), {}, (((), {"y": 0.3}),)
)


# ---- values written into


@wrong(Fault.OVERWRITTEN, "x")
def millimetres_in_place() -> None:
    x = normal("x")
    in_millimetres = x.numpy()
    in_millimetres *= 1000.0
    normal("y", x / 1000.0)


@wrong(Fault.OVERWRITTEN, "x")
def in_place() -> None:
    x = normal("x")
    x += 1.0
    normal("y", x)


@wrong(Fault.OVERWRITTEN)
def observation_in_place() -> None:
    y = normal("y", normal("x"))
    y *= 2.0


@wrong(Fault.OVERWRITTEN, "x")
def clamped_in_place() -> None:
    normal("y", normal("x").clamp_(-1.0, 1.0))


# ---- addresses


@wrong(Fault.ADDRESSES, "bad", observations={})
def one_particle_decides_the_sites() -> None:
    x = normal("x")
    if x[0] > 0.0:
        normal("bad")


@wrong(Fault.RANDOMNESS, "bad", observations={})
def chance_decides_the_sites() -> None:
    normal("x")
    if random.random() > 0.5:
        normal("bad")


@wrong(Fault.ADDRESSES, "x_1", observations={})
def sampled_until_all_are_positive() -> None:
    x, k = normal("x"), 0
    while bool((x < 0.0).any()) and k < 3:
        x, k = normal(f"x_{k}"), k + 1


# ---- masked latents


@wrong(Fault.MASKED, "bad")
def masked_latent() -> None:
    slipped = pyro.sample("slipped", dist.Bernoulli(0.5))
    bad = pyro.sample("bad", dist.Normal(number(0.0), 1.0).mask(slipped == 1))
    normal("y", torch.where(slipped == 1, bad, 0.0))


# ---- particles


@wrong(Fault.MIXING)
def centred() -> None:
    x = normal("x")
    normal("y", x - x.mean())


@wrong(Fault.MIXING)
def softmax_over_particles() -> None:
    normal("y", torch.softmax(normal("x"), 0))


@wrong(Fault.MIXING)
def sorting() -> None:
    normal("y", normal("x").sort().values)


@wrong(Fault.MIXING)
def summed_density() -> None:
    x = normal("x")
    density = Reads(x, lambda: 0.0)
    density.log_prob = lambda value: normal_log(value, x, 1.0).sum()  # type: ignore[method-assign]
    pyro.sample("y", density)


@wrong(Fault.ONE_PARTICLE)
def first_particle() -> None:
    x = normal("x")
    normal("y", x, 2.0 if x[0] > 0.0 else 1.0)


@wrong(Fault.ONE_PARTICLE)
def entry_of_a_vector() -> None:
    x = pyro.sample("x", dist.Normal(torch.zeros(3, dtype=torch.float64), 1.0).to_event(1))
    normal("y", x[0, 1])


@wrong(Fault.MIXING)
def best_of_all() -> None:
    x = normal("x")
    normal("y", x - x.min())


@wrong(Fault.MIXING, observations={"y": torch.tensor([0.3, 0.2, 0.1])})
def scrambled_axes() -> None:
    p = pyro.sample("p", dist.Normal(torch.zeros(3, dtype=torch.float64), 1.0).to_event(1))
    pyro.sample("y", dist.Normal(p.reshape(3, -1).T, 1.0).to_event(1))


@wrong(Fault.PLACE)
def by_place() -> None:
    x = normal("x")
    normal("y", x + torch.arange(len(x)))


@wrong(Fault.PLACE)
def cached_by_shape() -> None:
    normal("y", rendered_once(normal("x")))


RENDERED: dict[int, Tensor] = {}


def rendered_once(x: Tensor) -> Tensor:
    return RENDERED.setdefault(len(x), x.square())


@wrong(Fault.COUNT)
def until_all_converge() -> None:
    x = normal("x")
    root = torch.ones_like(x)
    while bool(((root**3 + root - x).abs() > 1e-3).any()):
        root = root - (root**3 + root - x) / (3.0 * root.square() + 1.0)
    normal("y", root)


@wrong(Fault.COUNT)
def shared_out() -> None:
    x = normal("x")
    normal("y", x / len(x))


@wrong(Fault.COUNT, None)
def as_many_as_now() -> None:
    x = pyro.sample("x", dist.Normal(torch.zeros(10), 1.0))
    normal("y", x)


@wrong(Fault.MIXING)
def mean_as_a_number() -> None:
    x = normal("x")
    normal("y", x - x.mean().item())


@wrong(Fault.MIXING, "f", observations={})
def summed_factor() -> None:
    x = normal("x")
    pyro.factor("f", -x.square().sum())


@wrong(Fault.MIXING)
def batch_norm() -> None:
    normal("y", torch.nn.functional.batch_norm(normal("x")[:, None], None, None, training=True)[:, 0])


@wrong(Fault.PLACE)
def fixed_noise() -> None:
    x = normal("x")
    normal("y", x + torch.as_tensor(np.random.default_rng(0).normal(size=len(x))))


def centred_step(x: Tensor) -> Tensor:
    normal("y", x - x.mean())
    return x


def mixed_state(x: Tensor) -> Tensor:
    normal("y", x)
    return x - x.mean()


ONE_STEP = (((), {"y": 0.3}),)
IN_A_STEP, A_STATE = Series(lambda: normal("x"), centred_step), Series(lambda: normal("x"), mixed_state)
WRONG["mixing in a step"] = Wrong(Fault.MIXING, "y", IN_A_STEP, (), {}, ONE_STEP)
WRONG["a mixed state"] = Wrong(Fault.MIXING, None, A_STATE, (), {}, ONE_STEP)


# ---- dependence


class Shared:
    shift: Any = 0.0


class Own:
    shift: Any = 0.0


OWN, CONTEXT = Own(), ContextVar[Any]("shift")


@wrong(Fault.DEPENDENCE)
def object_written_into() -> None:
    x, OWN.shift = normal("x"), normal("shift")
    pyro.sample("y", Reads(x, partial_of_an_object(OWN)))


def partial_of_an_object(own: Own) -> Callable[[], Any]:
    return lambda: own.shift


@wrong(Fault.DEPENDENCE)
def context_variable() -> None:
    x = normal("x")
    CONTEXT.set(normal("shift"))
    pyro.sample("y", Reads(x, CONTEXT.get))


@lru_cache(maxsize=1)
def holder() -> dict[str, Any]:
    return {}


@wrong(Fault.DEPENDENCE)
def cached_holder() -> None:
    x = normal("x")
    holder()["shift"] = normal("shift")
    pyro.sample("y", Reads(x, lambda: holder()["shift"]))


class Rollout:
    """A simulator's state, which a trace carries."""

    def __init__(self, x: Tensor) -> None:
        self.x = x

    def __getitem__(self, index: Tensor) -> Rollout:
        return Rollout(self.x[index])

    def where(self, mask: Tensor, other: Rollout) -> Rollout:
        return Rollout(torch.where(mask, self.x, other.x))


STARTS: list[Any] = [None]


@wrong(Fault.DEPENDENCE)
def state_that_begins_from_a_global() -> None:
    STARTS[0] = normal("x")
    normal("y", carried("rollout", lambda: Rollout(STARTS[0])).x)


class Fixed(LazyDistribution):
    def __init__(self, x: Tensor) -> None:
        self.x = x
        super().__init__(len(x), ())

    def log_prob(self, value: Tensor) -> Tensor:
        return normal_log(value, self.x, 1.0)


class Excepted(Fixed):
    __caches__ = ("x",)


@wrong(Fault.DEPENDENCE)
def attribute_declared_a_cache() -> None:
    pyro.sample("y", Excepted(normal("x")))


FIXED = Fixed(torch.zeros(10, dtype=torch.float64))


def one_object_for_all_runs() -> None:
    FIXED.__init__(normal("x"))  # type: ignore[misc]
    pyro.sample("y", FIXED)


WRONG["one_object_for_all_runs"] = Wrong(Fault.DEPENDENCE, "y", one_object_for_all_runs)


class ClassWide(LazyDistribution):
    shift: Any = 0.0

    def __init__(self, x: Tensor) -> None:
        self.x = x
        super().__init__(len(x), ())

    def log_prob(self, value: Tensor) -> Tensor:
        return normal_log(value, self.x + self.shift, 1.0)


@wrong(Fault.DEPENDENCE)
def class_attribute() -> None:
    x = normal("x")
    ClassWide.shift = normal("shift")
    pyro.sample("y", ClassWide(x))


@wrong(Fault.DEPENDENCE)
def module_attribute() -> None:
    x = normal("x")
    small_programs.shift = normal("shift")  # type: ignore[attr-defined]
    pyro.sample("y", Reads(x, lambda: small_programs.shift))  # type: ignore[attr-defined]


@wrong(Fault.DEPENDENCE)
def function_attribute() -> None:
    x = normal("x")
    normal_log.shift = normal("shift")  # type: ignore[attr-defined]
    pyro.sample("y", Reads(x, lambda: normal_log.shift))  # type: ignore[attr-defined]


MEANS = torch.zeros(100_000, dtype=torch.float64)


@wrong(Fault.DEPENDENCE)
def one_buffer_for_all_means() -> None:
    x = normal("x")
    MEANS[: len(x)] = x
    normal("y", MEANS[: len(x)])


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


@wrong(Fault.DENSITY, "factor")
def of_torch() -> None:
    factor = pyro.sample("factor", dist.LKJCholesky(3, number(2.0)))
    normal("y", factor[..., 1, 0])


# ---- gradients


@wrong(Fault.GRADIENT)
def detached() -> None:
    x = normal("x")
    normal("y", x + x.detach().square())


@wrong(Fault.GRADIENT)
def detached_scale() -> None:
    x = normal("x")
    normal("y", x, x.detach().exp())
