"""What a probe's stamps say of contact, in few rows: chosen by what they inform, at any rate."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from scipy.signal import savgol_coeffs, savgol_filter
from scipy.spatial.transform import Rotation
from torch import Tensor

from bcppl.arrays import Array, Indices
from bcppl.contact.sensing.contact_detection import ContactDetector

CELL = 0.5  # s: rows are complete at the end of each cell of a probe, or at its own
SHORTEST, LONGEST = 0.01, 0.1  # s of contact in one row
_GROWTH = 0.3  # of the time since the onset: rows are short where the force rises
_TRAVEL = 0.0025  # m that a peg moves within a row of contact, and
_MOVED, _SINCE = 0.001, 0.05  # m and s between rows without one
_FORCE, _SHARE = 1.5, 0.3  # N, and of the force, by which it changes within a row
_RESTING, _SLIDING = 0.01, 0.02  # m/s: below the one a peg rests, above the other it slides
_FRICTION = 0.5  # a peg that slides moves across its force by so much more than along it
_ASKEW = 0.3  # of an acceleration may be felt in any direction: the tool turns, and its mass lies elsewhere
_SMOOTH = 0.01  # s to either side of a stamp, over which velocity and acceleration are estimated
_AMID = 0.05  # s to either side of a stamp without contact, over which its pose is
_BREAK = 0.05  # s in which contact is not felt, by which it ends


class Rows(NamedTuple):
    """R rows: single stamps, or means of consecutive ones that hardly differ.

    Attributes:
        world_from_peg: (R, 7).
        felt: (R,) 1 for contact and 0 for none.
        stamps: (R,) how many.
        speed: (R,) m/s, in contact along its normal, at least.
        force: (R,) N.
        time: (R,) s.
        episode: (R,) the number of the contact, at rest or sliding, within a cell; -1 without contact.
        continues: (R,) 1 where the contact, at rest or sliding as before, is that of the episode before.
        wrench: (R, 6) on the peg, in its frame, N and N m.
        earlier: (R, K, 7) where the peg was, by each of the extractor's delays before.
    """

    world_from_peg: Array
    felt: Array
    stamps: Array
    speed: Array
    force: Array
    time: Array
    episode: Array
    continues: Array
    wrench: Array
    earlier: Array


def cell_ends(stamps: Array) -> Indices:
    """The number of stamps (C,) up to the end of each cell of a probe that has stamps (T,)."""
    cell = np.floor((stamps - stamps[0]) / CELL + 1e-6)
    return np.append(np.flatnonzero(np.diff(cell)) + 1, len(stamps))


class _Stamps(NamedTuple):
    """All stamps so far: `force` is its size (N), `pace` the peg's speed (m/s)."""

    time: Array
    pose: Array
    felt: Array
    force: Array
    pace: Array


class _Group(NamedTuple):
    """The stamps of a row."""

    stamps: slice
    felt: float
    episode: int = -1
    continues: bool = False


