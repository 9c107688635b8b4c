"""Likelihoods of a touch: where contact was felt, and where the peg was."""

from __future__ import annotations

import math
from typing import Any, Protocol

import torch
from torch import Tensor

from bcppl import poses
from bcppl.arguments import whole_number
from bcppl.distributions.lazy import LazyDistribution
from bcppl.distributions.stamps import checked_event, checked_stamps
from bcppl.errors import InputError


class Track(Protocol):
    """A probe as N particles feel it: `bcppl.contact.probe_rollout.ProbeRollout`, or what answers alike."""

    @property
    def diverged(self) -> Tensor:
        """(N,) particles whose simulation failed, as far as it was run."""

    def __len__(self) -> int: ...

    def window(self, first: int, last: int) -> tuple[Tensor, Tensor]:
        """Contacts (N, T, 3) in the peg's frame, NaN where none, and peg poses (N, T, 7), of some stamps."""


def chamfer(a: Tensor, b: Tensor, one_empty: float) -> Tensor:
    """D_ch (...,) of sets of points (..., S, 3) and (..., T, 3), square metres; rows of NaN are no points.

    The mean over a of the squared distance to the nearest point of b, plus the same from b to a
    (Fan, Su and Guibas 2017, equation 6, with means). Both sets empty: 0. One empty: `one_empty`.
    """
    a, b = _told(a.to(torch.float64)), _told(b.to(torch.float64))
    in_a, in_b = torch.isfinite(a).all(dim=-1), torch.isfinite(b).all(dim=-1)
    count_a, count_b = in_a.sum(dim=-1), in_b.sum(dim=-1)
    # The mode that multiplies matrices is off by up to 1e-8 m, which is a lot for points that are the same.
    exactly = "donot_use_mm_for_euclid_dist"
    squared = torch.cdist(torch.nan_to_num(a), torch.nan_to_num(b), compute_mode=exactly).square()
    squared = torch.where(in_a[..., :, None] & in_b[..., None, :], squared, math.inf)

    def mean_to_nearest(dim: int, inside: Tensor, count: Tensor) -> Tensor:
        nearest = squared.amin(dim=dim) if squared.shape[dim] else squared.new_full(inside.shape, math.inf)
        return torch.where(inside, nearest, 0.0).sum(dim=-1) / count.clamp(min=1)

    distance = mean_to_nearest(-1, in_a, count_a) + mean_to_nearest(-2, in_b, count_b)
    distance = torch.where((count_a == 0) != (count_b == 0), one_empty, distance)
    return torch.where((count_a == 0) & (count_b == 0), 0.0, distance)


def _told(points: Tensor) -> Tensor:
    """The points (..., K, 3) without those places among (..., S, 3) that are NaN in every set."""
    inside = torch.isfinite(points).all(dim=-1)
    inside = inside.reshape(inside.shape[:-1].numel(), inside.shape[-1]).any(dim=0)
    return points if bool(inside.all()) else points[..., inside, :]


def _check_positive(name: str, **settings: float) -> None:
    for setting, value in settings.items():
        if not (math.isfinite(value) and value > 0):
            raise InputError(f"{name} has {setting} = {value!r}; give a number greater than 0.")


def _log_gaussian(squared: Tensor, scale: float) -> Tensor:
    """Log-density of an isotropic Gaussian in three dimensions at a squared distance."""
    return -0.5 * squared / scale**2 - 3.0 * math.log(scale) - 1.5 * math.log(2.0 * math.pi)


class ChamferContacts(LazyDistribution):
    """Contact locations felt during stamps `first` to `last` of a probe: log p = -D_ch / (2 scale^2).

    A surrogate, not a density: its normaliser changes with the pose (for two points at a scale of 1 mm by a
    factor of 1.6), so evidence that contains it is a surrogate's, and `scale` and `one_empty` are settings,
    never latent. For one point on each side D_ch = 2 d^2, a standard deviation of scale / sqrt(2). Its
    sharpness grows with the number of windows, not with the number of stamps in one: the model fixes them.

    The event is (last - first, 3): locations in the peg's frame, a row of NaN where nothing was
    touched. Particles whose physics diverged have log p = -inf.

    Args:
        track: the probe as the particles feel it.
        first: the first stamp.
        last: the stamp after the last.
        scale: sigma, metres.
        one_empty: D_ch where one set is empty and the other is not, square metres: 2 (3 scale)^2, say.
        noise: of `sample` alone: the standard deviation of a location along each axis (m), and the
            probability that a contact goes unnoticed.
    """

    cost = 2

    def __init__(
        self,
        track: Track,
        first: int,
        last: int,
        scale: float,
        one_empty: float,
        noise: tuple[float, float] = (0.0005, 0.02),
    ) -> None:
        first, last = checked_stamps("ChamferContacts", first, last)
        _check_positive("ChamferContacts", scale=scale, one_empty=one_empty)
        if noise[0] < 0 or not 0 <= noise[1] <= 1:
            raise InputError(
                f"ChamferContacts has noise {noise}; give a deviation in metres and a probability."
            )
        self.track, self.first, self.last = track, first, last
        self.scale, self.one_empty, self.noise = scale, one_empty, noise
        super().__init__(len(track), (last - first, 3))

    @property
    def log_prob_bound(self) -> float:
        """0: no two sets are nearer than equal ones."""
        return 0.0

    def log_prob(self, value: Tensor) -> Tensor:
        """Log of the surrogate (N,) of locations (T, 3), or (N, T, 3).

        Raises:
            InputError: there are not as many rows as stamps.
        """
        value = checked_event("ChamferContacts", value, self.last - self.first, 3)
        contacts, _ = self.track.window(self.first, self.last)
        log_prob = -chamfer(contacts, value, self.one_empty) / (2.0 * self.scale**2)
        return torch.where(self.track.diverged, -math.inf, log_prob)

    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        """Simulated locations (N, T, 3) with noise, some unnoticed: a model of its own, not `log_prob`'s."""
        contacts, _ = self.track.window(self.first, self.last)
        deviation, missed = self.noise
        noisy = contacts + deviation * torch.randn(contacts.shape, dtype=torch.float64)
        gone = torch.rand(contacts.shape[:-1], dtype=torch.float64) < missed
        return torch.where(gone[..., None], math.nan, noisy)


