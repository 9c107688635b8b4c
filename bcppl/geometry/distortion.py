"""Brown's lens distortion and its inverse on the normalised image plane z = 1.

A point (x, y) at radius r is imaged at x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2), and
likewise in y with p1 and p2 exchanged: Brown, Decentering distortion of lenses, 1966, in the order of
OpenCV's calibration: k1 k2 p1 p2 k3. The inverse has no closed form and is computed by Newton's method.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from bcppl.arrays import Array, Mask
from bcppl.errors import InputError

# Width, height, (fx, fy, cx, cy) and k1 k2 p1 p2 (k3): all that the rays depend on.
Optics = tuple[int, int, tuple[float, float, float, float], tuple[float, ...]]

LARGEST = 1e3  # largest coordinate on the plane z = 1 that is imaged; sixth powers stay finite
MOST_STEPS = 50  # of Newton's method
EXACT = 1e-12  # residual on the plane z = 1
ALONG = 16  # points between the optical axis and a pixel at which the Jacobian is checked for a fold


def coefficients(distortion: tuple[float, ...]) -> tuple[float, float, float, float, float]:
    """The five coefficients k1 k2 p1 p2 k3, zero where not given.

    Raises:
        InputError: there are not 0, 4 or 5 of them, or one is not finite.
    """
    if len(distortion) not in (0, 4, 5) or not np.isfinite(distortion).all():
        raise InputError(
            f"the distortion {[float(f'{k:.4g}') for k in distortion]} is not Brown's k1 k2 p1 p2 (k3), four "
            "or five finite numbers; calibrate with that model, or rectify the images."
        )
    k1, k2, p1, p2, k3 = (*distortion, *(0.0,) * (5 - len(distortion)))
    return k1, k2, p1, p2, k3


def distorted(plane: Array, distortion: tuple[float, ...]) -> Array:
    """The distorted positions (..., 2) of points (..., 2) of the plane z = 1."""
    k1, k2, p1, p2, k3 = coefficients(distortion)
    x, y = plane[..., 0], plane[..., 1]
    square = x * x + y * y
    radial = 1.0 + square * (k1 + square * (k2 + square * k3))
    return np.stack(
        [
            x * radial + 2.0 * p1 * x * y + p2 * (square + 2.0 * x * x),
            y * radial + p1 * (square + 2.0 * y * y) + 2.0 * p2 * x * y,
        ],
        axis=-1,
    )


def _jacobian(plane: Array, distortion: tuple[float, ...]) -> tuple[Array, Array, Array]:
    """The entries xx, xy = yx and yy of the Jacobian of `distorted`, which is symmetric."""
    k1, k2, p1, p2, k3 = coefficients(distortion)
    x, y = plane[..., 0], plane[..., 1]
    square = x * x + y * y
    radial = 1.0 + square * (k1 + square * (k2 + square * k3))
    growth = 2.0 * (k1 + square * (2.0 * k2 + 3.0 * square * k3))
    return (
        radial + x * x * growth + 2.0 * p1 * y + 6.0 * p2 * x,
        x * y * growth + 2.0 * p1 * x + 2.0 * p2 * y,
        radial + y * y * growth + 6.0 * p1 * y + 2.0 * p2 * x,
    )


def unfolded(plane: Array, distortion: tuple[float, ...]) -> Mask:
    """Whether (...,) the distortion is injective from the optical axis to points (..., 2)."""
    within = np.abs(plane).max(axis=-1) <= LARGEST
    k1, k2, p1, p2, k3 = coefficients(distortion)
    if p1 == p2 == 0.0:
        # The distorted radius r (1 + k1 r^2 + ...) increases up to the first root of its derivative.
        roots = np.roots([7.0 * k3, 5.0 * k2, 3.0 * k1, 1.0])
        turns = roots[(np.abs(roots.imag) < 1e-9 * np.abs(roots)) & (roots.real > 0.0)].real
        return np.asarray(within & ((plane**2).sum(axis=-1) < min(turns, default=np.inf)))
    # With tangential terms the Jacobian must stay positive definite along the lines to the points.
    for share in np.arange(1, ALONG + 1) / ALONG:
        xx, xy, yy = _jacobian(np.clip(plane, -LARGEST, LARGEST) * share, distortion)
        within = within & (xx * yy - xy * xy > 0.0) & (xx + yy > 0.0)
    return np.asarray(within)


def undistorted(seen: Array, distortion: tuple[float, ...]) -> tuple[Array, Mask]:
    """The points (..., 2) whose distorted positions are `seen` (..., 2); whether (...,) they are unique."""
    plane = seen.copy()
    for _ in range(MOST_STEPS):
        error = distorted(plane, distortion) - seen
        if float(np.abs(error).max(initial=0.0)) <= EXACT:
            break
        xx, xy, yy = _jacobian(plane, distortion)
        determinant = xx * yy - xy * xy
        determinant = np.where(np.abs(determinant) < 1e-9, 1e-9, determinant)
        step_x = (yy * error[..., 0] - xy * error[..., 1]) / determinant
        step_y = (xx * error[..., 1] - xy * error[..., 0]) / determinant
        plane = np.clip(plane - np.stack([step_x, step_y], axis=-1), -LARGEST, LARGEST)
    converged = np.abs(distorted(plane, distortion) - seen).max(axis=-1) <= 1e3 * EXACT
    return plane, converged & unfolded(plane, distortion)


@lru_cache(maxsize=16)
def undistorted_rays(optics: Optics) -> Array:
    """Directions (height * width, 3) of the pixels' rays, z = 1, cached.

    Raises:
        InputError: the number of coefficients is wrong, or they fold the image over.
    """
    width, height, (fx, fy, cx, cy), distortion = optics
    plane, sound = undistorted((_pixels(width, height) - [cx, cy]) / [fx, fy], distortion)
    if not sound.all():
        first = int(np.argmin(sound))
        raise InputError(
            f"the distortion {[float(f'{k:.4g}') for k in distortion]} folds the image over: "
            f"{int((~sound).sum())} of {sound.size} pixels (column {first % width}, row {first // width} is "
            "the first) have no unique ray; check the order k1 k2 p1 p2 k3, or calibrate with views that "
            "reach the corners."
        )
    rays = np.concatenate([plane, np.ones((len(plane), 1))], axis=1)
    rays.setflags(write=False)
    return rays


@lru_cache(maxsize=16)
def pinhole_shifts(optics: Optics) -> Array:
    """Displacements (height, width, 2), u then v, from pixels to their rays' projections without distortion.

    In pixels; a renderer bounds a part's outline by them.
    """
    width, height, (fx, fy, cx, cy), _ = optics
    rays = undistorted_rays(optics)
    shifts = (rays[:, :2] * [fx, fy] + [cx, cy] - _pixels(width, height)).reshape(height, width, 2)
    shifts.setflags(write=False)
    return shifts


def _pixels(width: int, height: int) -> Array:
    """The centres (height * width, 2) of an image's pixels, u then v."""
    return np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).reshape(-1, 2).astype(float)
