"""Detection of contact and of its absence from the force, each where it is beyond doubt."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from bcppl.arguments import number_within
from bcppl.errors import InputError


@dataclass(frozen=True)
class ContactDetector:
    """Force thresholds of contact and of free motion.

    Between the two a stamp is undecided, as where a peg makes or breaks contact.

    Attributes:
        contact: N; there is contact above this, which exceeds the drift of the sensor's zero and the tool's
            inertial force.
        free: N; there is none below this.
        mass: kg; `contact` grows by this for each m/s^2 of the tool's acceleration.
        agreement: s to either side within which all samples must agree.

    Raises:
        InputError: a number is out of range.
    """

    contact: float = 1.5
    free: float = 0.8
    mass: float = 0.3
    agreement: float = 0.005

    def __post_init__(self) -> None:
        number_within("a contact detector has contact {} N", self.contact, above=0.0)
        number_within("a contact detector has free {} N", self.free, above=0.0, most=self.contact)
        number_within("a contact detector has mass {} kg", self.mass, least=0.0)
        number_within("a contact detector has agreement {} s", self.agreement, least=0.0)

    def __call__(self, force: Tensor, acceleration: Tensor | float = 0.0, step: float = math.inf) -> Tensor:
        """1 for contact, 0 for none and NaN for undecided, (T,).

        Args:
            force: (T, 3) tared, newtons; one that is NaN, as while taring, is undecided.
            acceleration: (T,) of the tool, m/s^2.
            step: s between samples.

        Raises:
            InputError: forces are not (T, 3).
        """
        if force.shape[1:] != (3,):
            raise InputError(f"forces have shape {tuple(force.shape)}; give (T, 3), in newtons.")
        if len(force) == 0:
            return torch.empty(0, dtype=torch.float64)
        size = force.norm(dim=1)
        known = ~torch.isnan(size)
        neighbours = int(self.agreement / step + 1e-6)
        contact = _unanimous(known & (size > self.contact + self.mass * acceleration), neighbours)
        free = _unanimous(known & (size < self.free), neighbours)
        return torch.where(contact, 1.0, torch.where(free, 0.0, torch.nan)).to(torch.float64)


def _unanimous(flags: Tensor, neighbours: int) -> Tensor:
    padded = torch.nn.functional.pad(flags, (neighbours, neighbours), value=True)
    return padded.unfold(0, 2 * neighbours + 1, 1).all(dim=1)