class ContactsInTime(LazyDistribution):
    """A contact location or none at every `every`-th stamp of `first` to `last` of a probe: normalised.

    Where the simulated peg touches, nothing is felt with probability `missed`, else a location: Gaussian
    about the simulated one, or, with probability `outlier`, anywhere. Where it does not touch, a location
    anywhere is felt with probability `invented`, else none. Anywhere is a Gaussian of standard deviation
    `reach` along each axis about the origin of the peg's frame. The density is with respect to counting
    measure on "none" plus Lebesgue measure on locations (cubic metres), at each stamp looked at.

    The event is (last - first, 3): locations in the peg's frame, a row of NaN where nothing was
    touched. Particles whose physics diverged have log p = -inf.

    Args:
        track: the probe as the particles feel it.
        first: the first stamp.
        last: the stamp after the last.
        scale: standard deviation of a location along each axis, metres.
        missed: probability that a contact is not felt.
        invented: probability that one is felt without a contact.
        outlier: probability that a contact is felt at the wrong place.
        reach: metres.
        every: stamps whose number is a multiple of this are looked at, for errors of neighbours go together.
    """

    cost = 2
    broadcasts = True

    def __init__(
        self,
        track: Track,
        first: int,
        last: int,
        scale: float,
        missed: float = 0.02,
        invented: float = 0.02,
        outlier: float = 0.05,
        reach: float = 0.05,
        every: int = 10,
    ) -> None:
        first, last = checked_stamps("ContactsInTime", first, last)
        every = whole_number("ContactsInTime has every = {}", every)
        _check_positive("ContactsInTime", scale=scale, reach=reach)
        for name, value in (("missed", missed), ("invented", invented), ("outlier", outlier)):
            if not 0 < value < 1:
                raise InputError(
                    f"ContactsInTime has {name} = {value!r}; give a probability above 0 and below 1."
                )
        self.track, self.first, self.last = track, first, last
        self.scale, self.missed, self.invented, self.outlier = scale, missed, invented, outlier
        self.reach, self.every = reach, every
        super().__init__(len(track), (last - first, 3))

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-probability (N,) of locations (T, 3), or (N, T, 3).

        Raises:
            InputError: there are not as many rows as stamps.
        """
        value = checked_event("ContactsInTime", value, self.last - self.first, 3)
        contacts, _ = self.track.window(self.first, self.last)
        chosen = slice(-self.first % self.every, None, self.every)
        contacts = contacts[:, chosen]
        value = value.to(torch.float64)[..., chosen, :]
        touching, felt = torch.isfinite(contacts).all(dim=-1), torch.isfinite(value).all(dim=-1)
        value = torch.nan_to_num(value)
        anywhere = _log_gaussian(value.square().sum(dim=-1), self.reach)
        near = _log_gaussian((value - torch.nan_to_num(contacts)).square().sum(dim=-1), self.scale)
        here = torch.logaddexp(near + math.log1p(-self.outlier), anywhere + math.log(self.outlier))
        of_touch = torch.where(felt, here + math.log1p(-self.missed), math.log(self.missed))
        of_none = torch.where(felt, anywhere + math.log(self.invented), math.log1p(-self.invented))
        log_prob = torch.where(touching, of_touch, of_none).sum(dim=-1)
        return torch.where(self.track.diverged, -math.inf, log_prob)

    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        """Locations (N, T, 3), NaN where none is felt; all stamps are drawn, independently."""
        contacts, _ = self.track.window(self.first, self.last)
        shape = contacts.shape[:-1]

        def happens(probability: float) -> Tensor:
            return torch.rand(shape, dtype=torch.float64) < probability

        touching = torch.isfinite(contacts).all(dim=-1)
        felt = torch.where(touching, ~happens(self.missed), happens(self.invented))
        astray = (~touching | happens(self.outlier))[..., None]
        noise = torch.randn(*shape, 3, dtype=torch.float64)
        location = torch.where(astray, self.reach * noise, contacts + self.scale * noise)
        return torch.where(felt[..., None], location, math.nan)


_WIDER, _WIDE_WEIGHT = 10.0, 0.05


def _log_mass_within_pi(scale: float) -> float:
    """Log of an isotropic Gaussian's mass in the ball of radius pi, where rotation vectors live."""
    a = math.pi / scale
    return math.log(math.erf(a / math.sqrt(2.0)) - math.sqrt(2.0 / math.pi) * a * math.exp(-0.5 * a * a))


