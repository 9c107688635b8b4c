"""What the updates of a live belief did, and how many particles the next one is made with."""

from __future__ import annotations

from dataclasses import dataclass, replace

from bcppl.inference.filters.smc import Step, own_state
from bcppl.inference.sizing import resize

FEWEST = 20  # particles, that no deadline takes
AHEAD = 0.5  # of the deadline: a faster update may have more particles


@dataclass(frozen=True, eq=False)
class UpdateInfo:
    """What one update of a live belief did.

    Attributes:
        joined: how many measurements it assimilated as one.
        particles: how many it was made with.
        seconds: from the arrival of the last of them until the belief had it.
        fault: why they are left out; empty where they are not.
    """

    joined: int
    particles: int
    seconds: float
    fault: str = ""


def affordable(last: UpdateInfo | None, joined: int, particles: int, deadline: float) -> int:
    """How many particles an update of so many measurements is made with, by how long the last one took.

    Args:
        last: None before the first.
        joined: how many measurements it assimilates as one.
        particles: at most.
        deadline: s.
    """
    if last is None:
        return particles
    if last.seconds > 2.0 * deadline and last.joined > 1 and joined > 1:
        return max(min(FEWEST, particles), last.particles // 2)
    if last.seconds < AHEAD * deadline:
        return min(particles, 2 * last.particles)
    return last.particles


def resized(step: Step, count: int) -> Step:
    """A step with another number of particles, drawn by its own random state."""
    if len(step.population) == count:
        return step
    state = [step.random_state]
    with own_state(state, count):
        population = resize(step.population, count)
    return replace(step, population=population, random_state=state[0])
