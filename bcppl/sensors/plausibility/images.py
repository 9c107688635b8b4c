"""How well depth images show the part within its prior, as they are stated and under repairs."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch

from bcppl import poses
from bcppl.arrays import Array, Indices
from bcppl.geometry.camera import Camera
from bcppl.geometry.parts import Guess, Part
from bcppl.rendering.ray_casting import RayCaster
from bcppl.sensors.plausibility.search import Found, best_pose

WIDE = 160  # pixels: a larger image is read at every so manyth pixel
SHARP = 0.005  # m: scale of a depth's error, of the camera's calibration too
OUTLIERS = 0.1  # of the pixels on the part show something else
SPAN = 1.0  # m, over which a depth that is not the part's may lie
FEWEST = 12  # pixels on the part, below which an image decides nothing
FULL = math.log(OUTLIERS + (1.0 - OUTLIERS) * SPAN / (2.0 * SHARP))  # of a pixel that fits exactly


class Seen(NamedTuple):
    """A camera and its depth image (H, W), metres, thinned to few pixels."""

    camera: Camera
    depth: Array


class Fit(NamedTuple):
    """A pose of the part, and how well images show the part there.

    Attributes:
        found: the pose.
        share: of the drawn pixels' largest score that they reach: 1 for a perfect image, 0 for one that may
            as well show something else.
        score: nats, of all pixels.
    """

    found: Found
    share: float
    score: float


def thinned(camera: Camera, depth: Array) -> Seen:
    """The image at every nth pixel, so that about `WIDE` are left of a row, with depths of 0 missing."""
    step = max(1, round(camera.width / WIDE))
    values = np.array(depth[::step, ::step], dtype=float)
    values[values == 0.0] = np.nan
    height, width = values.shape
    scaled = {name: getattr(camera, name) / step for name in ("fx", "fy", "cx", "cy")}
    return Seen(replace(camera, width=width, height=height, **scaled), values)


class Images:
    """Scores the part's pose by depth images: nats by which they are more probable with the part there."""

    def __init__(self, part: Part, guess: Guess) -> None:
        self.guess = guess
        self._caster = RayCaster(part)

    def scores(self, seen: Seen, pose: Array) -> tuple[Array, Indices]:
        """Scores (N,) of poses (N, 7), and the numbers (N,) of pixels that they are the sum of."""
        hits = self._caster.hits(seen.camera, pose)
        read = seen.depth.reshape(-1)[hits.pixel]
        # Many cameras give a number beyond their range for what they do not see.
        read = np.where((read >= seen.camera.near) & (read <= seen.camera.far), read, np.nan)
        off = np.abs(read - hits.depth)
        known = np.isfinite(off)
        each = np.log(OUTLIERS + (1.0 - OUTLIERS) * SPAN / (2.0 * SHARP) * np.exp(-off[known] / SHARP))
        counts = np.bincount(hits.particle[known], minlength=len(pose)).astype(np.int64)
        totals = np.bincount(hits.particle[known], each, len(pose))
        return np.asarray(totals, dtype=float), counts

    def shares(self, several: Sequence[Seen], found: Found) -> list[float]:
        """The share of each image at a pose: 0 where it does not show the part."""
        each = [self.scores(seen, found.pose[None]) for seen in several]
        return [float(score[0]) / (FULL * max(int(count[0]), FEWEST)) for score, count in each]

    def fit(self, several: Sequence[Seen], start: Found | None = None, thorough: bool = False) -> Fit:
        """The pose within the prior that all images show best: from a start with few draws."""

        def score(pose: Array) -> Array:
            return np.sum([self.scores(seen, pose)[0] for seen in several], axis=0)

        draws, rounds = (96, 8) if thorough else (48, 4) if start is None else (24, 3)
        found = best_pose(score, self.guess, start, spread=0.4, rounds=rounds, draws=draws)
        totals = [self.scores(seen, found.pose[None]) for seen in several]
        count = sum(int(number[0]) for _, number in totals)
        value = sum(float(total[0]) for total, _ in totals)
        return Fit(found, value / (FULL * max(count, FEWEST)), value)


