"""Likelihood of a compliant probe by the contact manifold: nothing is simulated (slow, guarded touches)."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import pyro
import torch
from torch import Tensor

from bcppl.arguments import number_within, whole_number
from bcppl.contact.quasi_static import QuasiStaticMotion, WindowMotion
from bcppl.contact.sensing.contact_detection import ContactDetector, commanded_acceleration
from bcppl.contact.sensing.location import ContactSensing
from bcppl.distributions.manifold import ContactManifold, Gaps, MeasuresGap
from bcppl.effort import Effort
from bcppl.errors import InputError
from bcppl.geometry.gap import PegGap
from bcppl.geometry.parts import Part
from bcppl.robot.motion import ProbeWindow
from bcppl.sensors.capabilities import Approximated
from bcppl.sensors.measurements import Recording
from bcppl.sensors.scene import Numbered, by_probe

_NEAR = 0.02  # m: a window in which the peg stays farther away carries no information
_MOVED = 0.001  # m: a shorter displacement has no direction


@dataclass(frozen=True)
class TouchSettings:
    """Noise of the peg's measured pose in contact, and how contact is detected.

    Attributes:
        gap_noise: standard deviation of the peg's surface position at one stamp, m.
        gap_shared: standard deviation of the error that all contacts of a window share, m.
        sink: penetration at the forces of a probe, m.
        gap_outlier: probability that a stamp, or all contacts of a window, are outliers.
        every: stride of the stamps that are used.
        contact_detector: force thresholds of contact and of free motion.
        free_space: whether stamps without contact count, which exclude the part from where the peg moved.
    """

    gap_noise: float = 0.00006
    gap_shared: float = 0.00001
    sink: float = 0.00002
    gap_outlier: float = 0.001
    every: int = 5
    contact_detector: ContactDetector = field(default_factory=ContactDetector)
    free_space: bool = True

    def __post_init__(self) -> None:
        number_within("a contact probe is given gap_noise {}", self.gap_noise, above=0.0)
        whole_number("a contact probe is given every {}", self.every)


@lru_cache(maxsize=4)
def _solids(part: Part, peg: Part) -> tuple[PegGap, QuasiStaticMotion]:
    """Distances between two solids, prepared once for all scenes of the same two."""
    gap = PegGap(part, peg)
    return gap, QuasiStaticMotion(gap)


class ContactProbe:
    """Windows of a probe, by the distance between the measured peg and the part.

    Where contact is felt that distance is zero, elsewhere it is positive (`ContactManifold`). Each window has
    one site, `touch_*`, observed as (T, 8): the peg's pose, then 1 with contact, 0 without, NaN if undecided.

    Args:
        recording: its part, peg and probes.
        settings: of the touches.

    Raises:
        InputError: the recording has no peg.
    """

    def __init__(self, recording: Recording, settings: TouchSettings) -> None:
        if recording.peg is None:
            raise InputError("the recording has probe windows but no peg; add the peg that was held.")
        self.settings = settings
        self.gap, self.quasi_static = _solids(recording.part, recording.peg)
        windows = [m.action for m in recording.measurements if isinstance(m.action, ProbeWindow)]
        self.sensing = (
            ContactSensing(recording.peg, rate=1.0 / float(np.median(np.diff(windows[0].probe.stamps))))
            if windows
            else None
        )

    @classmethod
    def prepare(cls, recording: Recording, settings: TouchSettings) -> ContactProbe | None:
        """The likelihood of a recording's touches; None for one without peg and touches."""
        touched = any(isinstance(m.action, ProbeWindow) for m in recording.measurements)
        return cls(recording, settings) if touched or recording.peg is not None else None

    @property
    def efforts(self) -> Mapping[str, Effort]:
        """The cost of distances."""
        return {"gap": self.gap.effort}

    # ---- the program's sites

    def observe(self, number: int, action: ProbeWindow, world_from_part: Tensor) -> None:
        """Sample `touch_*`."""
        pyro.sample(f"touch_{number}", self.site(action, world_from_part))

    def site(
        self, window: ProbeWindow, part: Tensor, blur: float = 0.0, gap: MeasuresGap | None = None
    ) -> ContactManifold:
        """The likelihood of a window for parts at poses (N, 7), its errors `blur` metres wider."""
        settings = self.settings
        return ContactManifold(
            self.gap if gap is None else gap,
            part,
            len(range(window.first, window.last, settings.every)),
            math.hypot(settings.gap_noise, blur),
            math.hypot(settings.gap_shared, blur),
            settings.sink,
            settings.gap_outlier,
            WindowMotion(self.quasi_static, window, settings.every),
        )

    def observed(self, measurements: Sequence[Numbered]) -> Mapping[str, Tensor]:
        """The peg's poses, and whether contact is felt, by address; each probe's wrench is tared whole."""
        return {a: v for windows in by_probe(measurements) for a, v in self._of_probe(windows)}

    def _of_probe(self, windows: Sequence[Numbered]) -> Iterator[tuple[str, Tensor]]:
        assert self.sensing is not None
        touches = [measurement.observation for _, measurement in windows]
        tared = self.sensing.tared(touches)
        commanded = commanded_acceleration([measurement.action for _, measurement in windows])
        flags = self.settings.contact_detector(torch.cat(tared)[:, :3], commanded)
        if not self.settings.free_space:
            flags = torch.where(flags == 0.0, torch.nan, flags)
        each = flags[:, None].split([len(wrench) for wrench in tared])
        for (number, _), touch, own in zip(windows, touches, each, strict=True):
            rows = torch.cat([torch.from_numpy(np.array(touch.world_from_peg)), own], dim=1)
            yield f"touch_{number}", rows[:: self.settings.every]

    # ---- a quadratic approximation of the likelihood (`bcppl.sensors.capabilities.Linearised`)

    def address(self, number: int) -> str:
        """The address of a window's site."""
        return f"touch_{number}"

    def is_informative(self, action: ProbeWindow, value: Tensor, part: Tensor) -> bool:
        """Whether the peg came within 20 mm of parts at poses (M, 7)."""
        return bool((self.gap(part, value[:, :7]).distance < _NEAR).any())

    def sites(
        self, measurements: Sequence[Approximated], part: Tensor, blur: float
    ) -> Iterator[tuple[ContactManifold, Tensor]]:
        """Each window's likelihood at poses (S, 7), all distances computed in one batch, and its value."""
        gaps = self.gap(part, torch.cat([value[:, :7] for _, _, value in measurements]))
        gradients, begin = gaps.gradient(part), 0
        for _, action, value in measurements:
            used = begin + torch.nonzero(~torch.isnan(value[:, 7]))[:, 0]
            begin += len(value)
            yield self.site(action, part, blur, _Measured(gaps.distance[:, used], gradients[:, used])), value

    def new_contact(self, measurements: Sequence[Approximated], newest: bool) -> bool:
        """Whether contact begins in one of the windows, or in the newest of them."""
        if not measurements:
            return False
        felt = torch.cat([torch.zeros(1, dtype=torch.bool), *(v[:, 7] == 1.0 for _, _, v in measurements)])
        onsets = felt[1:] & ~felt[:-1]
        return bool((onsets[-len(measurements[-1].value) :] if newest else onsets).any())

    def heading(self, measurements: Sequence[Approximated]) -> Tensor | None:
        """The direction (3,) in which the peg moved when contact last began; None without contact."""
        rows = torch.cat([value for _, _, value in measurements])
        felt = rows[:, 7] == 1.0
        onsets = torch.nonzero(felt[1:] & ~felt[:-1])[:, 0]
        if len(onsets) == 0:
            return None
        last = int(onsets[-1])
        way = rows[last + 1, :3] - rows[max(0, last - 2), :3]
        return way / way.norm() if float(way.norm()) > _MOVED else None


class _Measured(NamedTuple):
    """Distances that are known already, in place of what measures them."""

    distance: Tensor
    gradients: Tensor

    def gradient(self, world_from_part: Tensor) -> Tensor:
        return self.gradients

    def __call__(self, world_from_part: Tensor, world_from_peg: Tensor) -> Gaps:
        return self
