"""Programs whose likelihood, or the state of a simulator, reaches a latent value in many ways."""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any, ClassVar, NamedTuple

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from bcppl import poses
from bcppl.distributions.lazy import LazyDistribution
from bcppl.distributions.manifold import ContactManifold
from bcppl.distributions.poses import NormalPose
from bcppl.distributions.switch import Switch
from bcppl.geometry.gap import Gap
from bcppl.traces import carried

N, SCALE = 12, 0.1


def number(value: float) -> Tensor:
    return torch.tensor(value, dtype=torch.float64)


SEEN = {"seen": number(0.3)}

# ---- how a tensor is reached

Read = Callable[[Tensor], Tensor]
Row = namedtuple("Row", ["name", "shift"])


def shifted(x: Tensor, shift: Tensor) -> Tensor:
    return x + shift


@dataclass(frozen=True, eq=False)
class Sensor:
    """An object that holds a tensor."""

    shift: Tensor

    def read(self, x: Tensor) -> Tensor:
        return x + self.shift

    def __call__(self, x: Tensor) -> Tensor:
        return self.read(x)


class Slotted:
    """One without a dictionary."""

    __slots__ = ("shift",)

    def __init__(self, shift: Tensor) -> None:
        self.shift = shift

    def read(self, x: Tensor) -> Tensor:
        return x + self.shift


class Table:
    """Tensors in containers in containers."""

    def __init__(self, shift: Tensor) -> None:
        self.rows = {"name": "table", "rows": [("first", {"shift": shift})]}

    def __call__(self, x: Tensor) -> Tensor:
        rows: Any = self.rows["rows"]
        return x + rows[0][1]["shift"]


def from_within(shift: Tensor) -> Read:
    inner = lambda x: x + shift  # noqa: E731
    return lambda x: inner(x)


def default(shift: Tensor) -> Read:
    return lambda x, shift=shift: x + shift


def named(shift: Tensor) -> Read:
    row = Row("row", shift)
    return lambda x: x + row.shift


def as_array(shift: Tensor) -> Read:
    array = shift.numpy().copy()
    return lambda x: x + torch.from_numpy(array)


READS: dict[str, Callable[[Tensor], Read]] = {
    "lambda": lambda shift: lambda x: x + shift,
    "lambda over what was made of it": lambda shift: partial(shifted, shift=0.5 * shift + 0.5 * shift),
    "lambda in a lambda": from_within,
    "default argument": default,
    "partial": lambda shift: partial(torch.add, shift),
    "partial by name": lambda shift: partial(shifted, shift=shift),
    "object": Sensor,
    "object in a lambda": lambda shift: (lambda sensor: lambda x: sensor.read(x))(Sensor(shift)),
    "object without a dictionary": lambda shift: (lambda sensor: lambda x: sensor.read(x))(Slotted(shift)),
    "nested containers": Table,
    "named tuple": named,
    "bound method": lambda shift: Sensor(shift).read,
    "partial of a bound method": lambda shift: partial(Slotted(shift).read),
    "array": as_array,
}


class Seen(LazyDistribution):
    """A likelihood that is given a function: what that depends on is nowhere declared."""

    evaluated: ClassVar[int] = 0

    def __init__(self, x: Tensor, read: Read) -> None:
        self.x, self.read = x, read
        super().__init__(len(x), ())

    def log_prob(self, value: Tensor) -> Tensor:
        Seen.evaluated += 1
        return dist.Normal(self.read(self.x), SCALE).log_prob(value)

    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        return dist.Normal(self.read(self.x), SCALE).sample()


class Held(LazyDistribution):
    """One whose attributes are tensors."""

    def __init__(self, x: Tensor, shift: Tensor) -> None:
        self.x, self.shift = x, shift
        super().__init__(len(x), ())

    def log_prob(self, value: Tensor) -> Tensor:
        return dist.Normal(self.x + self.shift, SCALE).log_prob(value)


def latent() -> tuple[Tensor, Tensor]:
    x = pyro.sample("x", dist.Normal(number(0.0), 1.0))
    shift = pyro.sample("shift", dist.Normal(number(0.0), 1.0))
    pyro.sample("other", dist.Normal(number(0.0), 1.0))
    return x, shift


def reading(kind: str) -> None:
    x, shift = latent()
    pyro.sample("seen", Seen(x, READS[kind](shift)))


def switching(kind: str) -> None:
    """The same within a switch."""
    x, shift = latent()
    which = torch.arange(len(x)) % 2
    pyro.sample("seen", Switch(which, lambda k, rows: Seen(x[rows], READS[kind](shift[rows]))))


def holding(kind: str) -> None:
    x, shift = latent()
    pyro.sample("seen", Held(x, shift))


# ---- the same for a gap that knows how the peg is held

T = 5
HELD = torch.tensor([0.002, 0.002, 0.002, 0.02, 0.02, 0.02], dtype=torch.float64)


