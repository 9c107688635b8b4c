"""The rows of a probe, window by window: what each brings, and what earlier ones have used."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from bcppl import poses
from bcppl.arrays import Array, Indices
from bcppl.contact.sensing.contact_detection import ContactDetector
from bcppl.contact.sensing.couple import turn_against
from bcppl.contact.sensing.episodes import EpisodeExtractor, cell_ends
from bcppl.contact.sensing.location import ContactSensing
from bcppl.contact.sensing.noise import position_noise
from bcppl.devices import numbers
from bcppl.distributions.episodes.filtered import Linearised
from bcppl.distributions.episodes.rows import COLUMNS, FELT, GIVEN, SECONDS, padded
from bcppl.distributions.manifold import Gaps, MeasuresGap
from bcppl.robot.motion import Probe, ProbeWindow
from bcppl.sensors.measurements import Measurement

_ROWS = 60  # of a cell at most: those of contact last 10 ms at least
_REMEMBERED = 600  # rows that are given to a window at most, the newest


class RowSettings(Protocol):
    """Those of `contact_probe.TouchSettings` on which the rows depend."""

    @property
    def gap_noise(self) -> float: ...  # noqa: D102
    @property
    def delay(self) -> float: ...  # noqa: D102
    @property
    def free_space(self) -> bool: ...  # noqa: D102
    @property
    def contact_detector(self) -> ContactDetector: ...  # noqa: D102


@lru_cache(maxsize=64)
def _ends(probe: Probe) -> Indices:
    return cell_ends(probe.stamps)


@lru_cache(maxsize=64)
def step_of(probe: Probe) -> float:
    """Seconds between a probe's stamps; of one with a single stamp, one."""
    return float(np.median(np.diff(probe.stamps))) if len(probe.stamps) > 1 else 1.0


@lru_cache(maxsize=1024)
def cells_of(window: ProbeWindow) -> Indices:
    """The ends of cells (C,), in stamps, that lie in a window."""
    ends = _ends(window.probe)
    return ends[(ends > window.first) & (ends <= window.last)]


def capacity(window: ProbeWindow) -> int:
    """T, the rows that a window's value has room for."""
    return _ROWS * max(1, len(cells_of(window))) + _REMEMBERED


def after_those_before(each: Sequence[tuple[int, Tensor]], room: Sequence[int]) -> dict[int, Tensor]:
    """The values (T, COLUMNS) of windows, by number: all rows of earlier windows are given, then their own.

    Args:
        each: number and rows (R, COLUMNS) of each window, in their order.
        room: T of each.
    """
    given, values = torch.empty(0, COLUMNS, dtype=torch.float64), {}
    for (number, new), most in zip(each, room, strict=True):
        rows = new.clone()
        values[number] = padded(torch.cat([given[max(0, len(given) + len(rows) - most) :], rows]), most)
        rows[:, GIVEN] = 1.0
        given = torch.cat([given, rows])[-_REMEMBERED:]
    return values


class RememberedGaps:
    """The gaps at one set of poses of the part, each place of the peg measured once.

    The windows of a probe ask for those of earlier ones again.

    Attributes:
        memory: of `ContactEpisodes` at these poses.
    """

    __caches__ = ("_number", "_distance", "_gradient", "memory")

    def __init__(self, gap: MeasuresGap, part: Tensor) -> None:
        self.gap, self.part = gap, part
        self.memory: dict[bytes, Linearised] = {}
        self._number: dict[bytes, int] = {}
        self._distance, self._gradient = part.new_zeros(len(part), 0), part.new_zeros(len(part), 0, 6)

    def __call__(self, world_from_part: Tensor, world_from_peg: Tensor) -> Gaps:
        """Gaps at poses (N, 7), those of `part`, and (T, 7) or (N, T, 7)."""
        if world_from_part is not self.part or world_from_peg.ndim != 2:
            return self.gap(world_from_part, world_from_peg)
        keys = [row.tobytes() for row in numbers(world_from_peg)]
        new = [k for k, key in enumerate(keys) if key not in self._number]
        if new:
            measured = self.gap(self.part, world_from_peg[new])
            for place, k in enumerate(new, self._distance.shape[1]):
                self._number[keys[k]] = place
            self._distance = torch.cat([self._distance, measured.distance], dim=1)
            self._gradient = torch.cat([self._gradient, measured.gradient(self.part)], dim=1)
        used = [self._number[key] for key in keys]
        if used == list(range(self._distance.shape[1])):
            return Measured(self._distance, self._gradient)
        return Measured(self._distance[:, used], self._gradient[:, used])


