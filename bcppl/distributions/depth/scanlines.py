"""One line of a depth image as a hidden Markov chain, compiled.

The hidden state of a pixel is whether it shows the part or unknown clutter. The depth of clutter continues
from pixel to pixel, or jumps; the error of the part's depth is autocorrelated. States are summed out by the
forward algorithm (Rabiner, A tutorial on hidden Markov models, Proc. IEEE 77, 1989, section III.A). Missing
pixels are skipped.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np
from numba import njit

from bcppl.arrays import Array, Mask

F = TypeVar("F", bound=Callable[..., Any])


class Chain(NamedTuple):
    """Parameters of the chain: those of `ClutteredDepth`, after `wander`; lengths in metres."""

    near: float
    far: float
    wander: float
    scale: float
    correlation: float
    rough: float
    step: float
    jump: float
    visible: float
    switch: float
    enter: float
    leave: float
    abut: float
    through: float
    rim: int


class Line(NamedTuple):
    """A line of an image that is flattened: its pixel t is at `base + t * stride`."""

    base: int
    stride: int
    length: int


class Lines(NamedTuple):
    """The lines of one direction of an image (H * W,)."""

    previous: Array  # the last depth before each pixel on its line, NaN where there is none, metres
    without_part: Array  # the density of each pixel without a part, 1 / m


def compiled(function: F) -> F:
    """Compile on first use; the code is cached on disk where a folder can be written."""
    try:
        return cast(F, njit(cache=True, nogil=True, error_model="numpy")(function))
    except RuntimeError:  # no such folder
        return cast(F, njit(nogil=True, error_model="numpy")(function))


@compiled
def laplace(error: float, scale: float) -> float:
    """The density of a Laplace distribution at an error."""
    return math.exp(-abs(error) / scale) / (2.0 * scale)


@compiled
def below(error: float, scale: float) -> float:
    """The distribution function of a Laplace distribution at an error."""
    if error < 0.0:
        return 0.5 * math.exp(error / scale)
    return 1.0 - 0.5 * math.exp(-error / scale)


@compiled
def quantile(share: float, scale: float) -> float:
    """The inverse of `below`."""
    if share < 0.5:
        return scale * math.log(max(2.0 * share, 1e-300))
    return -scale * math.log(max(2.0 * (1.0 - share), 1e-300))


@compiled
def scan(depth: Array, valid: Mask, line: Line, chain: Chain, lines: Lines) -> float:
    """Write the densities of a line without a part to `lines`, and return its log-density."""
    uniform = 1.0 / (chain.far - chain.near)
    last, total = np.nan, 0.0
    for t in range(line.length):
        p = line.base + t * line.stride
        lines.previous[p] = last
        if not valid[p]:
            continue
        goes_on = uniform if np.isnan(last) else laplace(depth[p] - last, chain.step)
        lines.without_part[p] = (1.0 - chain.jump) * goes_on + chain.jump * uniform
        total += math.log(lines.without_part[p])
        last = depth[p]
    return total


@compiled
def is_inside(rendered: Array, line: Line, t: int, rim: int) -> bool:
    """Whether all pixels of the line within `rim` of t, inside the image, see the part."""
    for s in range(max(0, t - rim), min(line.length, t + rim + 1)):
        if not rendered[line.base + s * line.stride] < np.inf:
            return False
    return True


@compiled
def to_visible(hit: bool, inside: bool, was_inside: bool, chain: Chain) -> tuple[float, float]:
    """The probabilities that a pixel shows the part, after one that does and after one that does not."""
    if not hit:
        return 0.0, 0.0
    if not inside:
        return 1.0 - chain.leave, chain.enter
    return 1.0 - chain.switch, chain.switch if was_inside else chain.visible


@compiled
def gain(
    depth: Array, valid: Mask, rendered: Array, line: Line, first: int, last: int, chain: Chain, lines: Lines
) -> float:
    """The log-likelihood ratio of a line with the part, rendered at (H * W,), +inf where absent, to none.

    Only pixels from `first` to `last` see the part.
    """
    while first <= last and not rendered[line.base + first * line.stride] < np.inf:
        first += 1
    while last >= first and not rendered[line.base + last * line.stride] < np.inf:
        last -= 1
    if first > last:
        return 0.0
    uniform = 1.0 / (chain.far - chain.near)
    seen, hidden, total = 0.0, 1.0, 0.0
    was_inside, error_before, at_before = False, 0.0, -2
    for t in range(first, line.length):
        p = line.base + t * line.stride
        if not valid[p]:
            continue
        surface, without_part, previous = rendered[p], lines.without_part[p], lines.previous[p]
        known = not np.isnan(previous)
        hit = surface < np.inf
        inside = hit and is_inside(rendered, line, t, chain.rim)
        stays, comes = to_visible(hit, inside, was_inside, chain)
        shown = follows = 0.0
        if hit:
            error = depth[p] - surface
            shown = follows = laplace(error, chain.scale)
            if t == at_before + 1:
                smooth = laplace(error - chain.correlation * error_before, chain.wander)
                follows = (1.0 - chain.rough) * smooth + chain.rough * shown
            error_before, at_before = error, t
        if inside:
            room = max(min(surface, chain.far) - chain.near, 1e-9)
            share = room * uniform
            if known:
                share *= chain.jump
                share += (1.0 - chain.jump) * below(surface - previous, chain.step)
            before = 1.0 if depth[p] < surface else 0.0
            other = (1.0 - chain.through) * before * without_part / share + chain.through * uniform
            fresh = (1.0 - chain.through) * before / room + chain.through * uniform
        else:
            other = without_part
            goes_on = laplace(depth[p] - previous, chain.step) if known else uniform
            fresh = (1.0 - chain.abut) * uniform + chain.abut * goes_on
        now_seen = (seen * stays * follows + hidden * comes * shown) / without_part
        now_hidden = (seen * (1.0 - stays) * fresh + hidden * (1.0 - comes) * other) / without_part
        both = now_seen + now_hidden
        total += math.log(both)
        seen, hidden = now_seen / both, now_hidden / both
        was_inside = inside
        if t > last:
            break
    return total


@compiled
def gains(
    depth: Array,
    valid: Mask,
    shape: tuple[int, int],
    spacing: int,
    pixel: np.ndarray,
    surface: Array,
    rendered: Array,
    chain: Chain,
    rows: Lines,
    columns: Lines,
) -> tuple[float, float]:
    """`gain` summed over every `spacing`-th row and over every such column, for one particle.

    `pixel` and `surface` (M,) are the pixels that see the particle's part and its depth there; `rendered`
    (H * W,) is +inf everywhere, and left so.
    """
    height, width = shape
    top, bottom, left, right = height, -1, width, -1
    for k in range(len(pixel)):
        rendered[pixel[k]] = surface[k]
        v, u = pixel[k] // width, pixel[k] % width
        top, bottom, left, right = min(top, v), max(bottom, v), min(left, u), max(right, u)
    of_rows = of_columns = 0.0
    for v in range(top, bottom + 1):
        if v % spacing == spacing // 2:
            of_rows += gain(depth, valid, rendered, Line(v * width, 1, width), left, right, chain, rows)
    for u in range(left, right + 1):
        if u % spacing == spacing // 2:
            line = Line(u, width, height)
            of_columns += gain(depth, valid, rendered, line, top, bottom, chain, columns)
    for k in range(len(pixel)):
        rendered[pixel[k]] = np.inf
    return of_rows, of_columns


@compiled
def draw(rendered: Array, line: Line, chain: Chain, uniform: Array, drawn: Array) -> None:
    """Write a draw of a line to `drawn` (H * W,), from uniform numbers (H * W, 3)."""
    near, far = chain.near, chain.far
    seen = was_inside = False
    error, previous = 0.0, np.nan
    at_before = -2
    for t in range(line.length):
        p = line.base + t * line.stride
        surface = rendered[p]
        hit = surface < np.inf
        inside = hit and is_inside(rendered, line, t, chain.rim)
        stays, comes = to_visible(hit, inside, was_inside, chain)
        which, kind, where = uniform[p, 0], uniform[p, 1], uniform[p, 2]
        was_seen, seen = seen, which < (stays if seen else comes)
        known = not np.isnan(previous)
        if seen:
            if was_seen and t == at_before + 1 and kind >= chain.rough:
                value = surface + chain.correlation * error + quantile(where, chain.wander)
            else:
                value = surface + quantile(where, chain.scale)
        else:
            goes_on = (chain.abut if was_seen else 1.0 - chain.jump) if known else 0.0
            reach, top = 1.0, far
            if inside and kind >= chain.through:
                kind = (kind - chain.through) / (1.0 - chain.through)
                top = max(min(surface, far), near + 1e-9)
                if known and not was_seen:
                    reach = below(surface - previous, chain.step)
                    goes_on *= reach
                    goes_on /= goes_on + chain.jump * (top - near) / (far - near)
                else:
                    goes_on = 0.0
            elif inside:
                goes_on = 0.0
            if kind < goes_on:
                value = previous + quantile(where * reach, chain.step)
            else:
                value = near + (top - near) * where
        if hit:
            error, at_before = value - surface, t
        drawn[p] = previous = value
        was_inside = inside
