"""Whether each particle's densities are its own: whatever the others' values, their order and number."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import torch
from torch import Tensor

from bcppl.errors import InputError
from bcppl.traces.checks.comparing import TOLERANCE, differing, log_probs, rerun
from bcppl.traces.faults import Fault, ProgramError
from bcppl.traces.indexing import broadcast, indexed
from bcppl.traces.series import SeriesTrace
from bcppl.traces.trace import Trace

STATE = "the state of the series"
# Particles that are run alone.
SINGLE = 10
VECTORISED = "compute with each particle's own values, along other axes than that of the particles"


def check_particles(trace: Trace, other: Trace) -> None:
    """Check that a particle's log-probabilities are functions of its own values.

    Args:
        trace: of N particles.
        other: of as many, at other values: the particles of both are mixed.

    Raises:
        ProgramError: they depend on the other particles' values (MIXING), on those of a certain one
            (ONE_PARTICLE), on the place among them (PLACE) or on their number (COUNT).
    """
    count = trace.particles
    own, others = signature(trace), signature(other)
    for mask in _masks(count):
        mixed = signature(rerun(trace.where(mask, other)))
        expected = {a: torch.where(broadcast(mask, v), v, others[a]) for a, v in own.items()}
        if (site := _unlike(expected, mixed)) is not None:
            raise _mixing(trace, other, site)
    for order in (torch.arange(count).flip(0), torch.arange(count).roll(1)):
        if (
            site := _unlike({a: v[order] for a, v in own.items()}, signature(rerun(trace[order])))
        ) is not None:
            raise ProgramError(
                Fault.PLACE,
                _address(site),
                f"{_where(site)} is another at a particle that has the same values but another place among "
                "the particles; what is the same for all particles must have no axis of them, and what an "
                "earlier run computed must not be used again for other values.",
            )
    places = torch.arange(count)
    for some in (places[: count // 2], places[count // 2 :], *places[:SINGLE, None]):
        try:
            fewer = signature(rerun(trace[some]))
        except (InputError, RuntimeError, ValueError, IndexError, TypeError) as error:
            raise ProgramError(
                Fault.COUNT,
                None,
                f"the program runs with {count} particles and not with {len(some)}: {error}",
            ) from error
        if own.keys() != fewer.keys():
            site = min(own.keys() ^ fewer.keys())
            raise ProgramError(
                Fault.ADDRESSES,
                _address(site),
                f"{_where(site)} is there with {count} particles and not with {len(some)}, or the reverse; "
                "visit the same sites whatever the values: bound a loop by a number, not by all particles' "
                "values.",
            )
        if (site := _unlike({a: v[some] for a, v in own.items()}, fewer)) is not None:
            raise ProgramError(
                Fault.COUNT,
                _address(site),
                f"{_where(site)} is another with {len(some)} particles than with {count}, at the same "
                f"values; {VECTORISED}.",
            )


def signature(trace: Trace) -> dict[str, Tensor]:
    """What is to be each particle's own: log-probabilities (N,), and of a series the state's tensors."""
    values = log_probs(trace)
    if isinstance(trace, SeriesTrace):
        state = indexed(trace.state, torch.arange(trace.particles), trace.particles)
        values.update(_tensors(STATE, state))
    return values


def _tensors(name: str, state: object) -> dict[str, Tensor]:
    if isinstance(state, Tensor):
        return {name: state} if state.ndim else {}
    parts: Iterable[tuple[Any, Any]] = state.items() if isinstance(state, Mapping) else ()
    parts = enumerate(state) if isinstance(state, list | tuple) else parts
    return {n: v for key, part in parts for n, v in _tensors(f"{name} ({key})", part).items()}


def _masks(count: int) -> list[Tensor]:
    """Which particles stay: every second one, all but the first, the first alone."""
    places = torch.arange(count)
    return [places % 2 == 0, places > 0, places == 0]


def _unlike(expected: dict[str, Tensor], got: dict[str, Tensor]) -> str | None:
    """The first part of two signatures that differs, if any does."""
    for name, value in expected.items():
        if name not in got or value.shape != got[name].shape:
            return name
        if name.startswith(STATE):
            if not torch.allclose(value.double(), got[name].double(), TOLERANCE, TOLERANCE, equal_nan=True):
                return name
        elif bool(differing(value, got[name]).any()):
            return name
    return None


def _mixing(trace: Trace, other: Trace, site: str) -> ProgramError:
    """The error of a site that depends on other particles: on all of them, or on a certain one."""
    places = torch.arange(trace.particles)
    first = _influential(trace, other, site)
    second = _influential(rerun(trace[places.roll(1)]), other, site)
    # The particle with the largest value is a certain one, too, and moves with its value.
    if len(first) == 1 and first == second:
        return ProgramError(
            Fault.ONE_PARTICLE,
            _address(site),
            f"{_where(site)} is another at all particles where only particle {first[0]} has another value; "
            "index along other axes than that of the particles (the last within a program: `x[..., k, :]` is "
            "the value of particle k), and choose by `torch.where`, not by an `if` on one value.",
        )
    return ProgramError(
        Fault.MIXING,
        _address(site),
        f"{_where(site)} is another at a particle where only other particles have other values; a mean, a "
        f"maximum, an order or a sum over the particles is part of it: {VECTORISED}.",
    )


def _influential(trace: Trace, other: Trace, site: str) -> list[int]:
    """The particles whose values matter to other particles at a site."""
    own, places = signature(trace)[site], torch.arange(trace.particles)
    particles = []
    for particle in range(trace.particles):
        stay = places != particle
        mixed = signature(rerun(trace.where(stay, other)))[site]
        if _unlike({site: own[stay]}, {site: mixed[stay]}) is not None:
            particles.append(particle)
    return particles


def _where(name: str) -> str:
    return name if name.startswith(STATE) else f"the log-probability of site {name!r}"


def _address(name: str) -> str | None:
    return None if name.startswith(STATE) else name
