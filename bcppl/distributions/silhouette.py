"""A part's silhouette: which pixels of an image show it, as a segmentation says.

A mask says nothing of ranges, but its outline lies where the part ends, to a pixel or two, while a stereo
sensor smears it over a matching window. Masks err in three ways, each of which has a number here: the outline
wanders, it lies inside or outside all along (one segmentation eats a rim, another adds one), and whole
patches are taken for something else.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import torch
from scipy.ndimage import gaussian_filter
from torch import Tensor

from bcppl.arguments import number_within
from bcppl.distributions.depth.image import DepthDistribution
from bcppl.distributions.depth.rendering import HitsOfPoses, Mask, RendersDepth
from bcppl.distributions.lazy import LazyDistribution
from bcppl.errors import InputError

if TYPE_CHECKING:
    from bcppl.geometry.camera import Camera

_REACH = 3.0  # deviations of the outline's wandering that are looked at
_SURE = 1e-9  # no share of rays is taken for nearer to 0 or 1: the normal's quantiles stay finite


class Silhouette(LazyDistribution):
    """A mask whose pixels are independent given where the part is.

    A pixel's ray may as well be one beside it, `width` pixels off (a normal in each direction): the share c
    of these rays that hit the part is the chance that the outline encloses the pixel. With a rim of r pixels
    the outline lies farther out by that much, which makes it F(F^-1(c) + r / width), F the standard normal's
    distribution function: exact at straight edges. Whatever the outline, a pixel is wrong with probability
    `wrong`. So p(robot) = wrong + (1 - 2 wrong) F(F^-1(c) + r / width).

    Neighbouring pixels err together: `temperature` divides the log-likelihood, which then is no density.
    Soft silhouettes are those of Liu, Li, Chen and Li, Soft Rasterizer, ICCV 2019, section 3.3.

    Args:
        renderer: renders the part, or several.
        camera: where the image is taken.
        pose: (N, 7) `world_from_part`; (N, K, 7) for a renderer of K parts.
        width: standard deviation of where the outline lies, pixels of this camera.
        wrong: the probability that a pixel says the opposite, in (0, 0.5).
        rim: (N,) or one for all, pixels by which the mask reaches beyond the part; below 0, falls short.
        temperature: what the log-likelihood is divided by.
        region: (H, W) pixels that count at all; None for all.

    Raises:
        InputError: the region has another shape than the camera's image, a number is out of range, or the rim
            has another shape than () or (N,).
    """

    cost = 1

    def __init__(
        self,
        renderer: RendersDepth,
        camera: Camera,
        pose: Tensor,
        width: float,
        wrong: float = 0.05,
        *,
        rim: Tensor | float = 0.0,
        temperature: float = 1.0,
        region: Mask | Tensor | None = None,
    ) -> None:
        self.width = number_within("a silhouette's outline is given the width {}", width, above=0.0)
        self.wrong = number_within(
            "a silhouette's pixels are wrong with probability {}", wrong, above=0.0, below=0.5
        )
        self.temperature = number_within("a silhouette is given the temperature {}", temperature, above=0.0)
        shape = (camera.height, camera.width)
        if region is not None and tuple(region.shape) != shape:
            raise InputError(
                f"the region of camera {camera.name!r} has shape {tuple(region.shape)}; "
                f"give one of its image's, {shape}."
            )
        if isinstance(rim, Tensor) and tuple(rim.shape) not in ((), (len(pose),)):
            raise InputError(
                f"the rim of a silhouette has shape {tuple(rim.shape)}; "
                f"give ({len(pose)},), pixels, one per particle."
            )
        super().__init__(len(pose), shape)
        self.camera, self.pose, self.rim, self.region = camera, pose, rim, region
        self._hits = HitsOfPoses(partial(renderer.hits, camera, pose.detach()), None)
        self._hits.keep_all()

    @classmethod
    def beside(cls, depth: DepthDistribution, width: float, wrong: float = 0.05, **others: Any) -> Silhouette:
        """The silhouette of what a depth image shows, by the same camera: both are rendered once, together.

        Args:
            depth: of the depth image; its region is not the mask's.
            width: of where the outline lies, pixels.
            wrong: the probability that a pixel says the opposite.
            others: `rim`, `temperature`, `region`.
        """
        made = cls(depth.renderer, depth.camera, depth.seen_pose, width, wrong, **others)
        made._hits = depth.all_hits()
        return made

    def chances(self) -> npt.NDArray[np.float32]:
        """The probability (N, H, W) that a pixel of the mask says that it shows the part.

        Raises:
            InputError: a pose or a rim is not finite.
        """
        for name, value in (("pose", self.pose), ("rim", torch.as_tensor(self.rim))):
            if not bool(torch.isfinite(value).all()):
                raise InputError(
                    f"a {name} of the silhouette in camera {self.camera.name!r} is not finite; "
                    "look at what proposed it."
                )
        pixels = self.event_shape.numel()
        hits = self._hits(np.ones(pixels, dtype=bool))
        shown = np.zeros((len(self.pose), pixels), dtype=np.float32)
        shown[hits.particle, hits.pixel] = 1.0
        share = gaussian_filter(
            shown.reshape(-1, *self.event_shape),
            (0.0, self.width, self.width),
            truncate=max(_REACH, 1.01 / self.width),
            mode="nearest",
        )
        rim = torch.as_tensor(self.rim, dtype=torch.float64).detach()
        if bool((rim != 0.0).any()):
            # Nothing is known of an outline that is farther off than the rays reach.
            edge = np.nonzero((share > 0.0) & (share < 1.0))
            by = (rim / self.width).expand(len(self.pose)).numpy()[edge[0]]
            quantile = torch.special.ndtri(torch.from_numpy(share[edge]).double().clamp(_SURE, 1.0 - _SURE))
            share[edge] = torch.special.ndtr(quantile + torch.from_numpy(by)).float().numpy()
        return np.asarray(self.wrong + (1.0 - 2.0 * self.wrong) * share)

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-probability (N,) of a mask (H, W), or of one for each particle (N, H, W).

        Args:
            value: 1 where the part is shown, 0 where not, NaN where unknown.

        Raises:
            InputError: the mask has another shape, or other values; a pose or a rim is not finite.
        """
        mask = value.detach().numpy()
        each = (len(self.pose), *self.event_shape)
        if tuple(mask.shape) not in (tuple(self.event_shape), each):
            raise InputError(
                f"a mask of camera {self.camera.name!r} has shape {tuple(mask.shape)}; "
                f"give one of its image's, {tuple(self.event_shape)}."
            )
        known = ~np.isnan(mask)
        if not np.isin(mask[known], (0.0, 1.0)).all():
            raise InputError(
                f"a mask of camera {self.camera.name!r} has other values than 0 and 1; "
                "give 1 where the part is shown, 0 elsewhere, and NaN where it is not known."
            )
        if self.region is not None:
            known &= np.asarray(self.region, dtype=bool)
        chances = self.chances()
        said = np.log(np.where(mask == 1.0, chances, 1.0 - chances))
        total = np.where(known, said, 0.0).sum(axis=(1, 2), dtype=np.float64)
        return torch.from_numpy(total / self.temperature)

    @property
    def log_prob_bound(self) -> float:
        """What no log-probability exceeds: there may be no pixel that counts."""
        return 0.0

    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        """One mask for each particle, (N, H, W), 0 or 1; the temperature does not change the draws.

        Raises:
            InputError: a pose or a rim is not finite, or a sample_shape was asked for.
        """
        if torch.Size(sample_shape) != torch.Size():
            raise InputError(
                "Silhouette draws one mask for each particle; ask for no sample_shape, "
                "or make it with more particles."
            )
        return torch.bernoulli(torch.from_numpy(self.chances()).double())


def binned_mask(mask: npt.ArrayLike, k: int) -> npt.NDArray[np.float64]:
    """A mask (H, W) in blocks of k x k pixels, (H // k, W // k): 1 where most of a block's pixels are true.

    `bcppl.geometry.camera.Camera.binned` is the camera that sees it.

    Raises:
        InputError: the mask has no two dimensions, or no block fits into it.
    """
    image = np.asarray(mask)
    if image.ndim != 2 or not 1 <= k <= min(image.shape):
        raise InputError(
            f"a mask of shape {image.shape} cannot be binned by {k}; give one (H, W), and a whole number "
            "from 1 to its smaller side."
        )
    rows, columns = image.shape[0] // k, image.shape[1] // k
    blocks = (image[: rows * k, : columns * k] != 0).reshape(rows, k, columns, k)
    return np.asarray(blocks.mean(axis=(1, 3)) > 0.5, dtype=np.float64)
