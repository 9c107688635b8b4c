"""Simulated errors of a depth sensor, for worlds and not for inference.

A pixel at a depth discontinuity may read a depth between the two sides (a flying pixel), or nothing. Pixels
drop out at grazing incidence. The others have noise that grows with the square of the range, as in stereo and
structured light, are quantised in depth or in disparity, and are missing beyond the sensor's range.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt

from bcppl.arguments import number_within
from bcppl.arrays import Array, Mask
from bcppl.errors import InputError
from bcppl.geometry.camera import Camera


@dataclass(frozen=True)
class DepthNoise:
    """Noise model of a depth sensor. The defaults are those of a bench: 2 mm, quantised to millimetres.

    Attributes:
        scale: of the noise at any range, m: Laplace's b, or the standard deviation where it is gaussian.
        growth: the scale grows by this times the squared range beyond `growth_from`, 1/m.
        growth_from: m.
        gaussian: whether the noise is normal rather than Laplace's.
        step: quantum of the depth, m; 0 for none.
        inverse_step: quantum of the inverse depth, 1/m; 0 for none. For stereo it is the quantum of the
            disparity (pixels) over focal length (pixels) times baseline (m).
        dropout: probability that a pixel is missing, anywhere.
        grazing_from: angle of incidence at which pixels begin to be missing, rad.
        grazing_to: angle of incidence from which on all are missing, rad.
        edge: a discontinuity lies between two neighbours whose depths differ by more than this, and that do
            not lie on one plane, m.
        flying: probability that a pixel at a discontinuity reads a depth between the two sides, uniformly.
        edge_dropout: probability that a pixel at a discontinuity is missing.
    """

    scale: float = 0.002
    growth: float = 0.0
    growth_from: float = 0.0
    gaussian: bool = False
    step: float = 0.001
    inverse_step: float = 0.0
    dropout: float = 0.05
    grazing_from: float = math.radians(75.0)
    grazing_to: float = math.radians(88.0)
    edge: float = 0.01
    flying: float = 0.5
    edge_dropout: float = 0.1

    def __post_init__(self) -> None:
        for name in (f.name for f in fields(self) if f.name != "gaussian"):
            most = 1.0 if name in ("dropout", "flying", "edge_dropout") else math.inf
            number_within(f"the depth noise has {name} {{}}", getattr(self, name), least=0.0, most=most)
        grazing = "the depth noise loses pixels at angles up to grazing_to {} radians"
        number_within(grazing, self.grazing_to, above=self.grazing_from, most=math.pi)

    def sample(self, camera: Camera, depth: npt.ArrayLike, seed: int | np.random.Generator) -> Array:
        """A noisy depth image.

        Args:
            camera: its rays give the angles of incidence, its range the depths that are not missing.
            depth: (..., H, W) true depth along the optical axis, m; infinite or NaN where there is none.
            seed: of the random numbers.

        Returns:
            (..., H, W) m, NaN where missing.

        Raises:
            InputError: the image is not of the camera's shape.
        """
        true = np.array(depth, dtype=np.float64)
        if true.shape[-2:] != (camera.height, camera.width) or true.ndim < 2:
            raise InputError(
                f"a depth image of shape {true.shape} is not camera {camera.name!r}'s; transpose or crop it."
            )
        true[~np.isfinite(true) | (true <= 0.0)] = np.nan
        generator = np.random.default_rng(seed)
        across, beside = _discontinuities(true, self.edge)
        lost = generator.random(true.shape) < self.dropout
        lost |= beside & (generator.random(true.shape) < self.edge_dropout)
        grazing = (_incidence(camera, true) - self.grazing_from) / (self.grazing_to - self.grazing_from)
        lost |= generator.random(true.shape) < grazing
        flies = np.isfinite(across) & (generator.random(true.shape) < self.flying)
        between = true + generator.random(true.shape) * (np.where(flies, across, true) - true)
        noisy = self._noisy(between, generator)
        noisy[lost | ~(noisy >= camera.near) | ~(noisy <= camera.far)] = np.nan
        return noisy

    def _noisy(self, depth: Array, generator: np.random.Generator) -> Array:
        size = self.scale + self.growth * np.square(np.maximum(depth - self.growth_from, 0.0))
        draw = generator.normal if self.gaussian else generator.laplace
        noisy = depth + size * draw(size=depth.shape)
        if self.inverse_step > 0.0:
            steps = np.round(1.0 / (self.inverse_step * np.maximum(noisy, 1e-9)))
            # A disparity that rounds to zero has no depth.
            noisy = np.where(steps > 0.0, 1.0 / (self.inverse_step * np.maximum(steps, 1.0)), np.nan)
        if self.step > 0.0:
            noisy = np.round(noisy / self.step) * self.step
        return noisy


# Intel's D435 at 848 pixels: a focal length of 424 pixels (90 degrees), a baseline of 50 mm, a standard
# deviation of the disparity of 0.08 pixels and a quantum of 1/32. Grunnet-Jepsen, Sweetser and Woodfill:
# Tuning depth cameras for best performance; Subpixel linearity improvement for Intel RealSense depth camera
# D400 series.
REALSENSE_D435 = DepthNoise(
    scale=0.0,
    growth=0.08 / (424.0 * 0.05),
    gaussian=True,
    step=0.001,
    inverse_step=1.0 / 32.0 / (424.0 * 0.05),
    dropout=0.02,
)

# Axial noise of the first Kinect up to 60 degrees, 1.2 mm + 1.9 mm (z/m - 0.4)^2: Nguyen, Izadi and Lovell,
# Modeling Kinect sensor noise for improved 3D reconstruction and tracking, 3DIMPVT 2012, section 2. Its
# disparity of 580 pixels x 75 mm is quantised to eighths: Khoshelham and Elberink, Sensors 12, 2012.
KINECT = DepthNoise(
    scale=0.0012,
    growth=0.0019,
    growth_from=0.4,
    gaussian=True,
    step=0.001,
    inverse_step=1.0 / 8.0 / (580.0 * 0.075),
    dropout=0.01,
    grazing_from=math.radians(60.0),
    grazing_to=math.radians(85.0),
)


def _discontinuities(depth: Array, edge: float) -> tuple[Array, Mask]:
    """The depth (..., H, W) across the widest discontinuity at each pixel, NaN without one; and its mask.

    Two neighbours at a discontinuity differ by more than `edge`, and by more than twice as much as each
    differs from its neighbour on its own side, so that a slanted plane has none. A pixel beside one without
    depth is at a discontinuity too, with NaN across.
    """
    across = np.full(depth.shape, np.nan)
    widest = np.zeros(depth.shape)
    beside = np.zeros(depth.shape, dtype=bool)
    for axis in (-1, -2):
        along, far, size, rim = (np.moveaxis(x, axis, -1) for x in (depth, across, widest, beside))
        # Four in a row: o, a | b, p, the discontinuity between a and b; at a border o is a, or p is b.
        padded = np.concatenate([along[..., :1], along, along[..., -1:]], axis=-1)
        o, a, b, p = padded[..., :-3], padded[..., 1:-2], padded[..., 2:-1], padded[..., 3:]
        gap = np.abs(b - a)
        slant = np.fmax(np.nan_to_num(np.abs(a - o)), np.nan_to_num(np.abs(p - b)))
        step = (gap > edge) & (gap > 2.0 * slant)
        marked = step | (np.isnan(a) ^ np.isnan(b))
        for here, there, place in ((a, b, np.s_[..., :-1]), (b, a, np.s_[..., 1:])):
            wider = step & (gap > size[place])
            far[place] = np.where(wider, there, far[place])
            size[place] = np.where(wider, gap, size[place])
            rim[place] |= marked & np.isfinite(here)
    return across, beside


def _incidence(camera: Camera, depth: Array) -> Array:
    """Angles of incidence (..., H, W), rad; 0 where a pixel has too few neighbours with a depth.

    The tangents lead to the nearer in depth of the two neighbours along each axis, so not across an edge.
    """
    rays = camera.rays().reshape(camera.height, camera.width, 3)
    points = depth[..., None] * rays
    tangents = [_tangent(points, depth, axis) for axis in (-1, -2)]
    normal = np.cross(tangents[0], tangents[1])
    length = np.linalg.norm(normal, axis=-1) * np.linalg.norm(rays, axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        cosine = np.abs((normal * rays).sum(axis=-1)) / length
    return np.where(np.isfinite(cosine), np.arccos(np.clip(np.nan_to_num(cosine), 0.0, 1.0)), 0.0)


def _tangent(points: Array, depth: Array, axis: int) -> Array:
    """Tangents (..., H, W, 3) along an image axis, on the side on which the depth changes less."""
    points, depth = np.moveaxis(points, axis - 1, -2), np.moveaxis(depth, axis, -1)
    tangent, change = np.full(points.shape, np.nan), np.full(depth.shape, np.inf)
    forward, size = np.diff(points, axis=-2), np.abs(np.diff(depth, axis=-1))
    for side in (slice(-1), slice(1, None)):
        better = size < change[..., side]
        tangent[..., side, :] = np.where(better[..., None], forward, tangent[..., side, :])
        change[..., side] = np.where(better, size, change[..., side])
    return np.moveaxis(tangent, -2, axis - 1)