@dataclass
class EpisodeExtractor:
    """Rows of one probe, cell by cell; they depend on no later stamp, and not on how the probe is cut.

    Attributes:
        detector: force thresholds.
        step: s between stamps.
        delays: (K,) s, increasing, by which the wrench may be later than the pose.
    """

    detector: ContactDetector
    step: float
    delays: tuple[float, ...] = ()
    _done: float = -math.inf  # s: rows of stamps up to here are returned
    _episode: int = -1
    _onset: float = -math.inf
    _last_contact: float = -math.inf
    _begins: bool = True  # a cell, and so an episode
    _moving: bool = False
    _continues: bool = False
    _last_free: tuple[float, Array] | None = None

    @property
    def _half(self) -> int:
        """Stamps to either side of one over which velocity and acceleration are estimated."""
        return max(1, round(_SMOOTH / self.step))

    @property
    def _amid(self) -> int:
        """The same over which the pose of one amid free motion is estimated."""
        return max(1, round(_AMID / self.step))

    @property
    def _lag(self) -> float:
        """Seconds after which a stamp and the one after it are decided: what comes later changes nothing."""
        around = max(self._half, self._amid, round(self.detector.agreement / self.step))
        return self.step * (1 + around)

    def rows(self, time: Array, pose: Array, wrench: Array, last: bool) -> Rows:
        """The rows that are complete, of all stamps so far.

        Args:
            time: (T,) s.
            pose: (T, 7) world_from_peg.
            wrench: (T, 6) tared, in the peg's frame, N and N m; NaN while taring.
            last: whether the probe ends here.
        """
        until = math.inf if last or not len(time) else time[-1] - self._lag + 1e-6
        felt, speed, pace = self._decided(time, pose, wrench[:, :3])
        size = np.linalg.norm(wrench[:, :3], axis=1)
        seen = _Stamps(time, pose, felt, size, pace)
        groups: list[_Group] = []
        begin = int(np.searchsorted(time, self._done, side="right"))
        end = int(np.searchsorted(time, until, side="right"))
        k = begin
        while k < end:
            if felt[k] == 1.0:
                stop = self._contact_row(k, end, seen)
                groups.append(_Group(slice(k, stop), 1.0, self._episode, self._continues))
                k = stop
                continue
            if felt[k] == 0.0 and self._is_new(k, time, pose, felt):
                groups.append(_Group(slice(k, k + 1), 0.0))
                self._last_free = time[k], pose[k, :3]
            k += 1
        self._done = float(time[end - 1]) if end > begin else self._done
        self._begins = True
        return self._with_free(_rows(groups, time, pose, size, speed, wrench, self.delays), groups, seen)

    def _with_free(self, rows: Rows, groups: list[_Group], seen: _Stamps) -> Rows:
        """The rows, those amid free motion by parabolas through the stamps on either side.

        There the peg is free before and after: how late the wrench is does not matter.
        """
        width = 2 * self._amid + 1
        free = np.flatnonzero(rows.felt == 0.0)
        if len(seen.time) < width or not len(free):
            return rows
        middle = np.array([groups[k].stamps.start for k in free])
        first, last = middle - self._amid, middle + self._amid
        inside = (first >= 0) & (last < len(seen.time))
        first, last = np.where(inside, first, 0), np.where(inside, last, 0)
        touched = np.append(0, np.cumsum(seen.felt != 0.0))
        inside &= touched[last + 1] == touched[first]
        inside &= seen.time[last] - seen.time[first] < (width - 0.5) * self.step
        free, middle = free[inside], middle[inside]
        smooth = savgol_filter(_continuous(seen.pose), width, 2, axis=0)[middle]
        smooth[:, 3:] /= np.linalg.norm(smooth[:, 3:], axis=1, keepdims=True)
        rows.world_from_peg[free], rows.speed[free] = smooth, 0.0
        rows.stamps[free] = 1.0 / (savgol_coeffs(width, 2) ** 2).sum()
        return rows

    def _contact_row(self, first: int, end: int, seen: _Stamps) -> int:
        """The index after a row's last stamp; the row's episode is `_episode`."""
        now = seen.time[first]
        between = (seen.time > self._last_contact) & (seen.time < now)
        broken = now - self._last_contact > max(_BREAK, 1.5 * self.step) or (seen.felt[between] == 0.0).any()
        if broken:
            self._onset = now
        longest = min(LONGEST, max(SHORTEST, _GROWTH * (now - self._onset)))
        stop = first + 1
        while stop < end and seen.felt[stop] == 1.0 and seen.time[stop] - now < longest - 1e-6:
            moved = np.linalg.norm(seen.pose[stop, :3] - seen.pose[first, :3])
            force = abs(seen.force[stop] - seen.force[first])
            changed = moved > _TRAVEL or force > max(_FORCE, _SHARE * seen.force[first])
            if changed and seen.time[stop] - now > SHORTEST - 1e-6:
                break
            stop += 1
        moving = seen.pace[first:stop].mean() > (_RESTING if self._moving else _SLIDING)
        other = broken or moving != self._moving
        if other or self._begins:
            self._episode, self._continues = self._episode + 1, not other
        self._moving, self._last_contact, self._begins = moving, seen.time[stop - 1], False
        return stop

    def _is_new(self, k: int, time: Array, pose: Array, felt: Array) -> bool:
        """Whether a stamp without contact informs: the peg has moved on, or contact comes next."""
        if k + 1 < len(time) and felt[k + 1] != 0.0:
            return True
        if self._last_free is None:
            return True
        then, place = self._last_free
        return time[k] - then > _SINCE - 1e-6 and bool(np.linalg.norm(pose[k, :3] - place) > _MOVED)

    def _decided(self, time: Array, pose: Array, force: Array) -> tuple[Array, Array, Array]:
        """1, 0 or NaN (T,) for contact, none and undecided; the speed of `Rows`, and the whole one."""
        felt, speed, pace = np.full(len(time), np.nan), np.zeros(len(time)), np.zeros(len(time))
        if not len(time):
            return felt, speed, pace
        breaks = np.flatnonzero(np.diff(time) > 1.5 * self.step) + 1
        for part in np.split(np.arange(len(time)), breaks):
            velocity, acceleration = self._derivatives(pose[part, :3])
            world = Rotation.from_quat(pose[part][:, [4, 5, 6, 3]]).apply(np.nan_to_num(force[part]))
            inertial = self._inertial(acceleration, world)
            felt[part] = self.detector(torch.from_numpy(force[part]), inertial, self.step).numpy()
            size = np.linalg.norm(world, axis=1)
            pace[part] = whole = np.linalg.norm(velocity, axis=1)
            along = np.abs(np.einsum("ij,ij->i", velocity, world)) / np.maximum(size, 1e-9)
            across = np.sqrt(np.maximum(whole**2 - along**2, 0.0))
            speed[part] = np.where(felt[part] == 1.0, np.maximum(along - _FRICTION * across, 0.0), whole)
        return felt, speed, pace

    def _inertial(self, acceleration: Array, force: Array) -> Tensor:
        """(T,) the largest acceleration (m/s^2) that may be felt at each stamp, of (T, 3) in the world.

        A wrench that may be late feels one of those before, against which the tool's inertia acts: the force
        (T, 3) has a direction, and only what it opposes counts in full.
        """
        size = np.linalg.norm(acceleration, axis=1)
        if not self.delays:
            return torch.from_numpy(size)
        late = round(self.delays[-1] / self.step)
        seen = np.pad(acceleration, ((late, 0), (0, 0)), mode="edge")
        windows = np.lib.stride_tricks.sliding_window_view(seen, late + 1, axis=0)  # (T, 3, K)
        direction = force / np.maximum(np.linalg.norm(force, axis=1, keepdims=True), 1e-9)
        opposed = -np.einsum("tak,ta->tk", windows, direction)
        largest = np.linalg.norm(windows, axis=1).max(axis=1)
        return torch.from_numpy(np.maximum(opposed.max(axis=1), _ASKEW * largest))

    def _derivatives(self, place: Array) -> tuple[Array, Array]:
        """Velocity and acceleration (T, 3) of a peg at (T, 3), by parabolas."""
        width = 2 * self._half + 1
        if len(place) < width:
            return np.zeros_like(place), np.zeros_like(place)
        velocity, acceleration = (
            savgol_filter(place, width, 2, deriv=order, delta=self.step, axis=0) for order in (1, 2)
        )
        return velocity, acceleration


