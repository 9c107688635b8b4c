"""A compliant motion as an arm was commanded to make it, and when it was read."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Probe:
    """A compliant motion: the peg, held by a Cartesian spring-damper, follows a commanded trajectory.

    Attributes:
        name: windows of the same probe carry the same name and share one simulation.
        command_times: (C,) seconds, increasing; the command is interpolated between them
            (translations linearly, rotations along the geodesic).
        command: (C, 7) commanded `world_from_peg`.
        stiffness: (6,) N/m along, then N m/rad about, the commanded peg's axes.
        damping: (6,) N s/m, then N m s/rad.
        stamps: (T,) seconds at which wrench and peg pose are read, over the whole probe.
    """

    name: str
    command_times: Array
    command: Array
    stiffness: Array
    damping: Array
    stamps: Array


@dataclass(frozen=True, eq=False)
class ProbeWindow:
    """Action: a stretch of a probe, stamps `first` to `last` (exclusive) of `probe.stamps`."""

    probe: Probe
    first: int
    last: int
