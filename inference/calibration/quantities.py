"""Test quantities: numbers of latent values and data among which the truth's rank is taken.

Every one is a function of the values and of what does not depend on the truth given the data; then the truth
and exact posterior draws are exchangeable in it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from bcppl import poses
from bcppl.beliefs import Belief
from bcppl.errors import InputError
from bcppl.inference.calibration.joint import Simulator
from bcppl.poses import Freedom
from bcppl.traces.values import Values

AXES = ("x", "y", "z", "turn x", "turn y", "turn z")
PRIOR_DRAWS = 8  # from which reference points are taken in each round
LIKELIHOOD, DENSITY, DISTANCE = "log-likelihood", "log density", "distance"


@dataclass(frozen=True, eq=False)
class Quantities:
    """The test quantities of one round.

    Attributes:
        joint: that truth and data are drawn from.
        data: of the round.
        addresses: the latent addresses whose truth is known.
    """

    joint: Simulator
    data: Any
    addresses: tuple[str, ...]
    freedoms: Mapping[str, Freedom] = field(init=False)
    centres: Mapping[str, Tensor] = field(init=False)
    scales: Tensor = field(init=False)
    reference: Tensor = field(init=False)

    def __post_init__(self) -> None:
        values, log_likelihood, freedoms = self.joint.prior(self.data, PRIOR_DRAWS)
        equal = torch.zeros(PRIOR_DRAWS, dtype=torch.float64)
        centres = {
            a: Belief(values[a], equal, freedom).mean for a, freedom in freedoms.items() if a in values
        }
        object.__setattr__(self, "freedoms", freedoms)
        object.__setattr__(self, "centres", centres)
        coordinates = torch.stack(list(self.coordinates(values).values()), dim=-1)
        spread = coordinates.std(dim=0)
        object.__setattr__(self, "scales", torch.where(spread > 0, spread, 1.0))
        # The likeliest of some draws depends on the data, so that an inference that ignores them shows.
        object.__setattr__(self, "reference", coordinates[int(log_likelihood.argmax())])

    def coordinates(self, values: Values) -> dict[str, Tensor]:
        """Every number (K,) of latent values (K, *event), a pose's as a tangent at the prior's mean."""
        columns: dict[str, Tensor] = {}
        for address in self.addresses:
            value = values[address]
            if address in self.freedoms:
                axes = self.freedoms[address].axes
                tangent = poses.local(self.centres[address], value)
                columns |= {f"{address} {AXES[axis]}": tangent[:, axis] for axis in axes}
                continue
            numbers = value.to(torch.float64).reshape(len(value), -1)
            names = [address] if numbers.shape[1] == 1 else _indexed(address, value.shape[1:])
            columns |= dict(zip(names, numbers.unbind(dim=1), strict=True))
        return columns

    def measured(self, values: Values) -> dict[str, Tensor]:
        """All test quantities (K,) at latent values (K, *event).

        Coordinates; the log-likelihood, which finds errors that no coordinate shows (Modrak et al. 2023);
        the log-density of latent values and data, whose ranks are the levels of highest density regions; the
        distance to a reference point, whose ranks are TARP's levels (Lemos et al. 2023, algorithm 2).

        Raises:
            InputError: a quantity of the user's gives other than K numbers.
        """
        columns = self.coordinates(values)
        count = len(next(iter(values.values())))
        away = (torch.stack(list(columns.values()), dim=-1) - self.reference) / self.scales
        columns[DISTANCE] = away.norm(dim=-1)
        densities = self.joint.densities(values, self.data)
        if densities is not None:
            columns |= {LIKELIHOOD: densities.log_likelihood, DENSITY: densities.log_density}
        for name, quantity in self.joint.quantities.items():
            value = quantity(values, self.data)
            if not isinstance(value, Tensor) or value.shape != (count,):
                raise InputError(f"the test quantity {name!r} gives no tensor of shape ({count},).")
            columns[name] = value.to(torch.float64)
        return columns


def _indexed(address: str, shape: torch.Size) -> list[str]:
    """The names of the numbers of a value in reading order: x[0], x[1], or x[0, 0], ..."""
    places = torch.cartesian_prod(*(torch.arange(size) for size in shape)).reshape(-1, len(shape))
    return [f"{address}[{', '.join(map(str, place))}]" for place in places.tolist()]