class Plane(NamedTuple):
    """The gap of a peg's origin over a part's plane z = 0."""

    distance: Tensor
    normal: Tensor
    place: Tensor

    def slope(self, world_from_part: Tensor) -> Tensor:
        return Gap(self.distance, self.place, self.normal).slope(world_from_part)


def over_plane(world_from_part: Tensor, world_from_grip: Tensor, grip_from_peg: Tensor) -> Plane:
    world_from_peg = poses.compose(world_from_grip, grip_from_peg[:, None])
    place = poses.transform(poses.inverse(world_from_part), world_from_peg[..., :3])
    normal = torch.zeros_like(place)
    normal[..., 2] = 1.0
    return Plane(place[..., 2], normal, place)


@dataclass(frozen=True, eq=False)
class Hand:
    grip_from_peg: Tensor

    def gap(self, world_from_part: Tensor, world_from_grip: Tensor) -> Plane:
        return over_plane(world_from_part, world_from_grip, self.grip_from_peg)

    def __call__(self, world_from_part: Tensor, world_from_grip: Tensor) -> Plane:
        return self.gap(world_from_part, world_from_grip)


class Hands:
    def __init__(self, grip_from_peg: Tensor) -> None:
        self.hands = [{"left": Hand(grip_from_peg)}]

    def __call__(self, world_from_part: Tensor, world_from_grip: Tensor) -> Plane:
        return self.hands[0]["left"].gap(world_from_part, world_from_grip)


GAPS: dict[str, Callable[[Tensor], Any]] = {
    "lambda": lambda peg: lambda part, grip: over_plane(part, grip, peg),
    "partial": lambda peg: partial(over_plane, grip_from_peg=peg),
    "object": Hand,
    "nested containers": Hands,
    "bound method": lambda peg: Hand(peg).gap,
}


def touching(kind: str) -> None:
    """A part that is touched with a peg that sits in the hand not quite as planned."""
    part = pyro.sample("part", NormalPose(poses.identity(), HELD))
    held = pyro.sample("grip_from_peg", NormalPose(poses.identity(), HELD))
    pyro.sample("touch", ContactManifold(GAPS[kind](held), part, T, 1e-3, 1e-3))


def touched() -> dict[str, Tensor]:
    rows = torch.zeros(T, 8, dtype=torch.float64)
    rows[:, 0], rows[:, 3], rows[:3, 7] = torch.linspace(-0.03, 0.03, T), 1.0, 1.0
    return {"touch": rows}


# ---- the same for a state that is carried


@dataclass(eq=False)
class State:
    """What a simulator has made of x and of a shift: one number for each particle."""

    value: Tensor

    def __getitem__(self, index: Tensor) -> State:
        return State(self.value[index])

    def where(self, mask: Tensor, other: State) -> State:
        return State(torch.where(mask, self.value, other.value))


STARTED: list[Tensor] = []  # what has been started, as a simulator may remember


def begun(x: Tensor, shift: Tensor) -> State:
    STARTED.append(x.mean())
    return State(x + shift)


@dataclass(eq=False)
class Simulator:
    """One that also holds what all particles share, and what it has done so far."""

    x: Tensor
    unknowns: Mapping[str, list[Tensor]]
    table: Tensor = field(default_factory=lambda: torch.linspace(0.0, 1.0, 3))
    done: list[Tensor] = field(default_factory=lambda: STARTED)

    def start(self) -> State:
        return begun(self.x, self.unknowns["shifts"][0])

    def __call__(self) -> State:
        return self.start()


STARTS: dict[str, Callable[[Tensor, Tensor], Callable[[], State]]] = {
    "lambda": lambda x, shift: lambda: begun(x, shift),
    "partial": lambda x, shift: partial(begun, x, shift),
    "object": lambda x, shift: Simulator(x, {"shifts": [shift]}),
    "nested containers": lambda x, shift: (lambda held: lambda: begun(x, held["a"][0][1]))(
        {"a": [(0, shift)]}
    ),
    "bound method": lambda x, shift: Simulator(x, {"shifts": [shift]}).start,
}


class Rolled(LazyDistribution):
    """Where a simulation has got to."""

    def __init__(self, x: Tensor, state: State) -> None:
        self.state = state
        super().__init__(len(x), ())

    def log_prob(self, value: Tensor) -> Tensor:
        return dist.Normal(self.state.value, SCALE).log_prob(value)


def simulating(kind: str) -> State:
    x, shift = latent()
    state = carried("state", STARTS[kind](x, shift))
    pyro.sample("seen", Rolled(x, state))
    return state


def simulating_plainly(kind: str) -> State:
    """Into a distribution of Pyro's own."""
    x, shift = latent()
    state = carried("state", STARTS[kind](x, shift))
    pyro.sample("seen", dist.Normal(state.value, SCALE))
    return state
