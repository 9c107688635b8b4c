"""A part's silhouette: the pixels of an image that show it, from a segmentation.

A mask has no ranges, but its outline is the part's, to a pixel or two, while a stereo sensor smears it over a
matching window. Masks have three kinds of error, each with a parameter here: the outline wanders; it lies
inside or outside everywhere (one segmentation erodes a rim, another dilates by one); whole patches are
misclassified.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from scipy.ndimage import gaussian_filter
from torch import Tensor

from bcppl.distributions.depth.camera_image import CameraImage
from bcppl.distributions.depth.image import DepthDistribution
from bcppl.distributions.depth.rendering import CachedHits
from bcppl.distributions.parameters import POSITIVE, within
from bcppl.errors import InputError

_REACH = 3.0  # standard deviations of the outline at which the smoothing is truncated
_LEAST = 1e-9  # shares of rays are kept this far from 0 and 1, so that the normal's quantiles are finite


@dataclass(eq=False, repr=False)
class Silhouette(CameraImage):
    """A mask whose pixels are independent given the part's pose.

    A pixel's ray is off by a normal of standard deviation `width` pixels in each direction: the share c of
    such rays that hit the part is the probability that the outline encloses the pixel. With a rim of r pixels
    the outline lies farther out by that much, which makes it F(F^-1(c) + r / width), F the standard normal's
    distribution function: exact at straight edges. Independently, a pixel is misclassified with probability
    `flipped`. So p(part) = flipped + (1 - 2 flipped) F(F^-1(c) + r / width).

    The errors of neighbouring pixels are correlated: `temperature` divides the log-likelihood, which then is
    no density, and does not change the draws. Soft silhouettes are those of Liu, Li, Chen and Li, Soft
    Rasterizer, ICCV 2019, section 3.3.

    Args:
        renderer: renders the part, or several.
        camera: takes the image.
        pose: (N, 7) `world_from_part`; (N, K, 7) for a renderer of K parts.
        width: standard deviation of the outline's position, pixels of this camera.
        flipped: the probability that a pixel is misclassified, above 0 and below 0.5.
        rim: (N,) or one for all, pixels by which the mask is dilated; below 0, eroded.
        temperature: the divisor of the log-likelihood.
        region: (H, W) pixels that count at all; None for all.
    """

    latent = ("pose", "rim")

    width: float = field(metadata=POSITIVE)
    flipped: float = field(default=0.05, metadata=within(above=0.0, below=0.5))
    rim: Tensor | float = field(default=0.0, kw_only=True)
    temperature: float = field(default=1.0, kw_only=True, metadata=POSITIVE)

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check_shape("a rim", self.rim, (), self.batch_shape)
        self._hits = CachedHits(partial(self.renderer.hits, self.camera, self.pose.detach()), None).keep_all()

    @classmethod
    def from_depth(
        cls, depth: DepthDistribution, width: float, flipped: float = 0.05, **others: Any
    ) -> Silhouette:
        """The silhouette of the parts of a depth image, by the same camera: both are rendered once, together.

        The region of the depth image is not the mask's.
        """
        silhouette = cls(depth.renderer, depth.camera, depth.apparent_pose, width, flipped, **others)
        silhouette._hits = depth.all_hits()
        return silhouette

    def probabilities(self) -> npt.NDArray[np.float32]:
        """The probability (N, H, W) that the mask is 1 at a pixel."""
        self._check_finite()
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
            # Beyond the truncation the distance to the outline is unknown.
            edge = np.nonzero((share > 0.0) & (share < 1.0))
            by = (rim / self.width).expand(len(self.pose)).numpy()[edge[0]]
            quantile = torch.special.ndtri(torch.from_numpy(share[edge]).double().clamp(_LEAST, 1.0 - _LEAST))
            share[edge] = torch.special.ndtr(quantile + torch.from_numpy(by)).float().numpy()
        return np.asarray(self.flipped + (1.0 - 2.0 * self.flipped) * share)

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-probability (N,) of a mask (H, W), or of one for each particle (N, H, W).

        Args:
            value: 1 where the part is shown, 0 where not, NaN where unknown.
        """
        self._check_image(value)
        mask = value.detach().numpy()
        known = ~np.isnan(mask)
        if not np.isin(mask[known], (0.0, 1.0)).all():
            raise InputError(
                f"a mask of camera {self.camera.name!r} has other values than 0 and 1; "
                "give 1 where the part is shown, 0 elsewhere, and NaN where unknown."
            )
        if self.region is not None:
            known &= np.asarray(self.region, dtype=bool)
        probabilities = self.probabilities()
        terms = np.log(np.where(mask == 1.0, probabilities, 1.0 - probabilities))
        total = np.where(known, terms, 0.0).sum(axis=(1, 2), dtype=np.float64)
        return torch.from_numpy(total / self.temperature)

    @property
    def log_prob_bound(self) -> float:
        """0: the log-probability of each pixel is at most 0."""
        return 0.0

    def _sample(self) -> Tensor:
        return torch.bernoulli(torch.from_numpy(self.probabilities()).double())


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
