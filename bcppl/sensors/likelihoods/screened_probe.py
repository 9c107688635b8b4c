"""A simulated probe, and what geometry says of the same touches: the one weighs what the other proposes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from bcppl.contact.nuisances import Nuisances
from bcppl.distributions.episodes import ContactEpisodes
from bcppl.distributions.episodes.rows import COLUMNS
from bcppl.errors import InputError
from bcppl.robot.motion import ProbeWindow
from bcppl.sensors.capabilities import Approximated, InHole
from bcppl.sensors.likelihoods.contact_probe import ContactProbe, TouchSettings
from bcppl.sensors.likelihoods.simulated_probe import ProbeSettings, SimulatedProbe
from bcppl.sensors.measurements import Recording
from bcppl.sensors.scene import Numbered

NOISE = 0.0001  # m, of the gap of a single row
TOUCHES = TouchSettings(profile="perfect")


class ScreenedProbe(SimulatedProbe):
    """A simulated probe that geometry proposes for, and screens: physics weighs.

    The gap between the peg as measured and the part (`ContactProbe`) takes a hundredth of a simulation's
    time. Where gaps are named as evidence they have sites of their own, `touch_*`. Where they are not, they
    are as unsure as the physics is (`normal_scale`) and guide proposals only, so that the measured pose is no
    evidence unless it is named.

    Args:
        recording, settings: as for `SimulatedProbe`; its evidence has the pose, the gaps or the wrench.
        touches: of the gaps.

    Attributes:
        geometry: the likelihood of the gaps.
    """

    __caches__ = ("_rows",)

    def __init__(
        self, recording: Recording, settings: ProbeSettings, touches: TouchSettings = TOUCHES
    ) -> None:
        super().__init__(recording, settings)
        self._gaps = "gaps" in settings.evidence
        if not self._gaps:
            touches = replace(touches, gap_noise=NOISE, gap_shared=settings.normal_scale)
        self.geometry = ContactProbe(recording, touches)
        self._rows: dict[bytes, Tensor] = {}

    def observe(self, number: int, action: ProbeWindow, world_from_part: Tensor) -> None:
        """As of `SimulatedProbe`, and of `ContactProbe` where gaps are evidence."""
        if self._gaps:
            self.geometry.observe(number, action, world_from_part)
        super().observe(number, action, world_from_part)

    def observed(self, measurements: Sequence[Numbered]) -> Mapping[str, Tensor]:
        """As of `SimulatedProbe`, and of `ContactProbe` where gaps are evidence."""
        values, rows = super().observed(measurements), self.geometry.observed(measurements)
        if self._gaps:
            return {**values, **rows}
        none = torch.empty(0, COLUMNS, dtype=torch.float64)
        for number, _ in measurements:
            own = rows.get(self.geometry.address(number), none)
            self._rows[_key(values[self.address(number)])] = own
        return values

    def given(self, nuisances: Nuisances) -> ScreenedProbe:
        """As of `SimulatedProbe`.

        Raises:
            InputError: gaps are evidence, and the peg's pose in the hand is latent.
        """
        if self._gaps and nuisances.grip_from_peg is not None:
            raise InputError(
                "a model whose peg may sit off in the hand is given the measured peg's gaps as evidence; "
                'name "pose" in place of "gaps".'
            )
        other = super().given(nuisances)
        assert isinstance(other, ScreenedProbe)
        return other

    # ---- of the gaps (`bcppl.sensors.capabilities.Linearised`, `Contacts`)

    def address(self, number: int) -> str:
        """The address of the site by whose value a window is known."""
        kind = "touch" if self._gaps else "peg" if "pose" in self.settings.evidence else "wrench"
        return f"{kind}_{number}"

    def is_informative(self, action: ProbeWindow, value: Tensor, part: Tensor) -> bool:
        """Whether the peg came near parts at poses (M, 7)."""
        return self.geometry.is_informative(action, self._rows_of(value), part)

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

    def at_mouth(self, measurements: Sequence[Approximated], part: Tensor) -> Tensor:
        """Poses (K, 7), turned as some (M, 7), whose hole has the tip of the peg in its mouth."""
        return self.geometry.at_mouth(self._in_rows(measurements), part)

    def _in_rows(self, measurements: Sequence[Approximated]) -> list[Approximated]:
        return [each._replace(value=self._rows_of(each.value)) for each in measurements]

    def _rows_of(self, value: Tensor) -> Tensor:
        return value if self._gaps else self._rows[_key(value)]


def simulated_probe(
    recording: Recording, settings: ProbeSettings, touches: TouchSettings = TOUCHES
) -> SimulatedProbe | None:
    """The likelihood of a recording's probes; None for one without.

    Raises:
        InputError: as of `SimulatedProbe`.
    """
    if not any(isinstance(m.action, ProbeWindow) for m in recording.measurements):
        return None
    # Contact locations alone do not tell one window without contact from another.
    if not {"pose", "gaps", "wrench"} & set(settings.evidence):
        return SimulatedProbe(recording, settings)
    return ScreenedProbe(recording, settings, touches)


def _key(value: Tensor) -> bytes:
    return value.numpy().tobytes()
