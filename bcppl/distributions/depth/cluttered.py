"""A depth image of a part among clutter that is not modelled."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass, field
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.ndimage import binary_erosion
from scipy.special import betainc
from torch import Tensor
from torch.utils.weak import WeakTensorKeyDictionary

from bcppl.arrays import Array, Mask
from bcppl.distributions.checks import Check
from bcppl.distributions.depth.camera_image import CameraImage
from bcppl.distributions.depth.noise import RobustDepth
from bcppl.distributions.depth.observed import Observed
from bcppl.distributions.depth.scanlines import Chain, Line, Lines, draw, gains, scan
from bcppl.distributions.parameters import COUNT, POSITIVE, PROBABILITY, within

_BEHIND = 3.0  # scales: farther behind the part, a pixel sees through it


class _Scanned(NamedTuple):
    """The densities of an image's lines without a part, and the inputs that they were computed from."""

    chain: Chain
    spacing: int
    depth: Array
    valid: Mask
    rows: Lines
    columns: Lines
    of_rows: float
    of_columns: float


@dataclass(eq=False, repr=False)
class ClutteredDepth(CameraImage):
    """A depth image of a part among unknown clutter whose depth continues from one pixel to the next.

    `RobustDepth` takes the pixels around a part and before it as uniform and independent. Then any smooth
    surface that is large enough has a higher likelihood as the part than as clutter, and a part of which a
    fifth is in view is placed in a table or in a tool beside it. Here clutter is smooth too, so a part gains
    by its edges and its shape: where both the image and the part jump, and where depth changes as the part's
    surface does. And an occluder may hide it for many pixels at one price.

    Along a line of the image each pixel shows the part or clutter (a hidden Markov chain, see
    `bcppl.distributions.depth.scanlines`):

    - clutter after clutter: the same depth with a Laplace error of scale `step`, or, with probability `jump`,
      any depth in the sensor's range;
    - clutter after the part: any depth, or with probability `abut` the same: things touch;
    - clutter where the part is rendered: nearer than the part, but for a share `through`. Within `rim` pixels
      of the part's outline it may be farther as well: outlines are off by a pixel or two;
    - the part: Laplace error of the given `scale`, which after a pixel of the part follows an autoregression,
      or, with probability `rough`, is independent.

    The defaults fit a Kinect's image of a table at 1.1 m: jumps at one pixel of a hundred, steps of 1.3 mm on
    average between them, errors on parts in full view of 4 to 6.4 mm with a correlation of 0.81 to 0.89 from
    pixel to pixel. `step` is three times as wide, since clutter is less flat than a table.

    The log-density is the mean of that of the rows and that of the columns, of every `lines`-th of each. That
    is no density of the image: evidence that contains it is a surrogate's. `sample` draws the rows alone;
    errors may push a pixel out of the sensor's range, where `log_prob` takes it for missing.

    Args:
        renderer: renders one part.
        camera: takes the image; pixels out of its range, and out of a `region`, are missing.
        pose: (N, 7) `world_from_part`.
        scale: of the Laplace error of a pixel that shows the part, metres.
        lines: every so many rows and columns are evaluated; neighbouring ones are nearly copies.
        temperature: the divisor of the log-likelihood.
        correlation: of the error from one pixel of the part to the next, from 0 up to below 1.
        rough: the probability that the error is independent of the one before.
        step: of the depth of clutter from pixel to pixel, metres.
        jump: the probability that a pixel shows other clutter than the one before.
        visible: the probability that a part is in view where a line enters it.
        switch: the probability at each pixel that an occluder begins or ends.
        enter, leave: the same at each pixel of the rim.
        abut: the probability that the clutter after the part touches it.
        through: the share of pixels that show clutter behind the part.
        rim: pixels.
    """

    scale: float = field(metadata=POSITIVE)
    _: KW_ONLY
    lines: int = field(default=4, metadata=COUNT)
    temperature: float = field(default=1.0, metadata=POSITIVE)
    correlation: float = field(default=0.85, metadata=within(least=0.0, below=1.0))
    rough: float = field(default=0.1, metadata=PROBABILITY)
    step: float = field(default=0.004, metadata=POSITIVE)
    jump: float = field(default=0.01, metadata=PROBABILITY)
    visible: float = field(default=0.8, metadata=PROBABILITY)
    switch: float = field(default=0.03, metadata=PROBABILITY)
    enter: float = field(default=0.4, metadata=PROBABILITY)
    leave: float = field(default=0.2, metadata=PROBABILITY)
    abut: float = field(default=0.05, metadata=PROBABILITY)
    through: float = field(default=0.02, metadata=PROBABILITY)
    rim: int = field(default=3, metadata=within(least=0, whole=True))

    def __post_init__(self) -> None:
        super().__post_init__()
        camera, wander = self.camera, self.scale * math.sqrt(1.0 - self.correlation**2)
        own = {name: getattr(self, name) for name in Chain._fields[3:]}
        self.chain = Chain(camera.near, camera.far, wander, **own)

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-probability (N,) of a depth image (H, W), or of one for each particle (N, H, W)."""
        rows, columns = self._of_lines(value)
        return 0.5 * (rows + columns) / self.temperature

    def observed(self, value: Tensor) -> Observed:
        """The valid pixels of an image (H, W), or of one for each particle, where the lines cross.

        Alignments use it (`bcppl.inference.proposals.depth_alignment`), `log_prob` does not.
        """
        crossings = np.zeros(tuple(self.event_shape), dtype=bool)
        crossings[self.lines // 2 :: self.lines, self.lines // 2 :: self.lines] = True
        if self.region is not None:
            crossings &= np.asarray(self.region, dtype=bool)
        alone = RobustDepth(self.renderer, self.camera, self.pose, self.scale, outlier=0.05, region=crossings)
        return alone.observed(value)

    def predictive_check(self, value: Tensor, replicas: Callable[[], Any]) -> Check:
        """The check of an image (H, W) at P particles (`bcppl.distributions.checks.Checked`).

        Things may stand before a part, but none explains that it is seen through. The discrepancy is the
        number of pixels inside its outline that read farther than it by three scales. Its distribution is
        binomial, of the share `through` and the errors' tail, over as many independent pixels as the
        correlation of the errors leaves along both directions.
        """
        hits = self.renderer.hits(self.camera, self.pose.detach())
        depth, valid = self._read(value)
        rate = self.through + 0.5 * math.exp(-_BEHIND)
        probability, excess = np.ones(len(self.pose)), np.zeros(len(self.pose))
        for k in range(len(self.pose)):
            own = hits.particle == k
            rendered = np.full(depth.shape, np.inf)
            rendered[hits.pixel[own]] = hits.depth[own]
            solid = np.isfinite(rendered).reshape(tuple(self.event_shape))
            inside = valid & binary_erosion(solid, iterations=max(self.rim, 1)).reshape(-1)
            behind = depth[inside] - rendered[inside] > _BEHIND * self.scale
            count = len(behind) / integrated_autocorrelation(self.correlation) ** 2
            if behind.any():
                # The incomplete beta function is the binomial's tail, also between whole numbers.
                seen = float(behind.mean()) * count
                probability[k] = betainc(seen, count - seen + 1.0, rate)
                excess[k] = (seen - count * rate) / math.sqrt(count * rate * (1.0 - rate))
        return Check(float(probability.mean()), "through", float(excess.mean()))

    def _read(self, value: Tensor) -> tuple[Array, Mask]:
        """The depth (H * W,) of an image (H, W), and which of its pixels are in range and may count."""
        depth = value.detach().numpy().reshape(-1).astype(np.float64)
        with np.errstate(invalid="ignore"):
            valid = (depth > 0.0) & (depth >= self.camera.near) & (depth <= self.camera.far)
        if self.region is not None:
            valid &= np.asarray(self.region, dtype=bool).reshape(-1)
        return depth, valid

    def _of_lines(self, value: Tensor) -> tuple[Tensor, Tensor]:
        """Log-densities (N,) of the rows and of the columns.

        With every row evaluated that of the rows is a density of the image, from which `sample` draws.
        """
        self._check_finite()
        self._check_image(value)
        count = len(self.pose)
        each = [self._scanned(value)] if value.ndim == 2 else [self._scanned(image) for image in value]
        height, width = self.event_shape
        evaluated = np.zeros((height, width), dtype=bool)
        evaluated[self.lines // 2 :: self.lines] = True
        evaluated[:, self.lines // 2 :: self.lines] = True
        hits = self.renderer.hits(self.camera, self.pose.detach(), evaluated.reshape(-1))
        ends = np.searchsorted(hits.particle, np.arange(count + 1))
        rendered = np.full(height * width, np.inf)
        log_densities = np.empty((2, count))
        for k in range(count):
            scanned = each[k % len(each)]
            own = slice(ends[k], ends[k + 1])
            of_rows, of_columns = gains(
                scanned.depth, scanned.valid, (height, width), self.lines, hits.pixel[own], hits.depth[own],
                rendered, self.chain, scanned.rows, scanned.columns,
            )  # fmt: skip
            log_densities[:, k] = scanned.of_rows + of_rows, scanned.of_columns + of_columns
        rows, columns = torch.from_numpy(log_densities)
        return rows, columns

    def _sample(self) -> Tensor:
        count, (height, width) = len(self.pose), self.event_shape
        images = self.renderer.images(self.camera, self.pose.detach()).reshape(count, -1)
        drawn = np.empty((count, height * width))
        for k in range(count):
            uniform = torch.rand(height * width, 3, dtype=torch.float64).numpy()
            for v in range(height):
                draw(images[k], Line(v * width, 1, width), self.chain, uniform, drawn[k])
        return torch.from_numpy(drawn.reshape(count, height, width))

    def _scanned(self, value: Tensor) -> _Scanned:
        """The densities of an image (H, W) without a part; cached with it for as long as it is unchanged."""
        depth, valid = self._read(value)
        cached: _Scanned | None = CACHE.get(value)
        if (
            cached is not None
            and (cached.chain, cached.spacing) == (self.chain, self.lines)
            and np.array_equal(cached.depth, depth, equal_nan=True)
            and np.array_equal(cached.valid, valid)
        ):
            return cached
        height, width = self.event_shape
        across = [Line(v * width, 1, width) for v in range(self.lines // 2, height, self.lines)]
        down = [Line(u, width, height) for u in range(self.lines // 2, width, self.lines)]
        rows, columns = (Lines(np.full(depth.shape, np.nan), np.full(depth.shape, np.nan)) for _ in range(2))
        of_rows = math.fsum(scan(depth, valid, line, self.chain, rows) for line in across)
        of_columns = math.fsum(scan(depth, valid, line, self.chain, columns) for line in down)
        scanned = _Scanned(self.chain, self.lines, depth, valid, rows, columns, of_rows, of_columns)
        CACHE[value] = scanned
        return scanned


def integrated_autocorrelation(correlation: float) -> float:
    """The number of members of a first-order autoregression that are worth one independent number.

    Sokal, Monte Carlo methods in statistical mechanics: foundations and new algorithms, 1989, section 2.
    """
    return (1.0 + correlation) / (1.0 - correlation)


# Every run of a program builds new distributions, at other poses: the cache belongs to the image.
CACHE: WeakTensorKeyDictionary = WeakTensorKeyDictionary()
