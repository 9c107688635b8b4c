"""Whether a force sensor feels a contact, where that can be told for sure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from bcppl.arguments import number_within, whole_number
from bcppl.errors import InputError
from bcppl.robot.motion import ProbeWindow


@dataclass(frozen=True)
class Felt:
    """From which force on there is a contact.

    A peg that begins to touch, or lets go, is between the two: such stamps tell nothing.

    Attributes:
        contact: N; more than this is a contact. Above what the sensor's zero drifts and what accelerating the
            tool takes.
        free: N; less than this is none.
        load: kg; so much more than the two forces for each m/s^2 by which the tool is being accelerated.
        beside: so many samples to either side must agree.

    Raises:
        InputError: a number is out of range.
    """

    contact: float = 1.5
    free: float = 0.8
    load: float = 0.3
    beside: int = 2

    def __post_init__(self) -> None:
        number_within("a contact is felt from {} N on", self.contact, above=0.0)
        number_within("nothing is felt up to {} N", self.free, above=0.0, most=self.contact)
        number_within("a load of {} kg is accelerated", self.load, least=0.0)
        whole_number("{} samples beside are to agree", self.beside, least=0)

    def __call__(self, force: Tensor, acceleration: Tensor | float = 0.0) -> Tensor:
        """1 for contact, 0 for none and NaN for neither, (T,), of tared forces (T, 3) in newtons.

        A force that is NaN, as while taring, tells nothing.

        Args:
            force: (T, 3).
            acceleration: (T,) m/s^2 that is commanded at the tool.

        Raises:
            InputError: forces are not (T, 3).
        """
        if force.ndim != 2 or force.shape[1] != 3:
            raise InputError(f"forces have shape {tuple(force.shape)}; give (T, 3), in newtons.")
        if len(force) == 0:
            return torch.empty(0, dtype=torch.float64)
        size = force.norm(dim=1)
        told = ~torch.isnan(size)
        contact = self._agreed(told & (size > self.contact + self.load * acceleration))
        free = self._agreed(told & (size < self.free))
        return torch.where(contact, 1.0, torch.where(free, 0.0, torch.nan)).to(torch.float64)

    def _agreed(self, held: Tensor) -> Tensor:
        padded = torch.nn.functional.pad(held, (self.beside, self.beside), value=True)
        return padded.unfold(0, 2 * self.beside + 1, 1).all(dim=1)


def accelerations(windows: Sequence[ProbeWindow]) -> Tensor:
    """What a probe's command asks for at the stamps of its windows, (T,): the most within 50 ms, m/s^2."""
    probe = windows[0].probe
    stamps = np.concatenate([probe.stamps[window.first : window.last] for window in windows])
    near = stamps[:, None] + np.arange(-0.05, 0.051, 0.01)
    place = np.stack([np.interp(near, probe.command_times, probe.command[:, axis]) for axis in range(3)])
    speed = np.diff(place, axis=-1) / 0.01
    return torch.from_numpy(np.linalg.norm(np.diff(speed, axis=-1) / 0.01, axis=0).max(axis=-1))
