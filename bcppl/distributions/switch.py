"""A distribution chosen for each particle: what a discrete site switches between."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from bcppl.distributions.lazy import LazyDistribution
from bcppl.errors import InputError


class Switch(LazyDistribution):
    """One of several distributions, chosen by a discrete value of each particle.

    Only the chosen one is evaluated for a particle, so that a renderer or a physics engine runs no more often
    than without a choice.

        which = pyro.sample("which", Categorical(torch.ones(2)))
        depth = Switch(which, lambda k, rows: LaplaceDepth(renderers[k], camera, pose[rows], 0.003))
        pyro.sample("depth", depth)

    Args:
        which: (N,) whole numbers.
        build: `build(k, rows)` makes the distribution of the particles at `rows` (K,) int64, all of which
            chose k; its batch shape is (K,), its event shape the same for every k.

    Raises:
        InputError: `which` is no vector of whole numbers, or what was built has another shape.
    """

    def __init__(self, which: Tensor, build: Callable[[int, Tensor], Any]) -> None:
        if which.ndim != 1 or not bool((which == which.round()).all()):
            raise InputError(
                f"a switch was given choices of shape {tuple(which.shape)}; "
                "give one whole number for each particle, such as a draw of Categorical."
            )
        self.groups: list[tuple[Tensor, Any]] = []
        for choice in torch.unique(which).tolist():
            rows = (which == choice).nonzero().flatten()
            built = build(int(choice), rows)
            if tuple(built.batch_shape) != (len(rows),):
                raise InputError(
                    f"choice {int(choice)} of a switch has batch shape {tuple(built.batch_shape)} for "
                    f"{len(rows)} particles; build it from values at the rows it is given, `pose[rows]`."
                )
            self.groups.append((rows, built))
        shapes = {tuple(built.event_shape) for _, built in self.groups}
        if len(shapes) > 1:
            raise InputError(
                f"the choices of a switch have events of shapes {', '.join(map(str, sorted(shapes)))}; "
                "they must have the same."
            )
        built = [distribution for _, distribution in self.groups]
        self.cost = max(getattr(each, "cost", 0) for each in built)
        inputs = tuple(tensor for each in built for tensor in getattr(each, "inputs", ()))
        super().__init__(len(which), shapes.pop(), inputs=(which, *inputs))
        if not all(hasattr(each, "inputs") for each in built):
            # What does not say what it hangs on must be evaluated anew each time.
            del self.inputs

    @property
    def log_prob_bound(self) -> float:
        """The largest of the chosen distributions' bounds."""
        return max(float(getattr(each, "log_prob_bound", torch.inf)) for _, each in self.groups)

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-probability (N,) of one value (*event_shape), or of one for each particle."""
        own = value.ndim > len(self.event_shape)
        total = torch.empty(self.batch_shape[0], dtype=torch.float64)
        for rows, distribution in self.groups:
            total[rows] = distribution.log_prob(value[rows] if own else value).to(torch.float64)
        return total

    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        """One value for each particle, (N, *event_shape).

        Raises:
            InputError: a sample_shape was asked for.
        """
        if torch.Size(sample_shape) != torch.Size():
            raise InputError("a switch draws one value for each particle; ask for no sample_shape.")
        drawn = [(rows, distribution.sample()) for rows, distribution in self.groups]
        values = drawn[0][1].new_empty(self.batch_shape + self.event_shape)
        for rows, value in drawn:
            values[rows] = value
        return values
