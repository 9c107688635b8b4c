"""The likelihood of a held peg's measured pose."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from bcppl import poses
from bcppl.distributions.contact.track import WIDER, TrackDistribution, contaminated, log_gaussian
from bcppl.distributions.parameters import COUNT, IF_GIVEN, POSITIVE

OUTLIER = 0.05


def _log_mass_within_pi(scale: float) -> float:
    """Log of an isotropic Gaussian's mass in the ball of radius pi, where rotation vectors live."""
    a = math.pi / scale
    return math.log(math.erf(a / math.sqrt(2.0)) - math.sqrt(2.0 / math.pi) * a * math.exp(-0.5 * a * a))


@dataclass(eq=False, repr=False)
class PegPose(TrackDistribution):
    """The held peg's measured pose at every `every`-th stamp of `first` to `last` of a probe: normalised.

    At each stamp the errors of translation and rotation are independent, each a mixture of a Gaussian of the
    given scale and, with weight 0.05, of one ten times as wide. The rotation vector of the error is truncated
    at pi. The density is with respect to Lebesgue times the normalised Haar measure.

    Where the simulated peg touches, its place along the contact's normal is that of the two surfaces, and
    across it depends on friction, which is not known well: the scale is `normal_scale` along the normal and
    `translation_scale` across it. Where it does not touch it is where the command is, to `free_scale`.

    The event is (last - first, 7), `world_from_peg`.

    Args:
        track, first, last: as for `TrackDistribution`.
        translation_scale: metres, along each axis.
        rotation_scale: radians, about each axis.
        every: as for `TrackDistribution`.
        normal_scale: metres; `translation_scale` in all directions unless given.
        free_scale: metres; `normal_scale` unless given.
    """

    broadcasts = True
    entries = 7

    translation_scale: float = field(metadata=POSITIVE)
    rotation_scale: float = field(metadata=POSITIVE)
    every: int = field(default=10, metadata=COUNT)
    normal_scale: float | None = field(default=None, metadata=IF_GIVEN)
    free_scale: float | None = field(default=None, metadata=IF_GIVEN)

    @property
    def log_prob_bound(self) -> float:
        """Its value at errors of zero; +inf where rotations vary so widely that this is no bound."""
        # Below 2 rad the normal falls faster than the Haar measure of a rotation vector does.
        if WIDER * self.rotation_scale > 2.0:
            return math.inf
        none = torch.zeros(1, dtype=torch.float64)
        stamps = len(range(self.first, self.last)[self.thinned])
        narrowest = none + min(self.translation_scale, *self._along)
        translation = self._log_translation(none, narrowest, narrowest)
        return stamps * float(translation + self._log_rotation(none))

    def _log_prob(self, value: Tensor) -> Tensor:
        _, simulated = self.track.window(self.first, self.last)
        expected = torch.where(self.track.diverged[:, None, None], poses.identity(), simulated)
        error = poses.local(expected[:, self.thinned], value)
        rotation = self._log_rotation(error[..., 3:].square().sum(dim=-1))
        direction, across, along = (each[:, self.thinned] for each in self._spread())
        normal = (error[..., :3] * direction).sum(dim=-1, keepdim=True)
        rest = error[..., :3] - normal * direction
        squared = (normal[..., 0] / along).square() + (rest / across[..., None]).square().sum(dim=-1)
        return (self._log_translation(squared, across, along) + rotation).sum(dim=-1)

    @property
    def _along(self) -> tuple[float, float]:
        """The scales along a contact's normal, and in free motion."""
        normal = self.normal_scale or self.translation_scale
        return normal, self.free_scale or normal

    def _spread(self) -> tuple[Tensor, Tensor, Tensor]:
        """Unit normals (N, T, 3), 0 for none, and the scales across and along them (N, T), m."""
        if self.normal_scale is None and self.free_scale is None:
            _, pose = self.track.window(self.first, self.last)
            same = torch.full_like(pose[..., 0], self.translation_scale)
            return torch.zeros_like(pose[..., :3]), same, same
        direction = self.track.contact_normals(self.first, self.last)
        touches = torch.isfinite(direction).all(dim=-1)
        normal, free = (direction.new_tensor(scale) for scale in self._along)
        across = torch.where(touches, direction.new_tensor(self.translation_scale), free)
        return torch.nan_to_num(direction), across, torch.where(touches, normal, free)

    def _log_translation(self, squared: Tensor, across: Tensor, along: Tensor) -> Tensor:
        """Log-density of errors whose whitened squares are given."""

        def gaussian(wider: float) -> Tensor:
            volume = 2.0 * across.log() + along.log() + 3.0 * math.log(wider)
            return -0.5 * squared / wider**2 - volume - 1.5 * math.log(2.0 * math.pi)

        return contaminated(gaussian, 1.0, OUTLIER)

    def _log_rotation(self, squared: Tensor) -> Tensor:
        def truncated(scale: float) -> Tensor:
            return log_gaussian(squared, scale) - _log_mass_within_pi(scale)

        log_density = contaminated(truncated, self.rotation_scale, OUTLIER)
        return log_density - poses.log_haar_density_of_rotation_vector(squared.sqrt())

    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        """Poses (N, T, 7), the errors of all stamps independent."""
        _, simulated = self.track.window(self.first, self.last)
        shape = simulated.shape[:-1]

        def widths(scale: float) -> Tensor:
            wide = torch.rand(shape, dtype=torch.float64) < OUTLIER
            return torch.where(wide, WIDER * scale, scale)[..., None]

        direction, across, along = self._spread()
        wide, standard = widths(1.0), torch.randn(*shape, 3, dtype=torch.float64)
        normal = (standard * direction).sum(dim=-1, keepdim=True) * direction
        translation = wide * (across[..., None] * (standard - normal) + along[..., None] * normal)
        width = widths(self.rotation_scale).expand(*shape, 3)
        rotation = width * torch.randn(*shape, 3, dtype=torch.float64)
        # Each Gaussian is truncated on its own, so a draw beyond pi is drawn again at the same width.
        while bool((outside := rotation.norm(dim=-1) > math.pi).any()):
            rotation[outside] = width[outside] * torch.randn(int(outside.sum()), 3, dtype=torch.float64)
        return poses.retract(simulated, torch.cat([translation, rotation], dim=-1))
