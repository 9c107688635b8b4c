"""Programs whose randomness no trace sees, that keep a state, or that write into values."""

from __future__ import annotations

import random
import time
from typing import Any

import numpy as np
import pyro
import torch
from torch import Tensor

from bcppl.traces import Fault, Series, simulate
from tests.wrong_programs.catalogue import WRONG, Reads, Wrong, normal, wrong

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