class Repair(NamedTuple):
    """What a view would be without a mistake, and the mistake and its cure in words.

    A focal length by a `factor` above 1 enlarges the drawn part, which may explain more of an image that
    shows it well as stated.
    """

    name: str
    made: Callable[[Seen], Seen | None]
    words: str
    factor: float = 1.0


def with_pose(changed: Callable[[Array, Camera], Array | None]) -> Callable[[Seen], Seen | None]:
    """A repair of a camera's pose."""

    def made(seen: Seen) -> Seen | None:
        pose = changed(np.asarray(seen.camera.world_from_camera, dtype=float), seen.camera)
        return None if pose is None else Seen(replace(seen.camera, world_from_camera=pose), seen.depth)

    return made


def reordered(pose: Array) -> Array:
    """Poses (..., 7) with the quaternion's last number first, as of one that was written x y z w."""
    return np.concatenate([pose[..., :3], pose[..., 6:], pose[..., 3:6]], axis=-1)


def _scaled(factor: float) -> Callable[[Seen], Seen | None]:
    return lambda seen: Seen(seen.camera, factor * seen.depth)


def _read(order: tuple[slice, slice]) -> Callable[[Seen], Seen | None]:
    """A repair of the order of pixels."""
    return lambda seen: Seen(seen.camera, seen.depth[order])


def _focal(factor: float) -> Callable[[Seen], Seen | None]:
    def made(seen: Seen) -> Seen | None:
        camera = seen.camera
        return Seen(replace(camera, fx=factor * camera.fx, fy=factor * camera.fy), seen.depth)

    return made


def _composed(first: Array, second: Array) -> Array:
    return np.asarray(poses.compose(torch.from_numpy(first), torch.from_numpy(second)).numpy())


def _inverse(pose: Array) -> Array:
    return np.asarray(poses.inverse(torch.from_numpy(pose)).numpy())


def _hand_eye(pose: Array, camera: Camera) -> Array | None:
    """The camera's pose if its hand-eye calibration was inverted before it was composed with the wrist's."""
    if camera.wrist_from_camera is None:
        return None
    back = _inverse(np.asarray(camera.wrist_from_camera, dtype=float))
    return _composed(_composed(pose, back), back)


HALF_TURN = np.array([0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0])


def repairs() -> Iterator[Repair]:
    """What may be wrong with views, one each."""
    yield Repair("millimetres", _scaled(0.001), "the depth is in millimetres: scale it by 0.001 to metres")
    yield Repair(
        "thousandths",
        _scaled(1000.0),
        "the depth, a thousandth of what it should be, was scaled to metres twice: scale it once",
    )
    yield Repair(
        "quaternion order",
        with_pose(lambda pose, _: reordered(pose)),
        "the quaternion in world_from_camera is written x y z w: put its last number first",
    )
    yield Repair(
        "OpenGL",
        with_pose(lambda pose, _: _composed(pose, HALF_TURN)),
        "world_from_camera is of an OpenGL camera, z backward: turn it by half a turn about its x axis",
    )
    yield Repair(
        "inverse",
        with_pose(lambda pose, _: _inverse(pose)),
        "world_from_camera is inverted, camera_from_world: give the inverse",
    )
    yield Repair(
        "hand-eye",
        with_pose(_hand_eye),
        "the hand-eye calibration is inverted, camera_from_wrist: compose the wrist's pose with its inverse",
    )
    yield Repair("mirrored", _read(np.s_[:, ::-1]), "its rows are mirrored: read them from right to left")
    yield Repair("upside down", _read(np.s_[::-1, ::-1]), "the image is upside down: turn it by half a turn")
    for factor in (0.5, 0.67, 0.8, 1.25, 1.5, 2.0):
        yield Repair(
            f"focal length {factor:g}",
            _focal(factor),
            f"the focal length is about {factor:g} times the stated one: give fx and fy of this image's size",
            factor=factor,
        )