class PegPose(LazyDistribution):
    """The held peg's measured pose at every `every`-th stamp of `first` to `last` of a probe.

    Normalised: at each stamp the translation's error and the rotation's are independent, each a mixture of a
    Gaussian of the given scale and, with weight 0.05, of one ten times as wide. The rotation vector of the
    error is cut at pi. The density is with respect to Lebesgue times the normalised Haar measure.

    The event is (last - first, 7), `world_from_peg`; stamps between are not looked at. Particles whose
    physics diverged have log p = -inf.

    Args:
        track: the probe as the particles feel it.
        first: the first stamp.
        last: the stamp after the last.
        translation_scale: metres, along each axis.
        rotation_scale: radians, about each axis.
        every: stamps whose number is a multiple of this are looked at, for errors of neighbours go together.
    """

    cost = 2
    broadcasts = True

    def __init__(
        self,
        track: Track,
        first: int,
        last: int,
        translation_scale: float,
        rotation_scale: float,
        every: int = 10,
    ) -> None:
        first, last = checked_stamps("PegPose", first, last)
        every = whole_number("PegPose has every = {}", every)
        _check_positive("PegPose", translation_scale=translation_scale, rotation_scale=rotation_scale)
        self.track, self.first, self.last = track, first, last
        self.translation_scale, self.rotation_scale, self.every = translation_scale, rotation_scale, every
        super().__init__(len(track), (last - first, 7))

    @property
    def log_prob_bound(self) -> float:
        """Its value where the peg is just where it was measured."""
        # Below 2 rad the normal falls faster than the Haar measure of a rotation vector does.
        if _WIDER * self.rotation_scale > 2.0:
            return math.inf
        none = torch.zeros(1, dtype=torch.float64)
        stamps = len(range(self.first, self.last)[-self.first % self.every :: self.every])
        return stamps * float(self._log_translation(none) + self._log_rotation(none))

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-probability (N,) of poses (T, 7), or (N, T, 7).

        Raises:
            InputError: there are not as many rows as stamps.
        """
        value = checked_event("PegPose", value, self.last - self.first, 7)
        _, simulated = self.track.window(self.first, self.last)
        chosen = slice(-self.first % self.every, None, self.every)
        lost = self.track.diverged
        expected = torch.where(lost[:, None, None], poses.identity(), simulated)[:, chosen]
        error = poses.local(expected, value.to(torch.float64)[..., chosen, :])
        translation, rotation = error[..., :3].square().sum(-1), error[..., 3:].square().sum(-1)
        terms = self._log_translation(translation) + self._log_rotation(rotation)
        return torch.where(lost, -math.inf, terms.sum(dim=-1))

    def _log_translation(self, squared: Tensor) -> Tensor:
        wide = _log_gaussian(squared, _WIDER * self.translation_scale) + math.log(_WIDE_WEIGHT)
        narrow = _log_gaussian(squared, self.translation_scale) + math.log1p(-_WIDE_WEIGHT)
        return torch.logaddexp(narrow, wide)

    def _log_rotation(self, squared: Tensor) -> Tensor:
        def cut(scale: float) -> Tensor:
            return _log_gaussian(squared, scale) - _log_mass_within_pi(scale)

        wide = cut(_WIDER * self.rotation_scale) + math.log(_WIDE_WEIGHT)
        narrow = cut(self.rotation_scale) + math.log1p(-_WIDE_WEIGHT)
        return torch.logaddexp(narrow, wide) - poses.log_haar_density_of_rotation_vector(squared.sqrt())

    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        """Poses (N, T, 7), the errors of all stamps independent."""
        _, simulated = self.track.window(self.first, self.last)
        shape = simulated.shape[:-1]

        def widths(scale: float) -> Tensor:
            wide = torch.rand(shape, dtype=torch.float64) < _WIDE_WEIGHT
            return torch.where(wide, _WIDER * scale, scale)[..., None]

        translation = widths(self.translation_scale) * torch.randn(*shape, 3, dtype=torch.float64)
        width = widths(self.rotation_scale).expand(*shape, 3)
        rotation = width * torch.randn(*shape, 3, dtype=torch.float64)
        # Each Gaussian is cut at pi on its own, so one that falls outside is drawn again at the same width.
        while bool((outside := rotation.norm(dim=-1) > math.pi).any()):
            rotation[outside] = width[outside] * torch.randn(int(outside.sum()), 3, dtype=torch.float64)
        return poses.retract(simulated, torch.cat([translation, rotation], dim=-1))
