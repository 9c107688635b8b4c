"""Particle Gibbs with ancestor sampling: the path of a series redrawn given its static parameters.

    trace, _ = generate(unrolled(Series(init, step)), ([()] * len(ys),), observed, 20)
    kernel = sequence(particle_gibbs("rho", particles=30), metropolis_hastings(drift("rho")))
    chains = markov_chains(kernel, trace, moves=1000, addresses="rho")

Lindsten, Jordan and Schoen, Particle Gibbs with ancestor sampling, JMLR 15, 2014, algorithm 2.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from bcppl.arguments import whole_number
from bcppl.errors import InputError
from bcppl.inference.kernels import Kernel, Move
from bcppl.inference.population import Population
from bcppl.inference.series import groups
from bcppl.inference.series.states import merged, merged_entries, same
from bcppl.inference.series.unrolling import Unrolled, by_step, numbered
from bcppl.inference.targets import Target
from bcppl.traces import Trace, extend, generate, update
from bcppl.traces.carried import Entry
from bcppl.traces.series import SeriesTrace, resumed


def particle_gibbs(*static: str, particles: int = 50) -> Kernel:
    """A kernel that redraws the whole path of a series by conditional SMC; it refuses nothing.

    Each of M chains runs a particle filter of N particles, one of which is the chain's path. All filters are
    one batch of M x N particles, resampled by multinomial draws. At each step the path's ancestor is drawn
    again among all particles, by weight times the density of the step that leads on to the path. So it mixes
    with few particles, however long the series is.

    A state that holds more than the values of its own step (a static parameter, a value two steps back) fixes
    which ancestors are possible: those from which the step leads to the same state.

    Args:
        static: latent addresses of `init` that stay. Other kernels move them, in a `sequence` with this one.
        particles: N, 2 or more.

    Returns:
        A kernel for traces of `unrolled(series)`. The share of steps whose value has changed, on average over
        the steps, is given as the acceptance. Moving raises InputError where the trace is of another program,
        or a static parameter is no latent address of `init`.

    Raises:
        InputError: the particles are no whole number, 2 or more.
    """
    particles = whole_number("particle Gibbs is given {} particles", particles, least=2)

    def kernel(population: Population) -> Move:
        def move(trace: Trace, target: Target) -> tuple[Trace, Tensor]:
            paths = _Conditional(trace, static, particles, target).paths()
            changed = [_differ(value, trace[address]) for address, value in paths.items()]
            return update(trace, paths).trace, torch.stack(changed).to(torch.float64).mean(dim=0)

        return move

    return kernel


class _Particles(NamedTuple):
    """M x N particles after a step, those of a chain side by side, the chain's own path last.

    Values are by the series' addresses, ancestors (M, N) are within a chain, log weights (M, N) normalised.
    """

    state: Any
    carried: Mapping[str, Entry]
    values: Mapping[str, Tensor]
    ancestors: Tensor
    log_weights: Tensor


class _Conditional:
    """Conditional SMC given the paths of M chains, which a trace of the unrolled program holds."""

    def __init__(self, trace: Trace, static: tuple[str, ...], count: int, target: Target) -> None:
        if not isinstance(trace.program, Unrolled):
            raise InputError(
                "particle Gibbs is given a trace of another program than an unrolled series; "
                "generate one from `unrolled(series)`."
            )
        self.trace, self.static, self.count, self.target = trace, static, count, target
        self.series, self.arguments = trace.program.series, trace.args[0]
        self.visited = by_step(trace.addresses, len(self.arguments))
        trace.refuse_other_than_latent(static)
        if others := [address for address in static if address not in self.visited[0]]:
            raise InputError(f"particle Gibbs is to keep {others[0]!r}, which `init` does not sample.")
        # The last of each chain's particles is its path.
        self.free = torch.arange(count).repeat(trace.particles) < count - 1
        self.equal = torch.full((trace.particles, count), groups.equal(count), dtype=torch.float64)

    def paths(self) -> dict[str, Tensor]:
        """New values (M, *event) of the paths, by the addresses of the unrolled program."""
        filtered = [self._first()]
        for number in range(1, len(self.arguments) + 1):
            filtered.append(self._next(number, filtered[-1]))
        chosen, redrawn = groups.multinomial(filtered[-1].log_weights, 1), {}
        for number in reversed(range(len(filtered))):
            now = filtered[number]
            rows = groups.rows(chosen, self.count)
            redrawn.update({numbered(a, number): value[rows] for a, value in now.values.items()})
            chosen = now.ancestors.gather(1, chosen)
        return redrawn

    def _first(self) -> _Particles:
        observations, path = self._observations(0), self._path(0)
        kept = {address: path.pop(address) for address in self.static}
        args, size = self.trace.args[1:], len(self.free)
        free, _ = generate(self.series, args, observations, size, kept)
        onto, _ = generate(self.series, args, observations, size, {**kept, **path})
        return self._joined(0, free, onto, torch.arange(size), self.equal.long(), path)

    def _next(self, number: int, before: _Particles) -> _Particles:
        observations, path = self._observations(number), self._path(number)
        start = resumed(self.series, before.state, number - 1, len(self.free), before.carried)
        onto, _ = extend(start, self.arguments[number - 1], observations, path)
        assert isinstance(onto, SeriesTrace)
        ancestors = groups.multinomial(before.log_weights, self.count)
        ancestors[:, -1] = self._ancestor(number, onto, before.log_weights)
        rows = groups.rows(ancestors, self.count)
        free, _ = extend(start.chosen(rows), self.arguments[number - 1], observations)
        return self._joined(number, free, onto, rows, ancestors, path)

    def _joined(
        self,
        number: int,
        free: Trace,
        onto: Trace,
        rows: Tensor,
        ancestors: Tensor,
        path: Mapping[str, Tensor],
    ) -> _Particles:
        """The particles that were drawn, and the steps to the path from the particles at `rows` (M x N,)."""
        assert isinstance(free, SeriesTrace) and isinstance(onto, SeriesTrace)
        # The values that stay weigh those of `init` on which their distributions depend.
        held = self.static if number == 0 else ()
        drawn = [a for a in onto.choices if a not in held]
        likelihood = [self._log_density(number, each, onto.addresses, drawn) for each in (free, onto)]
        log_likelihood = torch.where(self.free, likelihood[0], likelihood[1][rows])
        led: SeriesTrace = onto.chosen(rows)
        return _Particles(
            merged(self.free, free.state, led.state),
            merged_entries(self.free, free.carried, led.carried),
            {address: merged(self.free, free[address], led[address]) for address in path},
            ancestors,
            groups.reweighed(self.equal, log_likelihood)[0],
        )

    def _ancestor(self, number: int, onto: SeriesTrace, log_weights: Tensor) -> Tensor:
        """The particle (M,) from which the path is to descend (Lindsten et al., algorithm 2).

        `onto` are the steps to the path from each of M x N particles.
        """
        density = self._log_density(number, onto, onto.addresses)
        # The path's later steps begin from the state that it reaches from its own last one.
        own = (torch.arange(len(log_weights)) + 1).repeat_interleave(self.count) * self.count - 1
        possible = same(onto.state, onto.chosen(own).state, len(own))
        density = torch.where(possible, density, -torch.inf).reshape(log_weights.shape) + log_weights
        # A path that is impossible keeps its own past, until another one is drawn for it.
        density[:, -1] = torch.where((density == -torch.inf).all(dim=1), 0.0, density[:, -1])
        return torch.multinomial(torch.softmax(density, dim=1), 1).squeeze(1)

    def _log_density(
        self, number: int, trace: Trace, addresses: Sequence[str], drawn: Sequence[str] = ()
    ) -> Tensor:
        """The log-density (M x N,) of what a step visits under the target, over that of the sites drawn."""
        total = torch.zeros(trace.particles, dtype=torch.float64)
        for address in addresses:
            exponent = self.target.exponent(numbered(address, number)) - (address in drawn)
            if exponent != 0.0:
                value = trace.log_prob(address)
                total = total + torch.where(value == -torch.inf, value, exponent * value)
        return total

    def _path(self, number: int) -> dict[str, Tensor]:
        """The path's own values (M x N, *event) at a step."""
        named = {address: numbered(address, number) for address in self.visited[number]}
        held = {a: self.trace[each] for a, each in named.items() if each in self.trace.choices}
        return {address: value.repeat_interleave(self.count, dim=0) for address, value in held.items()}

    def _observations(self, number: int) -> dict[str, Tensor]:
        named = {address: numbered(address, number) for address in self.visited[number]}
        return {a: self.trace[each] for a, each in named.items() if each in self.trace.observations}


def _differ(first: Tensor, second: Tensor) -> Tensor:
    return (first != second).reshape(len(first), -1).any(dim=1)
