"""One line of a depth image as a chain, compiled: what each pixel shows, given what the one before it shows.

A pixel shows the part or something unknown. What is unknown goes on from pixel to pixel as it was, or jumps;
the part's error goes on as well. Which of the two it is, is summed over by the forward algorithm (Rabiner,
A tutorial on hidden Markov models, Proc. IEEE 77, 1989, section III.A). Missing pixels are skipped.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np
from numba import njit

from bcppl.distributions.depth.rendering import Array, Mask

F = TypeVar("F", bound=Callable[..., Any])


class Chances(NamedTuple):
    """What the chain is made of; lengths in metres. `ClutteredDepth` says what each means."""

    near: float
    far: float
    scale: float
    correlation: float
    wander: float
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
    """Where a line lies in an image that is flattened: pixel t of it at `base + t * stride`."""

    base: int
    stride: int
    length: int


class Lines(NamedTuple):
    """The lines of one direction of an image (H * W,).

    Attributes:
        previous: the last depth before each pixel on its line, NaN where there is none, metres.
        usual: the density of each pixel where no part is, 1 / m.
    """

    previous: Array
    usual: Array


def compiled(function: F) -> F:
    """Compile on first use; the code is kept where a folder can be written."""
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
    """The share of a Laplace distribution below an error."""
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
def read(depth: Array, valid: Mask, line: Line, chances: Chances, lines: Lines) -> float:
    """Write what a line says without a part to `lines`, and return its log-density."""
    uniform = 1.0 / (chances.far - chances.near)
    last, total = np.nan, 0.0
    for t in range(line.length):
        p = line.base + t * line.stride
        lines.previous[p] = last
        if not valid[p]:
            continue
        goes_on = uniform if np.isnan(last) else laplace(depth[p] - last, chances.step)
        lines.usual[p] = (1.0 - chances.jump) * goes_on + chances.jump * uniform
        total += math.log(lines.usual[p])
        last = depth[p]
    return total


@compiled
def is_inside(rendered: Array, line: Line, t: int, rim: int) -> bool:
    """Whether all pixels of the line within `rim` of t see the part; what is beyond the image may."""
    for s in range(max(0, t - rim), min(line.length, t + rim + 1)):
        if not rendered[line.base + s * line.stride] < np.inf:
            return False
    return True


@compiled
def to_visible(hit: bool, inside: bool, was_inside: bool, chances: Chances) -> tuple[float, float]:
    """The probabilities that the part is seen, after it was seen and after it was not."""
    if not hit:
        return 0.0, 0.0
    if not inside:
        return 1.0 - chances.leave, chances.enter
    return 1.0 - chances.switch, chances.switch if was_inside else chances.visible


@compiled
def gain(
    depth: Array,
    valid: Mask,
    rendered: Array,
    line: Line,
    first: int,
    last: int,
    chances: Chances,
    lines: Lines,
) -> float:
    """By how much the part, rendered at (H * W,), +inf where it is not, changes a line's log-density.

    `first` and `last` are the first and last pixel of the line that see the part.
    """
    uniform = 1.0 / (chances.far - chances.near)
    seen, hidden, total = 0.0, 1.0, 0.0
    was_inside, error_before, at_before = False, 0.0, -2
    for t in range(first, line.length):
        p = line.base + t * line.stride
        if not valid[p]:
            continue
        surface, usual, previous = rendered[p], lines.usual[p], lines.previous[p]
        known = not np.isnan(previous)
        hit = surface < np.inf
        inside = hit and is_inside(rendered, line, t, chances.rim)
        stays, comes = to_visible(hit, inside, was_inside, chances)
        shown = follows = 0.0
        if hit:
            error = depth[p] - surface
            shown = follows = laplace(error, chances.scale)
            if t == at_before + 1:
                smooth = laplace(error - chances.correlation * error_before, chances.wander)
                follows = (1.0 - chances.rough) * smooth + chances.rough * shown
            error_before, at_before = error, t
        if inside:
            room = max(min(surface, chances.far) - chances.near, 1e-9)
            share = room * uniform
            if known:
                share *= chances.jump
                share += (1.0 - chances.jump) * below(surface - previous, chances.step)
            before = 1.0 if depth[p] < surface else 0.0
            other = (1.0 - chances.through) * before * usual / share + chances.through * uniform
            anew = (1.0 - chances.through) * before / room + chances.through * uniform
        else:
            other = usual
            goes_on = laplace(depth[p] - previous, chances.step) if known else uniform
            anew = (1.0 - chances.abut) * uniform + chances.abut * goes_on
        now_seen = (seen * stays * follows + hidden * comes * shown) / usual
        now_hidden = (seen * (1.0 - stays) * anew + hidden * (1.0 - comes) * other) / usual
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
    chances: Chances,
    rows: Lines,
    columns: Lines,
) -> tuple[float, float]:
    """`gain` summed over the rows and over the columns that are looked at, for one particle.

    Every `spacing`-th line is; `pixel` and `surface` (M,) are what the particle sees of the part; `rendered`
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
            line = Line(v * width, 1, width)
            first, last = left, right
            while first <= last and not rendered[v * width + first] < np.inf:
                first += 1
            while last >= first and not rendered[v * width + last] < np.inf:
                last -= 1
            if first <= last:
                of_rows += gain(depth, valid, rendered, line, first, last, chances, rows)
    for u in range(left, right + 1):
        if u % spacing == spacing // 2:
            line = Line(u, width, height)
            first, last = top, bottom
            while first <= last and not rendered[first * width + u] < np.inf:
                first += 1
            while last >= first and not rendered[last * width + u] < np.inf:
                last -= 1
            if first <= last:
                of_columns += gain(depth, valid, rendered, line, first, last, chances, columns)
    for k in range(len(pixel)):
        rendered[pixel[k]] = np.inf
    return of_rows, of_columns


@compiled
def draw(rendered: Array, line: Line, chances: Chances, chance: Array, drawn: Array) -> None:
    """Write a draw of a line to `drawn` (H * W,), from uniform numbers `chance` (H * W, 3)."""
    near, far = chances.near, chances.far
    seen = was_inside = False
    error, previous = 0.0, np.nan
    at_before = -2
    for t in range(line.length):
        p = line.base + t * line.stride
        surface = rendered[p]
        hit = surface < np.inf
        inside = hit and is_inside(rendered, line, t, chances.rim)
        stays, comes = to_visible(hit, inside, was_inside, chances)
        which, kind, where = chance[p, 0], chance[p, 1], chance[p, 2]
        was_seen, seen = seen, which < (stays if seen else comes)
        known = not np.isnan(previous)
        if seen:
            if was_seen and t == at_before + 1 and kind >= chances.rough:
                value = surface + chances.correlation * error + quantile(where, chances.wander)
            else:
                value = surface + quantile(where, chances.scale)
        else:
            goes_on = (chances.abut if was_seen else 1.0 - chances.jump) if known else 0.0
            reach, top = 1.0, far
            if inside and kind >= chances.through:
                kind = (kind - chances.through) / (1.0 - chances.through)
                top = max(min(surface, far), near + 1e-9)
                if known and not was_seen:
                    reach = below(surface - previous, chances.step)
                    goes_on *= reach
                    goes_on /= goes_on + chances.jump * (top - near) / (far - near)
                else:
                    goes_on = 0.0
            elif inside:
                goes_on = 0.0
            if kind < goes_on:
                value = previous + quantile(where * reach, chances.step)
            else:
                value = near + (top - near) * where
        if hit:
            error, at_before = value - surface, t
        drawn[p] = previous = value
        was_inside = inside
