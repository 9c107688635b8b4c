"""Likelihood of a compliant probe by contact physics: contact locations, the peg's pose, the wrench."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial

import pyro
import pyro.distributions as dist
from torch import Tensor

from bcppl.contact.mujoco_model import ContactParameters
from bcppl.contact.nuisances import Nuisances
from bcppl.contact.physics import PegPhysics
from bcppl.contact.probe_rollout import ProbeRollout
from bcppl.contact.sensing.location import ContactSensing
from bcppl.distributions.contact import ChamferContacts, ContactsInTime, PegPose, Wrench
from bcppl.distributions.parameters import COUNT, NONNEGATIVE, POSITIVE, check_parameters, within
from bcppl.effort import Effort
from bcppl.errors import InputError
from bcppl.geometry.parts import Part
from bcppl.robot.motion import Probe, ProbeWindow
from bcppl.sensors.likelihoods.probe_rows import step_of
from bcppl.sensors.measurements import Recording
from bcppl.sensors.scene import Numbered, by_probe
from bcppl.traces.carried import carried, once

# The contact that inference assumes. Worlds that simulate recordings have parameters of their own.
CONTACT = ContactParameters(time_step=0.004, friction=0.3, time_constant=0.008)
MEDIAN_AND_SPREAD = within(above=0.0, count=2, optional=True)
EVIDENCE = ("contacts", "contacts in time", "pose", "gaps", "wrench")
_CUTOFF = 20.0  # Hz, of the wrench's filter before contact is located
_SAME_RATE = 0.02  # of a rate: as `ContactSensing.check_rate` has it


@dataclass(frozen=True)
class ProbeSettings:
    """Noise of a simulated probe.

    Attributes:
        evidence: what of a probe is explained, of `EVIDENCE`: contact locations, by the Chamfer surrogate or
            by a normalised likelihood; the peg's pose, by physics or by its gaps to the part, which needs
            none (`ContactProbe`); the wrench.
        contact_scale: sigma of the Chamfer surrogate, and standard deviation of a location in time, metres.
        torque_noise: of the sensor, N m: over the force it adds to the deviation of a location in time.
        one_empty: the surrogate's cost where only one of the two point sets is empty, square metres.
        translation_scale, rotation_scale: standard deviations of the peg's pose, metres and radians: the
            error of the physics' friction and stiffness, larger than the sensor's noise.
        normal_scale: of its position along the contact's normal, metres.
        free_scale: of its position where it touches nothing, metres.
        force_scale, torque_scale: of the wrench, N and N m; `wrench_share` of its size is added.
        pose_every: stride of the stamps at which the pose counts.
        wrench_every: of those at which wrench and locations in time count. The error of physics is common to
            the stamps of one touch: more would make the belief surer than it may be.
        friction: median of a latent coefficient of friction, and the standard deviation of its natural
            logarithm; None for that of `contact`.
        time_constant: the same of the contact's, s.
        contact: parameters of the physics.

    Raises:
        InputError: a number is out of range, or there is no such evidence.
    """

    evidence: tuple[str, ...] = ("gaps", "contacts")
    contact_scale: float = field(default=0.003, metadata=POSITIVE)
    torque_noise: float = field(default=0.005, metadata=NONNEGATIVE)
    one_empty: float = field(default=2.0 * 0.005**2, metadata=POSITIVE)
    translation_scale: float = field(default=0.0012, metadata=POSITIVE)
    rotation_scale: float = field(default=0.005, metadata=POSITIVE)
    normal_scale: float = field(default=0.00006, metadata=POSITIVE)
    free_scale: float = field(default=0.0003, metadata=POSITIVE)
    force_scale: float = field(default=1.0, metadata=POSITIVE)
    torque_scale: float = field(default=0.05, metadata=POSITIVE)
    wrench_share: float = field(default=0.3, metadata=NONNEGATIVE)
    pose_every: int = field(default=25, metadata=COUNT)
    wrench_every: int = field(default=25, metadata=COUNT)
    friction: tuple[float, float] | None = field(default=None, metadata=MEDIAN_AND_SPREAD)
    time_constant: tuple[float, float] | None = field(default=None, metadata=MEDIAN_AND_SPREAD)
    contact: ContactParameters = CONTACT

    def __post_init__(self) -> None:
        check_parameters(self)
        unknown = [name for name in self.evidence if name not in EVIDENCE]
        both = "contacts" in self.evidence and "contacts in time" in self.evidence
        if unknown or both or not self.evidence:
            raise InputError(
                f"a simulated probe is explained by the evidence {self.evidence}; name one or more of "
                f"{', '.join(EVIDENCE)}, and contact locations once."
            )


@lru_cache(maxsize=16)
def _sensing(peg: Part, rate: float, is_located: bool) -> ContactSensing:
    """Contact sensing at a rate (Hz), with a filter where contact is located and the rate allows one."""
    cutoff = _CUTOFF if is_located and 0.5 * rate > _CUTOFF else None
    return ContactSensing(peg, rate=rate, cutoff=cutoff)


class SimulatedProbe:
    """Windows of a probe, simulated for every pose of the part; windows of one probe share one rollout.

    Each window has a site for each kind of evidence: `contacts_*`, the contact locations in the peg's frame,
    `peg_*`, its pose, and `wrench_*`. A window without contact is evidence that nothing was in the way.
    Parameters of the contact that are latent (`friction`, `time_constant`) come with the first window.

    Args:
        recording: its part, peg and probes.
        settings: of the probe.

    Raises:
        InputError: the recording has no peg, or the part cannot be touched in simulation.
    """

    nuisances: Nuisances | None

    nuisance_addresses = ("friction", "time_constant")

    def __init__(self, recording: Recording, settings: ProbeSettings) -> None:
        if recording.peg is None:
            raise InputError("the recording has probe windows but no peg; add the peg that was held.")
        windows = [m.action for m in recording.measurements if isinstance(m.action, ProbeWindow)]
        self.settings, self.nuisances = settings, None
        self.physics = PegPhysics(recording.part, recording.peg, settings.contact)
        self._rates = tuple(dict.fromkeys(1.0 / step_of(window.probe) for window in windows))

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

    def sensing(self, probe: Probe) -> ContactSensing:
        """Contact sensing for a probe; one for all whose rates agree with one in the recording."""
        own = 1.0 / step_of(probe)
        rate = next((each for each in self._rates if abs(own / each - 1.0) <= _SAME_RATE), own)
        is_located = bool({"contacts", "contacts in time"} & set(self.settings.evidence))
        return _sensing(self.physics.peg, rate, is_located)

    def rollout(
        self, action: ProbeWindow, world_from_part: Tensor, latent: Mapping[str, Tensor] | None = None
    ) -> ProbeRollout:
        """The rollout of a window's probe for parts at poses (N, 7), which all its windows share.

        `latent` are parameters of the contact (N,) by name.

        Raises:
            InputError: the probe has no stiffness: its command is not known.
        """
        if not action.probe.stiffness.any():
            raise InputError(
                f"the probe {action.probe.name!r} has no stiffness, so that its command, which is simulated, "
                "moves nothing; give the plan that was executed, or take a model that needs none "
                "(look_and_touch)."
            )
        nuisances = self.nuisances
        if latent:
            nuisances = replace(nuisances or Nuisances(), **latent)
        own = () if nuisances is None else (nuisances,)
        sensing = self.sensing(action.probe)
        begin = partial(ProbeRollout.start, self.physics, sensing, world_from_part, action.probe, *own)
        return carried(f"probe {action.probe.name}", begin)

    def observe(self, number: int, action: ProbeWindow, world_from_part: Tensor) -> None:
        """Sample the sites of the evidence, and with the first window the contact's latent parameters."""
        settings, latent = self.settings, self._latent()
        window = (self.rollout(action, world_from_part, latent), action.first, action.last)
        for kind in settings.evidence:
            if kind == "contacts":
                contacts = ChamferContacts(*window, settings.contact_scale, settings.one_empty)
                pyro.sample(f"contacts_{number}", contacts)
            elif kind == "contacts in time":
                noise, every = settings.torque_noise, settings.wrench_every
                in_time = ContactsInTime(*window, settings.contact_scale, torque_noise=noise, every=every)
                pyro.sample(f"contacts_{number}", in_time)
            elif kind == "pose":
                scales = settings.translation_scale, settings.rotation_scale, settings.pose_every
                along = settings.normal_scale, settings.free_scale
                pyro.sample(f"peg_{number}", PegPose(*window, *scales, *along))
            elif kind == "wrench":
                spread = settings.force_scale, settings.torque_scale, settings.wrench_share
                pyro.sample(f"wrench_{number}", Wrench(*window, *spread, every=settings.wrench_every))

    def _latent(self) -> Mapping[str, Tensor]:
        known: dict[str, Tensor] = once("parameters of the contact", dict)
        for name in self.nuisance_addresses:
            prior = getattr(self.settings, name)
            if prior is not None and name not in known:
                known[name] = pyro.sample(name, dist.LogNormal(math.log(prior[0]), prior[1]))
        return known

    def observed(self, measurements: Sequence[Numbered]) -> Mapping[str, Tensor]:
        """Contact locations, peg poses and tared wrenches, by address; a probe's wrench is filtered whole."""
        evidence, values = self.settings.evidence, dict[str, Tensor]()
        for windows in by_probe(measurements):
            touches = [measurement.observation for _, measurement in windows]
            sensing = self.sensing(windows[0].measurement.action.probe)
            tared = sensing.tared(touches) if "wrench" in evidence else touches
            read = zip(windows, sensing.measure(touches), tared, strict=True)
            for (number, _), (contacts, peg), wrench in read:
                each = {"contacts": contacts, "contacts in time": contacts, "pose": peg, "wrench": wrench}
                for kind in each.keys() & set(evidence):
                    values[f"{_SITES[kind]}_{number}"] = each[kind]
        return values


_SITES = {"contacts": "contacts", "contacts in time": "contacts", "pose": "peg", "wrench": "wrench"}
