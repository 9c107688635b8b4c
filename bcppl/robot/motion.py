"""Compliant motions: commanded trajectories with the stamps of their measurements."""

from __future__ import annotations

from dataclasses import dataclass

from bcppl.arrays import Array, as_array, spanned


@dataclass(frozen=True, eq=False, repr=False)
class Probe:
    """A compliant motion: the peg follows a commanded trajectory under Cartesian impedance control.

    Attributes:
        name: windows of one probe have the same name and share one simulation.
        command_times: (C,) seconds, increasing; the command is interpolated between them
            (translations linearly, rotations along the geodesic).
        command: (C, 7) commanded `world_from_peg`.
        stiffness: (6,) N/m along, then N m/rad about, the commanded peg's axes.
        damping: (6,) N s/m, then N m s/rad.
        stamps: (T,) times at which wrench and peg pose are measured, over the whole probe, seconds.
    """

    name: str
    command_times: Array
    command: Array
    stiffness: Array
    damping: Array
    stamps: Array

    def __post_init__(self) -> None:
        for name in ("command_times", "command", "stiffness", "damping", "stamps"):
            object.__setattr__(self, name, as_array(getattr(self, name)))

    def __repr__(self) -> str:
        return f"Probe({self.name!r}, {spanned(self.stamps)})"


@dataclass(frozen=True, eq=False, repr=False)
class ProbeWindow:
    """Action: a window of a probe, stamps `first` to `last` (exclusive) of `probe.stamps`."""

    probe: Probe
    first: int
    last: int

    def __repr__(self) -> str:
        return f"ProbeWindow({self.probe.name!r}, {spanned(self.probe.stamps[self.first : self.last])})"
