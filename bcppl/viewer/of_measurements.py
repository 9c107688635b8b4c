"""What a page shows of one measurement beside poses of the part; another kind registers its own.

@shown.register
def _(action: Beam, index, recording, poses, bodies):
return {"times": ..., "wrench": ...}
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import singledispatch
from typing import Any

import numpy as np
import torch
from torch import Tensor

from bcppl import poses as se3
from bcppl.arrays import Array, Indices, Mask
from bcppl.cached import cached_property
from bcppl.errors import InputError
from bcppl.figures.touches import contact_felt, tared_force
from bcppl.geometry.camera import Camera
from bcppl.geometry.distance import SignedDistance
from bcppl.geometry.gap import PegGap
from bcppl.sensors import ProbeWindow, Push, Recording, View, sensor_of

ROWS, GAP_ROWS = 200, 32  # of a touch: that are drawn, and at which the gap of every particle is given
PIXELS = 20_000  # of an image; a larger one is drawn by every second, third ... row and column
GAP_UNIT = 4e-6  # m of a gap that is kept in 16 bits: up to 131 mm
MISSING = 0  # level of a pixel without a depth
LEVELS = 65_535


class Bodies:
    """The part and the peg of a recording, with the distances between them, each prepared on first use."""

    def __init__(self, recording: Recording) -> None:
        self.recording = recording

    @cached_property
    def tip(self) -> Array:
        """The peg's tip (3,), the middle of its lowest vertices, in its frame; its origin without a peg."""
        peg = self.recording.peg
        if peg is None:
            return np.zeros(3)
        return np.asarray(peg.vertices[peg.vertices[:, 2] < peg.vertices[:, 2].min() + 1e-6].mean(axis=0))

    @cached_property
    def _peg_gap(self) -> PegGap | None:
        peg = self.recording.peg
        try:
            return None if peg is None else PegGap(self.recording.part, peg)
        except InputError:  # an open mesh has no inside: it is drawn without gaps
            return None

    @cached_property
    def _distance(self) -> SignedDistance | None:
        try:
            return SignedDistance(self.recording.part)
        except InputError:
            return None

    def peg_gaps(self, poses: Tensor, world_from_peg: Array) -> tuple[Tensor, Tensor] | None:
        """Gaps (N, T) m and nearest points (N, T, 3) of the part, in its frame; None for an open mesh."""
        if self._peg_gap is None:
            return None
        gap = self._peg_gap(poses, torch.from_numpy(world_from_peg))
        return gap.distance, gap.witness

    def tip_gaps(self, poses: Tensor, world_from_tip: Array) -> tuple[Tensor, Tensor] | None:
        """The same of a point finger."""
        if self._distance is None:
            return None
        tips = torch.from_numpy(world_from_tip[:, :3]).expand(len(poses), -1, -1)
        near = self._distance(se3.transform(se3.inverse(poses), tips))
        return near.distance, near.closest


@singledispatch
def shown(
    action: object, index: int, recording: Recording, poses: Tensor, bodies: Bodies
) -> Mapping[str, Any]:
    """What the page shows of one measurement, by name; nothing of a kind that has registered nothing.

    Args:
        action: of the measurement, whose type decides.
        index: of the measurement in the recording.
        recording: with all measurements.
        poses: (N, 7) `world_from_part`, for which a gap is asked.
        bodies: of the recording.

    Returns:
        Of an image `camera` (optics and pose), `depth` (H, W) levels of 16 bits, 0 where missing, and the
        metres `low`, `high` of the levels 1 and 65535. Of a touch `times` (R,) s, `force` (R, 3) N and
        `torque` (R, 3) N m, tared or not as `axes` says, `felt` (R,), `pose` (R, 7) and `tip` (R, 3) of the
        held body, `command` (C, 3) of its tip, `gap_rows` (G,) of the R, `gap` (N, G) in `GAP_UNIT`,
        `witness` (N, 3) of the part, in its frame, at row `firmest`.
    """
    return {}


@shown.register
def _(action: View, index: int, recording: Recording, poses: Tensor, bodies: Bodies) -> Mapping[str, Any]:
    camera = action.camera
    depth = rectified(camera, np.asarray(recording.measurements[index].observation.depth, dtype=np.float64))
    step = max(1, int(np.ceil(np.sqrt(depth.size / PIXELS))))
    depth = depth[::step, ::step]
    known = np.isfinite(depth) & (depth > 0.0) & (depth >= camera.near) & (depth <= camera.far)
    low, high = (float(depth[known].min()), float(depth[known].max())) if known.any() else (0.0, 1.0)
    share = np.where(known, (depth - low) / max(high - low, 1e-9), 0.0)
    levels = np.where(known, 1.0 + np.rint(share * (LEVELS - 1)), MISSING).astype(np.uint16)
    optics = {name: float(getattr(camera, name)) / step for name in ("fx", "fy", "cx", "cy")}
    pose = camera.stated_pose().numpy().astype(np.float32)
    size = {"width": depth.shape[1], "height": depth.shape[0], "far": min(float(camera.far), 1e3)}
    seen = {"name": camera.name, "pose": pose, **optics, **size}
    return {"camera": seen, "depth": levels, "low": low, "high": high, "step": step}