def _rows(
    groups: list[_Group],
    time: Array,
    pose: Array,
    size: Array,
    speed: Array,
    wrench: Array,
    delays: tuple[float, ...],
) -> Rows:
    slices = [group.stamps for group in groups]

    def averaged(values: Array) -> Array:
        each = [values[own].mean(axis=0) for own in slices]
        return np.array(each).reshape(len(slices), *values.shape[1:])

    smooth = _continuous(pose)
    earlier = np.empty((len(groups), len(delays), 7))
    for k, delay in enumerate(delays if groups else ()):  # without stamps nothing lies between them
        then = [np.interp(time - delay, time, column) for column in smooth.T]
        earlier[:, k] = averaged(np.column_stack(then))
    mean = averaged(smooth)
    for place in (mean, earlier):
        place[..., 3:] /= np.linalg.norm(place[..., 3:], axis=-1, keepdims=True)
    return Rows(
        mean,
        np.array([group.felt for group in groups]),
        np.array([own.stop - own.start for own in slices], dtype=np.float64),
        averaged(speed),
        averaged(size),
        averaged(time),
        np.array([group.episode for group in groups], dtype=np.float64),
        np.array([group.continues for group in groups], dtype=np.float64),
        averaged(wrench),
        earlier,
    )


def _continuous(pose: Array) -> Array:
    """Poses (T, 7) of which no quaternion changes its sign."""
    smooth = pose.copy()
    turned = (pose[1:, 3:] * pose[:-1, 3:]).sum(axis=1) < 0.0
    smooth[1:, 3:] *= np.cumprod(np.where(turned, -1.0, 1.0))[:, None]
    return smooth
