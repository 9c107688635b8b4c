"""The base of the likelihoods of images: one camera, and parts at the particles' poses."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar

import torch
from torch import Tensor

from bcppl.arrays import Mask
from bcppl.distributions.depth.rendering import RendersDepth
from bcppl.distributions.lazy import LazyDistribution
from bcppl.distributions.parameters import check_shape
from bcppl.errors import InputError

if TYPE_CHECKING:
    from bcppl.geometry.camera import Camera


@dataclass(eq=False, repr=False)
class CameraImage(LazyDistribution):
    """An image (H, W) that a camera takes of parts at the particles' poses.

    Args:
        renderer: renders the part, or several.
        camera: takes the image.
        pose: (N, 7) `world_from_part`; (N, K, 7) for a renderer of K parts.
        region: (H, W) pixels that may count; None for all.

    Attributes:
        latent: the names of the attributes that may be latent, and are checked to be finite.
    """

    cost = 1
    latent: ClassVar[tuple[str, ...]] = ("pose",)

    renderer: RendersDepth
    camera: Camera
    pose: Tensor
    region: Mask | Tensor | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        parts = getattr(self.renderer, "parts", None)
        each = (7,) if parts is None else (len(parts), 7)
        self._check_shape("a pose (world_from_part)", self.pose, (len(self.pose), *each))
        super().__init__(len(self.pose), (self.camera.height, self.camera.width))
        self._check_shape("a region", self.region, self.event_shape)

    @property
    def _where(self) -> str:
        return f"{type(self).__name__} of camera {self.camera.name!r}"

    def _check_shape(self, name: str, value: Any, *shapes: tuple[int, ...]) -> None:
        check_shape(self._where, name, value, *shapes)

    def _check_image(self, value: Tensor) -> None:
        """Check that an observation is one image, or one for each particle."""
        self._check_shape("an image", value, self.event_shape, self.batch_shape + self.event_shape)

    def _check_finite(self) -> None:
        """Check that the latent values of all particles are finite."""
        count = len(self.pose)
        for name in self.latent:
            if (value := getattr(self, name)) is None:
                continue
            each = torch.as_tensor(value)
            each = each.expand(count, *each.shape[1 if len(each.shape) and len(each) == count else 0 :])
            bad = torch.nonzero(~torch.isfinite(each.reshape(count, -1)).all(dim=-1)).flatten().tolist()
            if bad:
                shown = ", ".join(map(str, bad[:10])) + (", ..." if len(bad) > 10 else "")
                raise InputError(
                    f"{len(bad)} of {count} particles have a {name.replace('_', ' ')} that is not finite "
                    f"(particles {shown}) and cannot be rendered for camera {self.camera.name!r}; check the "
                    "program that proposed them."
                )

    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        """One image for each particle, (N, H, W); only the empty sample_shape is supported."""
        self._check_finite()
        return self._sample()

    def _sample(self) -> Tensor:
        raise NotImplementedError