def rectified(camera: Camera, depth: Array) -> Array:
    """A depth image (H, W) as the camera would have taken it without distortion; NaN where it saw nothing."""
    if not camera.is_distorted:
        return depth
    v, u = np.mgrid[: camera.height, : camera.width]
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)
    at = camera.project(rays)
    size = np.array([camera.width, camera.height])
    inside: Mask = np.asarray(((at >= -0.5) & (at < size - 0.5)).all(axis=-1))
    column, row = np.rint(np.where(inside[..., None], at, 0.0)).astype(int).transpose(2, 0, 1)
    return np.where(inside, depth[row, column], np.nan)


@shown.register
def _(
    action: ProbeWindow, index: int, recording: Recording, poses: Tensor, bodies: Bodies
) -> Mapping[str, Any]:
    kind = sensor_of(action).kind
    windows = [m for m in recording.measurements[: index + 1] if sensor_of(m.action).kind == kind]
    windows = [m for m in windows if m.action.probe.name == action.probe.name]  # the first holds the zero
    touch = recording.measurements[index].observation
    force = tared_force(windows)[1][-len(touch.times) :]
    rows, gap_rows, firmest = _rows(force)
    pose = np.asarray(touch.world_from_peg, dtype=np.float64)
    command = _tips(action.probe.command, bodies)
    return {
        **_touch("peg", touch, force, rows),
        "of": action.probe.name,
        "axes": "the peg's axes",
        "pose": pose[rows].astype(np.float32),
        "tip": _tips(pose[rows], bodies),
        "command": command[:: max(1, len(command) // ROWS)],
        **_gaps(bodies.peg_gaps(poses, pose[rows][gap_rows]), gap_rows, firmest),
    }


@shown.register
def _(action: Push, index: int, recording: Recording, poses: Tensor, bodies: Bodies) -> Mapping[str, Any]:
    touch = recording.measurements[index].observation
    force = tared_force([recording.measurements[index]])[1]
    rows, gap_rows, firmest = _rows(force)
    nearest = np.abs(action.times[None] - touch.times[rows][:, None]).argmin(axis=1)
    pose = np.asarray(action.world_from_tip, dtype=np.float64)[nearest]
    return {
        **_touch("finger", touch, force, rows),
        "of": f"push {index + 1}",
        "axes": "the world's axes",
        "pose": pose.astype(np.float32),
        "tip": pose[:, :3].astype(np.float32),
        **_gaps(bodies.tip_gaps(poses, pose[gap_rows]), gap_rows, firmest),
    }


def _rows(force: Array) -> tuple[Indices, Indices, int]:
    """Rows of a touch that are drawn; those of them that have gaps; which of these is felt most."""
    size = np.nan_to_num(np.linalg.norm(force, axis=1))
    most = int(size.argmax())
    rows = np.union1d(np.linspace(0, len(force) - 1, min(ROWS, len(force))).astype(int), [most])
    drawn = int(np.searchsorted(rows, most))
    gap_rows = np.union1d(np.linspace(0, len(rows) - 1, min(GAP_ROWS, len(rows))).astype(int), [drawn])
    return rows, gap_rows, int(np.searchsorted(gap_rows, drawn))


def _touch(body: str, touch: Any, force: Array, rows: Indices) -> dict[str, Any]:
    felt: Mask = contact_felt(force)
    return {
        "body": body,
        "times": np.asarray(touch.times, dtype=np.float64)[rows],
        "force": force[rows].astype(np.float32),
        "torque": np.asarray(touch.wrench[rows, 3:], dtype=np.float32),
        "felt": felt[rows].astype(np.uint8),
    }


def _tips(pose: Array, bodies: Bodies) -> Array:
    at = se3.transform(torch.from_numpy(np.asarray(pose, np.float64)), torch.from_numpy(bodies.tip)[None])
    return np.asarray(at[:, 0].numpy(), dtype=np.float32)


def _gaps(gaps: tuple[Tensor, Tensor] | None, rows: Indices, firmest: int) -> dict[str, Any]:
    if gaps is None:
        return {}
    distance, witness = (each.numpy() for each in gaps)
    levels = np.clip(np.rint(distance / GAP_UNIT), -32_767, 32_767).astype(np.int16)
    return {
        "gap": levels,
        "gap_rows": rows.astype(np.uint16),
        "firmest": firmest,
        "witness": witness[:, firmest].astype(np.float32),
    }
