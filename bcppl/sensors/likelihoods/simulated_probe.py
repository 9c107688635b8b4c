"""Likelihood of a compliant probe by contact physics: BayesContact's Chamfer surrogate and the peg's pose."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from functools import partial

import numpy as np
import pyro
import torch
from torch import Tensor

from bcppl.arguments import number_within, whole_number
from bcppl.contact.mujoco_model import ContactParameters
from bcppl.contact.nuisances import Nuisances
from bcppl.contact.physics import PegPhysics
from bcppl.contact.probe_rollout import ProbeRollout
from bcppl.contact.sensing.location import ContactSensing
from bcppl.distributions.contact import ChamferContacts, PegPose
from bcppl.distributions.episodes import ContactEpisodes
from bcppl.distributions.episodes.rows import COLUMNS
from bcppl.effort import Effort
from bcppl.errors import InputError
from bcppl.robot.motion import ProbeWindow
from bcppl.sensors.capabilities import Approximated
from bcppl.sensors.likelihoods.contact_probe import ContactProbe, TouchSettings
from bcppl.sensors.measurements import Recording
from bcppl.sensors.scene import Numbered, by_probe, require_positive
from bcppl.traces.carried import carried

# Gaps that are as unsure as the physics: they lead proposals to where it will weigh them.
_GEOMETRY = TouchSettings(profile="perfect", gap_noise=0.0001, gap_shared=0.0003)
# The contact that inference assumes. Worlds that simulate recordings have parameters of their own.
CONTACT = ContactParameters(time_step=0.004, friction=0.3, time_constant=0.008)


@dataclass(frozen=True)
class ProbeSettings:
    """Noise of a simulated probe.

    Attributes:
        contact_scale: sigma of the Chamfer surrogate, metres.
        one_empty: its cost where only one of the two point sets is empty, square metres.
        translation_scale, rotation_scale: standard deviations of the peg's pose, metres and radians: the
            error of the physics' friction and stiffness, larger than the sensor's noise.
        normal_scale: of its position along the contact's force, and in all directions where it touches
            nothing, metres.
        pose_every: stride of the stamps at which the peg's pose counts.
        contact: parameters of the physics.
    """

    contact_scale: float = 0.003
    one_empty: float = 2.0 * 0.005**2
    translation_scale: float = 0.0012
    rotation_scale: float = 0.005
    normal_scale: float = 0.0003
    pose_every: int = 25
    contact: ContactParameters = CONTACT

    def __post_init__(self) -> None:
        require_positive(self, "contact_scale", "translation_scale", "rotation_scale", "normal_scale")
        number_within("a simulated probe is given one_empty {}", self.one_empty, least=0.0)
        whole_number("a simulated probe is given pose_every {}", self.pose_every)


class SimulatedProbe:
    """Windows of a probe, simulated for every pose of the part; windows of one probe share one rollout.

    Each window has two sites: `contacts_*`, the contact locations in the peg's frame (a surrogate), and
    `peg_*`, its pose (a density). A window without contact is evidence that nothing was in the way.

    Args:
        recording: its part, peg and probes.
        settings: of the probe.

    Raises:
        InputError: the recording has no peg, or the part cannot be touched in simulation.
    """

    __caches__ = ("_rows",)

    nuisances: Nuisances | None

    def __init__(self, recording: Recording, settings: ProbeSettings) -> None:
        if recording.peg is None:
            raise InputError("the recording has probe windows but no peg; add the peg that was held.")
        windows = [m.action for m in recording.measurements if isinstance(m.action, ProbeWindow)]
        self.settings, self.nuisances = settings, None
        self.geometry = ContactProbe(recording, _GEOMETRY)
        self._rows: dict[bytes, Tensor] = {}
        self.physics = PegPhysics(recording.part, recording.peg, settings.contact)
        rate = 1.0 / float(np.median(np.diff(windows[0].probe.stamps)))
        self.sensing = ContactSensing(recording.peg, rate=rate)

    @classmethod
    def prepare(cls, recording: Recording, settings: ProbeSettings) -> SimulatedProbe | None:
        """The likelihood of a recording's probes; None for one without."""
        touched = any(isinstance(m.action, ProbeWindow) for m in recording.measurements)
        return cls(recording, settings) if touched else None

    @property
    def efforts(self) -> Mapping[str, Effort]:
        """The cost of physics."""
        return {"physics": self.physics.effort}

    def grasping(self, grip_from_peg: Tensor) -> SimulatedProbe:
        """The same with the peg's surface at poses (N, 7) in the grip's frame."""
        return self.given(Nuisances(grip_from_peg=grip_from_peg))

    def given(self, nuisances: Nuisances) -> SimulatedProbe:
        """The same, given nuisance parameters of the contact, one value for each particle."""
        other = copy(self)
        other.nuisances = nuisances
        return other

    def rollout(self, action: ProbeWindow, world_from_part: Tensor) -> ProbeRollout:
        """The rollout of a window's probe for parts at poses (N, 7), which all its windows share."""
        nuisances = self.nuisances
        own = () if nuisances is None else (nuisances,)
        begin = partial(ProbeRollout.start, self.physics, self.sensing, world_from_part, action.probe, *own)
        return carried(f"probe {action.probe.name}", begin)

    def observe(self, number: int, action: ProbeWindow, world_from_part: Tensor) -> None:
        """Sample `contacts_*` and `peg_*`."""
        settings = self.settings
        window = (self.rollout(action, world_from_part), action.first, action.last)
        pyro.sample(
            f"contacts_{number}", ChamferContacts(*window, settings.contact_scale, settings.one_empty)
        )
        peg = PegPose(
            *window,
            settings.translation_scale,
            settings.rotation_scale,
            settings.pose_every,
            settings.normal_scale,
        )
        pyro.sample(f"peg_{number}", peg)

    def observed(self, measurements: Sequence[Numbered]) -> Mapping[str, Tensor]:
        """Contact locations and peg poses, by address; each probe's wrench is filtered whole."""
        values: dict[str, Tensor] = {}
        for windows in by_probe(measurements):
            read = self.sensing.measure([measurement.observation for _, measurement in windows])
            for (number, _), (contacts, peg) in zip(windows, read, strict=True):
                values[f"contacts_{number}"], values[f"peg_{number}"] = contacts, peg
        rows = self.geometry.observed(measurements)
        for number, _ in measurements:
            own = rows.get(self.geometry.address(number), torch.empty(0, COLUMNS, dtype=torch.float64))
            self._rows[_key(values[self.address(number)])] = own
        return values

    # ---- what geometry says of the same touches (`bcppl.sensors.capabilities.Linearised`, `Contacts`)

    def address(self, number: int) -> str:
        """The address of the site by whose value a window is known."""
        return f"peg_{number}"

    def _geometric(self, measurements: Sequence[Approximated]) -> list[Approximated]:
        return [each._replace(value=self._rows[_key(each.value)]) for each in measurements]

    def is_informative(self, action: ProbeWindow, value: Tensor, part: Tensor) -> bool:
        """Whether the peg came near parts at poses (M, 7)."""
        return self.geometry.is_informative(action, self._rows[_key(value)], part)

    def sites(
        self, measurements: Sequence[Approximated], part: Tensor, blur: float
    ) -> Iterator[tuple[ContactEpisodes, Tensor]]:
        """The likelihood of all probes' gaps at poses (S, 7), and their rows."""
        return self.geometry.sites(self._geometric(measurements), part, blur)

    def new_contact(self, measurements: Sequence[Approximated], newest: bool) -> bool:
        """Whether contact begins in one of the windows, or in the newest of them."""
        return self.geometry.new_contact(self._geometric(measurements), newest)

    def heading(self, measurements: Sequence[Approximated]) -> Tensor | None:
        """The direction (3,) in which the peg moved when contact last began; None without contact."""
        return self.geometry.heading(self._geometric(measurements))


def _key(value: Tensor) -> bytes:
    return value.numpy().tobytes()
