"""Likelihood of a compliant probe by the contact manifold: nothing is simulated (slow, guarded touches)."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial

import pyro
import torch
from torch import Tensor

from bcppl import poses
from bcppl.cached import cached_property
from bcppl.contact.quasi_static import QuasiStaticMotion, WindowMotion
from bcppl.contact.sensing.contact_detection import ContactDetector
from bcppl.contact.sensing.location import ContactSensing
from bcppl.distributions.episodes import ContactEpisodes, Hypothesis, LinearError, LinearErrors
from bcppl.distributions.episodes.filter.branches import begun
from bcppl.distributions.episodes.filter.posterior import moments
from bcppl.distributions.episodes.prior import prior_of, with_delays
from bcppl.distributions.episodes.rows import EPISODE, FELT, FORCE, TIME, WRENCH, new_rows
from bcppl.distributions.manifold import MeasuresGap
from bcppl.distributions.parameters import NONNEGATIVE, POSITIVE, PROBABILITY, check_parameters, within
from bcppl.effort import Effort
from bcppl.errors import InputError
from bcppl.geometry.gap import PegGap
from bcppl.geometry.holes import hole_of
from bcppl.geometry.parts import Part, with_tip_at
from bcppl.geometry.turns import turns_freely
from bcppl.robot.motion import ProbeWindow
from bcppl.sensors.capabilities import Approximated, InHole, PegRows
from bcppl.sensors.likelihoods.bench_profiles import BenchProfile, profile_named
from bcppl.sensors.likelihoods.hole_entry import HoleEntry
from bcppl.sensors.likelihoods.probe_rows import (
    ProbeRows,
    RememberedGaps,
    after_those_before,
    capacity,
    cells_of,
    step_of,
)
from bcppl.sensors.measurements import Recording
from bcppl.sensors.scene import Numbered, by_probe
from bcppl.traces.carried import once

PREDICTED = 0.05  # s between the rows of a probe that is not yet carried out
PRESSED = 4.0  # N: of such a probe's contacts
GEOMETRY = 0.00001  # m: by which part and peg differ from their models where they touch
_NEAR = 0.02  # m: a window in which the peg stays farther away carries no information
_MOVED = 0.001  # m: a shorter displacement has no direction


@dataclass(frozen=True)
class TouchSettings:
    """Noise of the peg's measured pose in contact, and how contact is detected.

    Attributes:
        gap_noise: standard deviation of the peg's surface position at one stamp, m; less where the measured
            poses scatter less.
        gap_drift: standard deviation of its errors that last for `lasting` seconds, m.
        gap_shared: standard deviation of the error that all stamps of a contact share and no other contact
            does, m; by default what the profile says.
        lasting: s.
        compliance: of part and peg where they touch, m/N: the median of what it may be.
        compliance_decades: standard deviation of its decimal logarithm.
        delay: standard deviation of the time between the wrench's stamps and the pose's, s.
        gap_outlier: probability that a stamp without contact, or a contact, is an outlier.
        contact_detector: force thresholds of contact and of free motion.
        tool_mass: kg, of all that the wrench sensor carries; by default `contact_detector`'s mass, 0.3 kg. A
            heavy tool that accelerates is felt as a contact unless its mass is stated.
        free_space: whether stamps without contact count, which exclude the part from where the peg moved.
        profile: of the bench, which sets the priors of the errors that all touches share
            (`bcppl.sensors.likelihoods.bench_profiles`).
        bench: these errors themselves, in place of the profile's.
    """

    gap_noise: float = field(default=0.00006, metadata=POSITIVE)
    gap_drift: float = field(default=0.000015, metadata=NONNEGATIVE)
    gap_shared: float | None = field(default=None, metadata=within(least=0.0, optional=True))
    lasting: float = field(default=0.1, metadata=POSITIVE)
    compliance: float = field(default=0.000005, metadata=POSITIVE)
    compliance_decades: float = field(default=0.5, metadata=POSITIVE)
    delay: float = field(default=0.002, metadata=NONNEGATIVE)
    gap_outlier: float = field(default=0.001, metadata=PROBABILITY)
    contact_detector: ContactDetector = field(default_factory=ContactDetector)
    tool_mass: float | None = field(default=None, metadata=within(least=0.0, optional=True))
    free_space: bool = True
    profile: str = "ur5e"
    bench: tuple[LinearError, ...] | None = None

    def __post_init__(self) -> None:
        check_parameters(self)
        given = self.bench is None or isinstance(self.bench, tuple | list)
        if not given or not all(isinstance(each, LinearError) for each in self.bench or ()):
            raise InputError(
                f"bench = {self.bench!r} holds what is no error of a bench; give some such as "
                "`bcppl.distributions.episodes.Grasp()`, or a profile."
            )
        if self.bench is not None:
            object.__setattr__(self, "bench", LinearErrors(self.bench).errors)
        if self.tool_mass is not None:
            object.__setattr__(self, "contact_detector", replace(self.contact_detector, mass=self.tool_mass))


MakesGap = Callable[[Part, Part], PegGap]


@lru_cache(maxsize=4)
def _solids(part: Part, peg: Part, gap: MakesGap) -> tuple[PegGap, QuasiStaticMotion]:
    """Distances between two solids, prepared once for all scenes of the same two."""
    measure = gap(part, peg)
    return measure, QuasiStaticMotion(measure)


def _shared_errors(
    recording: Recording, settings: TouchSettings, profile: BenchProfile | None
) -> tuple[LinearErrors, tuple[Hypothesis, ...]]:
    """The errors that all touches share, and the hypotheses of how good the bench is."""
    x, y, z = map(float, recording.guess.world_from_part[:3])
    held = recording.peg
    length = 0.0 if held is None else -float(held.vertices[:, 2].min())
    part, peg = (x, y, z), (x, y, z + length)
    is_round = profile is not None and held is not None and turns_freely(held)
    own = () if profile is None else profile.errors(part, peg, is_round=is_round)
    errors = LinearErrors(own if settings.bench is None else settings.bench)
    return errors, () if profile is None else profile.hypotheses(settings.compliance)


class ContactProbe:
    """Windows of a probe, by the distance between the measured peg and the part.

    Where contact is felt that distance is zero, elsewhere it is positive (`ContactEpisodes`). The rows of a
    cell of 0.5 s (`EpisodeExtractor`) are observed where the cell ends: a window in which one does has a
    site, `touch_*`; the others are deferred.

    Args:
        recording: its part, peg and probes.
        settings: of the touches.
        gap: makes what measures the gap between part and peg.

    Raises:
        InputError: the recording has no peg.
    """

    __caches__ = ("_streams",)

    def __init__(self, recording: Recording, settings: TouchSettings, gap: MakesGap = PegGap) -> None:
        if recording.peg is None:
            raise InputError("the recording has probe windows but no peg; add the peg that was held.")
        self.settings, self.peg = settings, recording.peg
        self.gap, self.quasi_static = _solids(recording.part, recording.peg, gap)
        profile = profile_named(settings.profile)
        self.bench, self.hypotheses = _shared_errors(recording, settings, profile)
        own = GEOMETRY if profile is None else math.hypot(GEOMETRY, profile.repeats)
        self.gap_shared = own if settings.gap_shared is None else settings.gap_shared
        self._streams: dict[str, ProbeRows] = {}

    @classmethod
    def prepare(
        cls, recording: Recording, settings: TouchSettings, gap: MakesGap = PegGap
    ) -> ContactProbe | None:
        """The likelihood of a recording's touches; None for one without peg and touches."""
        touched = any(isinstance(m.action, ProbeWindow) for m in recording.measurements)
        return cls(recording, settings, gap) if touched or recording.peg is not None else None

    @property
    def efforts(self) -> Mapping[str, Effort]:
        """The cost of distances."""
        return {"gap": self.gap.effort}

    # ---- the program's sites

    def is_deferred(self, action: ProbeWindow) -> bool:
        """Whether no cell ends in a window, so that a later one brings its rows."""
        return not len(cells_of(action))

    def observe(self, number: int, action: ProbeWindow, world_from_part: Tensor) -> None:
        """Sample `touch_*`, unless the window is deferred."""
        if not self.is_deferred(action):
            gaps = once("gaps of touches", partial(RememberedGaps, self.gap, world_from_part))
            shared = gaps if gaps.part is world_from_part else None
            pyro.sample(f"touch_{number}", self.site(action, world_from_part, gap=shared))

    def site(
        self, window: ProbeWindow, part: Tensor, blur: float = 0.0, gap: MeasuresGap | None = None
    ) -> ContactEpisodes:
        """The likelihood of a window for parts at poses (N, 7), its errors `blur` metres wider."""
        settings = self.settings
        stride = max(1, round(PREDICTED / step_of(window.probe)))
        site = ContactEpisodes(
            self.gap if gap is None else gap,
            part,
            capacity(window),
            math.hypot(settings.gap_noise, blur),
            math.hypot(self.gap_shared, blur),
            settings.compliance * PRESSED,
            settings.gap_outlier,
            WindowMotion(self.quasi_static, window, stride),
            drift=settings.gap_drift,
            lasting=settings.lasting,
            compliance=settings.compliance,
            uncertain=settings.compliance_decades,
            blur=blur,
            bench=self.bench,
            hypotheses=self.hypotheses,
            solids=self.gap,
        )
        if isinstance(gap, RememberedGaps):
            site.memory = gap.memory
        return site

    def observed(self, measurements: Sequence[Numbered]) -> Mapping[str, Tensor]:
        """The rows by address, those of all earlier windows given; each probe's wrench is tared whole."""
        each: dict[int, Tensor] = {}
        for windows in by_probe(measurements):
            before = max((float(rows[:, EPISODE].max()) for rows in each.values() if len(rows)), default=-1.0)
            for k, rows in self._of_probe(windows).items():
                # Episodes of another probe are others.
                number = rows[:, EPISODE] + torch.where(rows[:, EPISODE] >= 0.0, before + 1.0, 0.0)
                each[windows[k].number] = rows.index_copy(1, torch.tensor([EPISODE]), number[:, None])
        ordered = [(n, each[n]) for n, _ in measurements if n in each]
        room = [capacity(m.action) for n, m in measurements if n in each]
        return {f"touch_{n}": value for n, value in after_those_before(ordered, room).items()}

    def _of_probe(self, windows: Sequence[Numbered]) -> Mapping[int, Tensor]:
        """The rows of a probe's windows, by their number among these."""
        seen = [measurement for _, measurement in windows]
        probe = seen[0].action.probe
        stream = self._streams.get(probe.name)
        if stream is None or not stream.begins(seen):
            sensing = ContactSensing(self.peg, rate=1.0 / step_of(probe), cutoff=None)
            stream = self._streams[probe.name] = ProbeRows(
                probe, sensing, self.settings, max(self.bench.delays)
            )
        for measurement in seen[len(stream.windows) :]:
            stream.add(measurement)
        return {k: rows for k, rows in stream.rows.items() if k < len(seen)}

    # ---- a quadratic approximation of the likelihood (`bcppl.sensors.capabilities.Linearised`)

    def address(self, number: int) -> str:
        """The address of a window's site."""
        return f"touch_{number}"

    def is_informative(self, action: ProbeWindow, value: Tensor, part: Tensor) -> bool:
        """Whether the peg came within 20 mm of parts at poses (M, 7)."""
        rows = new_rows(value)
        return bool(len(rows)) and bool((self.gap(part, rows[:, :7]).distance < _NEAR).any())

    def sites(
        self, measurements: Sequence[Approximated], part: Tensor, blur: float
    ) -> Iterator[tuple[ContactEpisodes, Tensor]]:
        """The likelihood of all probes at poses (S, 7), and their rows."""
        value = torch.cat([new_rows(value) for _, _, value in measurements])
        yield self.site(measurements[-1].action, part, blur, RememberedGaps(self.gap, part)), value

    def new_contact(self, measurements: Sequence[Approximated], newest: bool) -> bool:
        """Whether contact begins in one of the windows, or in the newest of them."""
        if not measurements:
            return False
        felt = torch.cat(
            [torch.zeros(1, dtype=torch.bool), *(new_rows(v)[:, FELT] == 1.0 for _, _, v in measurements)]
        )
        onsets = felt[1:] & ~felt[:-1]
        return bool(
            (onsets[len(onsets) - len(new_rows(measurements[-1].value)) :] if newest else onsets).any()
        )

    def heading(self, measurements: Sequence[Approximated]) -> Tensor | None:
        """The direction (3,) in which the peg moved when contact last began; None without contact."""
        rows = torch.cat([new_rows(value) for _, _, value in measurements])
        felt = rows[:, FELT] == 1.0
        onsets = torch.nonzero(felt[1:] & ~felt[:-1])[:, 0]
        if len(onsets) == 0:
            return None
        last = int(onsets[-1])
        way = rows[last + 1, :3] - rows[max(0, last - 2), :3]
        return way / way.norm() if float(way.norm()) > _MOVED else None

    @cached_property
    def _entry(self) -> HoleEntry | None:
        """How the peg goes into the part's hole; None without one, with several, or for another peg."""
        try:
            return HoleEntry(self.gap, self.peg, hole_of(self.gap.part, peg=self.peg))
        except InputError:
            return None

    def in_hole(self, measurements: Sequence[Approximated], part: Tensor) -> InHole:
        """Poses near some (M, 7) that have the hole where the peg would lie deep in the material."""
        rows = torch.cat([new_rows(value) for _, _, value in measurements])
        rows = rows[rows[:, FELT] == 0.0]  # the peg is upright before it is pressed
        if self._entry is None or not len(rows):
            return InHole(part[:0], part.new_zeros(0, 6, 6))
        return self._entry.deep(part, rows[:, :7])

    def at_mouth(self, measurements: Sequence[Approximated], part: Tensor) -> Tensor:
        """Poses (K, 7), turned as some (M, 7), whose hole has the tip of the peg in its mouth."""
        pressed = [rows[rows[:, FELT] == 1.0] for rows in (new_rows(value) for _, _, value in measurements)]
        pressed = [rows for rows in pressed if len(rows)]
        if self._entry is None or not pressed:
            return part[:0]
        hardest = pressed[-1][pressed[-1][:, FORCE].argmax()]
        together = pressed[-1][pressed[-1][:, EPISODE] == hardest[EPISODE], :7]
        return self._entry.wedged(part, hardest[:7]) if self._entry.stays(together) else part[:0]

    @cached_property
    def shared_prior(self) -> tuple[Tensor, Tensor]:
        """Mean (M,) and covariance (M, M) of the errors that touches share, before any touch."""
        hypotheses = self.hypotheses or (Hypothesis(0.0, self.settings.compliance),)
        prior = prior_of(self.bench, with_delays(hypotheses, self.bench), self.settings.gap_outlier, 0)
        mean, covariance = moments(begun(prior, 1))
        return mean[0], covariance[0]

    def inserted(self, world_from_part: Tensor) -> Tensor:
        """The peg's pose (7,) with its tip at a part's frame (7,), turned as the part."""
        return with_tip_at(self.peg, world_from_part, world_from_part[:3])

    # ---- the peg's motion itself (`bcppl.sensors.capabilities.FeelsForces`)

    def peg_rows(self, measurements: Sequence[Approximated]) -> PegRows:
        """The rows of all measurements."""
        rows = torch.cat([new_rows(value) for _, _, value in measurements])
        force = (poses.rotation_matrix(rows[:, :7]) @ rows[:, WRENCH][:, :3, None])[..., 0]
        return PegRows(rows[:, TIME], rows[:, FELT] == 1.0, rows[:, EPISODE].long(), rows[:, :7], force)
