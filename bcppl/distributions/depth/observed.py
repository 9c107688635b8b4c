"""The densities of a depth image without any part: computed once, cached with the image."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
from torch.utils.weak import WeakTensorKeyDictionary

from bcppl.arrays import Array, Mask
from bcppl.cached import cached_property
from bcppl.distributions.depth.pixels import PixelLaw, log_totals
from bcppl.errors import InputError

MOST_TOTALS = 100_000  # biases whose totals are cached


@dataclass(frozen=True, eq=False)
class Observed:
    """The part of a depth likelihood that depends on the observation only, the same for all particles.

    Attributes:
        settings: those of the distribution.
        arrays: copies of the observation, (H, W) or (N, H, W), and of the distribution's background and
            region (H, W), None where it has none.
        behind: the depth of the background, +inf where unknown, (H * W,).
        depth: its pixels, (1 or N, H * W).
        valid: which of them count, (1 or N, H * W).
        without_part: their log-density where no ray meets the part, 0 where they do not count,
            (1 or N, H * W).
        power: the factor of the log-likelihood, (1 or N,).
        totals: log-density of one image without the part, by the bias of the range.
    """

    settings: tuple[Any, ...]
    arrays: list[npt.NDArray[Any] | None]
    behind: Array
    depth: Array
    valid: Mask
    without_part: Array
    power: Array
    totals: dict[float, float] = field(default_factory=dict)

    def matches(self, settings: tuple[Any, ...], arrays: list[npt.NDArray[Any] | None]) -> bool:
        """Whether these inputs are those it was computed from: the arrays may have been written to.

        All numbers are compared, which takes 15 us for 160 x 120 pixels, half as long as hashing them.
        """
        return self.settings == settings and all(map(_alike, self.arrays, arrays))

    @cached_property
    def total_without_part(self) -> Array:
        """The log-density of each image where no ray meets the part and there is no bias, (1 or N,)."""
        return np.asarray(self.without_part.sum(axis=1))

    def totals_at(self, law: PixelLaw, bias: Array) -> Array:
        """The log-density (N,) of the image without the part, its background farther by biases (N,).

        Each bias is evaluated once: particles that were copied, or moved in other coordinates, share it.
        """
        if len(self.depth) > 1:
            return np.array([self._total(k, law, bias[k : k + 1])[0] for k in range(len(bias))])
        biases = bias.tolist()
        unknown = sorted({b for b in biases if b not in self.totals})
        if len(self.totals) + len(unknown) > MOST_TOTALS:
            self.totals.clear()
            unknown = sorted(set(biases))
        if unknown:
            self.totals.update(zip(unknown, self._total(0, law, np.array(unknown)).tolist(), strict=True))
        return np.array([self.totals[b] for b in biases])

    def apart(self, law: PixelLaw) -> tuple[Array, Mask]:
        """The log-density (1 or N,) of the pixels without a background, and which (P,) have one.

        Raises:
            InputError: of several images other pixels count, and there is a background.
        """
        known = self.valid & np.isfinite(self.behind)
        if (known != known[:1]).any():
            raise InputError(
                "images of which different pixels count are compared with a background on the processor "
                "only; run there."
            )
        nothing = -math.log(law.far - law.near) * (self.valid.sum(axis=1) - known.sum(axis=1))
        return nothing, known[0]

    def _total(self, image: int, law: PixelLaw, biases: Array) -> Array:
        """The log-density of one image without the part, at each of some biases."""
        known = np.flatnonzero(self.valid[image] & np.isfinite(self.behind))
        nothing = -math.log(law.far - law.near) * float(self.valid[image].sum() - len(known))
        return nothing + log_totals(self.depth[image].take(known), self.behind.take(known), biases, law)


def _alike(first: npt.NDArray[Any] | None, second: npt.NDArray[Any] | None) -> bool:
    """Whether two arrays are equal to the bit, so that NaN equals NaN."""
    if first is None or second is None or first.shape != second.shape or first.dtype != second.dtype:
        return first is second
    bits = np.dtype(f"u{first.itemsize}")
    return np.array_equal(np.ascontiguousarray(first).view(bits), np.ascontiguousarray(second).view(bits))


# Every run of a program builds new distributions, at other poses: the cache belongs to the image.
CACHE: WeakTensorKeyDictionary = WeakTensorKeyDictionary()