class Measured(NamedTuple):
    """Gaps that are known already, in place of what measures them."""

    distance: Tensor
    gradients: Tensor

    def gradient(self, world_from_part: Tensor) -> Tensor:
        """(N, T, 6), at the poses where they were measured."""
        return self.gradients

    def __call__(self, world_from_part: Tensor, world_from_peg: Tensor) -> Gaps:
        """These, at the poses where they were measured."""
        return self


class ProbeRows:
    """One probe, as far as it is measured.

    A probe of which the beginning was not measured, by which the wrench is tared, has no rows. The wrench may
    be late by times in the first intervals of `rows.SECONDS`, so many as `intervals`.

    Attributes:
        windows: so far.
        rows: (R, COLUMNS) by number of the window, of those in which a cell ends.
    """

    def __init__(
        self, probe: Probe, sensing: ContactSensing, settings: RowSettings, intervals: int = 0
    ) -> None:
        self.windows: list[Measurement] = []
        self.rows: dict[int, Tensor] = {}
        self.probe, self.sensing, self.settings = probe, sensing, settings
        self._state = sensing.start(1)
        self._extractor = EpisodeExtractor(settings.contact_detector, step_of(probe), SECONDS[:intervals])
        self._number = np.empty(0, dtype=np.int64)
        self._pose, self._wrench = np.empty((0, 7)), np.empty((0, 6))

    def begins(self, windows: Sequence[Measurement]) -> bool:
        """Whether the windows so far are the first of these, or these the first of them."""
        return all(mine is given for mine, given in zip(self.windows, windows, strict=False))

    def add(self, measurement: Measurement) -> None:
        """One more window; stamps that were measured before are left out."""
        window, touch = measurement.action, measurement.observation
        name = f"window {len(self.windows)}"
        wrench, self._state = self.sensing.next_tared(touch, self._state, name)
        number = np.arange(window.first, window.last)
        fresh = number > (self._number[-1] if len(self._number) else -1)
        self._number = np.append(self._number, number[fresh])
        self._pose = np.concatenate([self._pose, touch.world_from_peg[fresh]])
        self._wrench = np.concatenate([self._wrench, wrench[fresh]])
        self.windows.append(measurement)
        ends = cells_of(window)
        if len(ends):
            rows = torch.cat([self._rows(int(end)) for end in ends])
            # A wrench that is tared amid a probe may be so in contact: then it is felt where the peg is free.
            is_tared = not self.sensing.tare or self._number[0] < self.sensing.tare
            self.rows[len(self.windows) - 1] = rows if is_tared else rows[:0]

    def _tip(self, pose: Array) -> Array:
        """Positions (T, 3) of the peg's farthest vertex."""
        corners = self.sensing.peg.vertices
        tip = torch.from_numpy(corners[np.linalg.norm(corners, axis=1).argmax()])
        return np.asarray(poses.transform(torch.from_numpy(pose), tip[None])[:, 0].numpy())

    def _rows(self, end: int) -> Tensor:
        """The rows (R, COLUMNS) that are complete at the end of a cell."""
        settings, so_far = self.settings, self._number < end
        number = self._number[so_far]
        rows = self._extractor.rows(
            self.probe.stamps[number],
            self._pose[so_far],
            self._wrench[so_far],
            end == len(self.probe.stamps),
        )
        stamp = float(
            np.clip(
                position_noise(self._tip(self._pose[so_far])), 0.3 * settings.gap_noise, settings.gap_noise
            )
        )
        noise = np.hypot(stamp / np.sqrt(rows.stamps), settings.delay * rows.speed)
        columns = [rows.felt, noise, rows.force, rows.time, rows.episode, np.zeros(len(noise))]
        peg_from_world = poses.inverse(torch.from_numpy(rows.world_from_peg))[:, None]
        earlier = poses.compose(peg_from_world, torch.from_numpy(rows.earlier))
        twists = poses.local(poses.identity(), earlier).flatten(1).numpy()
        # Of an episode, in each cell, the row that is pressed hardest speaks of couples.
        turn = np.zeros((len(noise), 3))
        for episode in np.unique(rows.episode[rows.felt == 1.0]):
            own = np.flatnonzero(rows.episode == episode)
            hardest = own[[rows.force[own].argmax()]]
            turn[hardest] = turn_against(rows.wrench[hardest], self.sensing.peg)
        columns += [rows.wrench, np.zeros((len(noise), 6)), turn, rows.continues, twists]
        every = padded(torch.from_numpy(np.column_stack([rows.world_from_peg, *columns])), len(noise))
        return every if settings.free_space else every[every[:, FELT] == 1.0]
