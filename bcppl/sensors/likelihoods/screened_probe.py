"""A simulated probe, and what geometry says of the same touches: the one weighs what the other proposes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import torch
from torch import Tensor

from bcppl.distributions.episodes import ContactEpisodes
from bcppl.distributions.episodes.rows import COLUMNS
from bcppl.robot.motion import ProbeWindow
from bcppl.sensors.capabilities import Approximated, InHole
from bcppl.sensors.likelihoods.contact_probe import ContactProbe, TouchSettings
from bcppl.sensors.likelihoods.simulated_probe import ProbeSettings, SimulatedProbe
from bcppl.sensors.measurements import Recording
from bcppl.sensors.scene import Numbered

NOISE = 0.0001  # m, of the gap of a single row


class ScreenedProbe(SimulatedProbe):
    """`SimulatedProbe` with the peg's pose as evidence: geometry proposes and screens, physics weighs.

    The gap between the peg as measured and the part (`ContactProbe`) takes a hundredth of a simulation's
    time. It is as unsure as the physics is (`normal_scale`), and guides proposals only: no site is its.

    Attributes:
        geometry: the likelihood of the gaps.
    """

    __caches__ = ("_rows",)

    def __init__(self, recording: Recording, settings: ProbeSettings) -> None:
        super().__init__(recording, settings)
        touches = TouchSettings(profile="perfect", gap_noise=NOISE, gap_shared=settings.normal_scale)
        self.geometry = ContactProbe(recording, touches)
        self._rows: dict[bytes, Tensor] = {}

    def observed(self, measurements: Sequence[Numbered]) -> Mapping[str, Tensor]:
        """As of `SimulatedProbe`."""
        values, rows = super().observed(measurements), self.geometry.observed(measurements)
        none = torch.empty(0, COLUMNS, dtype=torch.float64)
        for number, _ in measurements:
            own = rows.get(self.geometry.address(number), none)
            self._rows[_key(values[self.address(number)])] = own
        return values

    # ---- of the gaps (`bcppl.sensors.capabilities.Linearised`, `Contacts`)

    def address(self, number: int) -> str:
        """The address of the site by whose value a window is known."""
        return f"peg_{number}"

    def is_informative(self, action: ProbeWindow, value: Tensor, part: Tensor) -> bool:
        """Whether the peg came near parts at poses (M, 7)."""
        return self.geometry.is_informative(action, self._rows[_key(value)], part)

    def sites(
        self, measurements: Sequence[Approximated], part: Tensor, blur: float
    ) -> Iterator[tuple[ContactEpisodes, Tensor]]:
        """The likelihood of all probes' gaps at poses (S, 7), and their rows."""
        return self.geometry.sites(self._in_rows(measurements), part, blur)

    def new_contact(self, measurements: Sequence[Approximated], newest: bool) -> bool:
        """Whether contact begins in one of the windows, or in the newest of them."""
        return self.geometry.new_contact(self._in_rows(measurements), newest)

    def heading(self, measurements: Sequence[Approximated]) -> Tensor | None:
        """The direction (3,) in which the peg moved when contact last began; None without contact."""
        return self.geometry.heading(self._in_rows(measurements))

    def in_hole(self, measurements: Sequence[Approximated], part: Tensor) -> InHole:
        """Poses near some (M, 7) that have the hole where the peg would lie deep in the material."""
        return self.geometry.in_hole(self._in_rows(measurements), part)

    def _in_rows(self, measurements: Sequence[Approximated]) -> list[Approximated]:
        return [each._replace(value=self._rows[_key(each.value)]) for each in measurements]


def simulated_probe(recording: Recording, settings: ProbeSettings) -> SimulatedProbe | None:
    """The likelihood of a recording's probes; None for one without.

    Raises:
        InputError: as of `SimulatedProbe`.
    """
    if not any(isinstance(m.action, ProbeWindow) for m in recording.measurements):
        return None
    kind = ScreenedProbe if "pose" in settings.evidence else SimulatedProbe
    return kind(recording, settings)


def _key(value: Tensor) -> bytes:
    return value.numpy().tobytes()
