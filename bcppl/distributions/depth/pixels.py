"""The density of one pixel's depth, compiled, and its sum over the pixels at which rays meet a part."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from bcppl.arrays import Array, Indices, Mask
from bcppl.compiled import compiled


class PixelLaw(NamedTuple):
    """The law of a pixel's depth d where r is rendered, metres.

    p(d) = (1 - outlier) exp(-|d - r| / scale) / (2 scale) + outlier / (far - near).
    """

    near: float
    far: float
    scale: float
    outlier: float


class Pixels(NamedTuple):
    """What `sum_gains` reads of I images of P pixels, one for all particles or one for each.

    Attributes:
        depth: (I, P) as observed.
        valid: (I, P) which of them count.
        behind: (P,) depth of the background, +inf where it is unknown.
        without_part: (I, P) log-densities where no ray meets the part.
        bias: (N,) added to what is rendered; (0,) for none.
        moves: whether the background is farther by the bias, too.
    """

    depth: Array
    valid: Mask
    behind: Array
    without_part: Array
    bias: Array
    moves: bool


@compiled
def log_density(depth: float, rendered: float, law: PixelLaw) -> float:
    """The log-density of a pixel."""
    away = abs(depth - rendered) / law.scale
    if law.outlier == 0.0:
        return -away - math.log(2.0 * law.scale)
    density = math.exp(-away) * (1.0 - law.outlier) / (2.0 * law.scale)
    return math.log(density + law.outlier / (law.far - law.near))


@compiled
def log_densities(depth: Array, rendered: Array, law: PixelLaw) -> Array:
    """The same of P pixels."""
    found = np.empty(len(depth))
    for p in range(len(depth)):
        found[p] = log_density(depth[p], rendered[p], law)
    return found


@compiled
def log_totals(depth: Array, behind: Array, shift: Array, law: PixelLaw) -> Array:
    """The sums (B,) over P pixels, what is rendered farther by B shifts."""
    found = np.zeros(len(shift))
    for b in range(len(shift)):
        for p in range(len(depth)):
            found[b] += log_density(depth[p], behind[p] + shift[b], law)
    return found


@compiled
def sum_gains(
    begin: int,
    end: int,
    particle: Indices,
    pixel: Indices,
    hit: Array,
    pixels: Pixels,
    law: PixelLaw,
    gains: Array,
) -> None:
    """Add to `gains` (N,) by how much the part changes the log-densities of pixels at which rays meet it.

    Of hits `begin` to `end`: (M,) particles, pixels and depths.
    """
    each, unknown = len(pixels.depth) > 1, -math.log(law.far - law.near)
    for h in range(begin, end):
        n, p = particle[h], pixel[h]
        image = n if each else 0
        if not pixels.valid[image, p]:
            continue
        depth, behind, shift = pixels.depth[image, p], pixels.behind[p], 0.0
        if len(pixels.bias):
            shift = pixels.bias[n]
        without = pixels.without_part[image, p]
        if pixels.moves:
            without = log_density(depth, behind + shift, law) if behind < np.inf else unknown
            behind += shift
        gains[n] += log_density(depth, min(hit[h] + shift, behind), law) - without
