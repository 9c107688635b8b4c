"""From wrenches to contact locations: one code for what was measured and for what was simulated.

A single contact without torque of its own exerts a wrench (f, tau) whose line of action passes through the
contact: the points r with r x f = tau, that is f x tau / |f|^2 + s f. The contact is where that line enters
the peg along f, for the environment can only push (Bicchi, Salisbury and Brock 1993, "Contact sensing from
force measurements", section 3). Several contacts at once give one location, measured and simulated alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt
import torch
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from scipy.signal import butter, sosfilt
from torch import Tensor

from bcppl.arguments import number_within, whole_number
from bcppl.contact.sensing.load import ToolLoad
from bcppl.contact.sensing.surface import closed_mesh
from bcppl.contact.sensing.units import refuse_millimetres
from bcppl.contact.touch import Touch
from bcppl.errors import InputError
from bcppl.geometry.parts import Part

Array = npt.NDArray[np.float64]
Rows = npt.NDArray[np.int64] | npt.NDArray[np.bool_] | slice

_BATCH = 4096  # lines whose distances to all edges are held at once


@dataclass(frozen=True, eq=False)
class SensingState:
    """What is carried from one chunk of a wrench signal to the next, for N signals.

    Attributes:
        tare: (N, n, 6) the first samples, while they are collected and after.
        filter: (N, sections, 2, 6) the low-pass filter's memory.
    """

    tare: Array
    filter: Array

    def __getitem__(self, rows: Rows) -> SensingState:
        """The same for some of the signals."""
        return SensingState(self.tare[rows], self.filter[rows])

    def put(self, rows: Rows, other: SensingState) -> SensingState:
        """The same with some signals' rows replaced; both must have seen equally many samples."""
        tare, memory = self.tare.copy(), self.filter.copy()
        tare[rows], memory[rows] = other.tare, other.filter
        return SensingState(tare, memory)


@dataclass(frozen=True, eq=False)
class Sensing:
    """How contact locations are read from a wrench signal.

    Attributes:
        peg: the held peg; wrenches are in its frame, about its origin.
        rate: samples per second.
        tare: the number of first samples, free of contact, whose mean is the sensor's zero; no contact is
            reported during them.
        cutoff: Hz, of the causal second-order Butterworth low-pass; None for no filter.
        force: newtons from which on there is a contact. A line of action is off by the torque's noise over
            the force: at 3 N and 5 mN m by 1.7 mm before filtering.
        friction: the steepest friction that a contact may have. Where a line of action enters the peg so
            flatly that it would take more, it has passed beside the contact: the nearest edge is the contact.
        miss_tolerance: metres; where noise lets the line of action pass beside the peg by no more than this,
            the nearest point of the peg's convex hull is the contact; beyond it there is none.
        load: the tool's mass and centre, whose weight a measured wrench holds; None where the sensor or the
            arm has taken it off already. A simulated wrench never holds it.

    Raises:
        InputError: the peg's mesh is empty, open, not finite or in millimetres, or a setting is out of range.
    """

    peg: Part
    rate: float
    tare: int = 10
    cutoff: float | None = 20.0
    force: float = 3.0
    friction: float = 1.0
    miss_tolerance: float = 0.002
    load: ToolLoad | None = None

    def __post_init__(self) -> None:
        for name in ("rate", "force", "friction"):
            number_within(f"sensing has {name} = {{}}", getattr(self, name), above=0.0)
        number_within("sensing has miss_tolerance = {}", self.miss_tolerance, least=0.0)
        whole_number("sensing has tare = {}", self.tare, least=0)
        if self.cutoff is not None and not 0 < self.cutoff < 0.5 * self.rate:
            raise InputError(
                f"the low-pass cutoff is {self.cutoff} Hz at {self.rate} samples per second; "
                "give less than half the rate, or None."
            )
        closed_mesh(self.peg)

    @cached_property
    def sections(self) -> Array:
        """The low-pass filter as second-order sections (S, 6)."""
        if self.cutoff is None:
            return np.empty((0, 6))
        return np.asarray(butter(2, self.cutoff, fs=self.rate, output="sos"), dtype=np.float64)

    @cached_property
    def _scene(self) -> EmbreeScene:
        scene = EmbreeScene()
        TriangleMesh(scene, self.peg.vertices.astype(np.float32), self.peg.faces.astype(np.int32))
        return scene

    @cached_property
    def _planes(self) -> tuple[Array, Array]:
        """A point (F, 3) and the outward normal (F, 3) of each face."""
        corners = self.peg.vertices[self.peg.faces]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        return corners[:, 0], normal / np.linalg.norm(normal, axis=1, keepdims=True)

    @cached_property
    def _edges(self) -> tuple[Array, Array, Array]:
        """Start (E, 3) and extent (E, 3) of the convex hull's edges; outward normals (E, 3, 3) at each.

        The normals are those of the two faces that meet there, and the one halfway between.
        """
        hull = self.peg.mesh.convex_hull
        sharp = hull.face_adjacency_angles > 1e-3
        ends = np.asarray(hull.vertices)[hull.face_adjacency_edges[sharp]]
        normals = np.asarray(hull.face_normals)[hull.face_adjacency[sharp]]
        between = normals.sum(axis=1, keepdims=True)
        between /= np.linalg.norm(between, axis=-1, keepdims=True)
        return ends[:, 0], ends[:, 1] - ends[:, 0], np.concatenate([normals, between], axis=1)

    @property
    def _least_slope(self) -> float:
        """The cosine of the friction cone's half angle."""
        return float(1.0 / np.hypot(1.0, self.friction))

    @cached_property
    def _ball(self) -> tuple[Array, float]:
        """Centre (3,) and radius of a ball around the peg."""
        center = 0.5 * (self.peg.vertices.min(axis=0) + self.peg.vertices.max(axis=0))
        return center, float(np.linalg.norm(self.peg.vertices - center, axis=1).max())

    def start(self, signals: int) -> SensingState:
        """The state before the first sample of N signals."""
        return SensingState(np.empty((signals, 0, 6)), np.zeros((signals, len(self.sections), 2, 6)))

    def check_rate(self, times: Array, name: str) -> None:
        """Refuse times (T,) that are not `rate` per second.

        Raises:
            InputError: the mean rate is off by more than 2 %.
        """
        if len(times) < 2:
            return
        rate = (len(times) - 1) / (times[-1] - times[0])
        if not abs(rate / self.rate - 1.0) <= 0.02:
            raise InputError(
                f"{name} has {rate:.4g} samples per second, not {self.rate:.4g}; set Sensing's rate to that."
            )

    def clean(self, wrench: Array, state: SensingState) -> tuple[Array, SensingState]:
        """Tared and filtered wrenches (N, T, 6) of a chunk of raw ones, NaN while taring, and the new state.

        A signal in chunks comes out as the whole signal at once, to the bit.
        """
        if wrench.ndim != 3 or wrench.shape[2] != 6:
            raise InputError(f"wrenches have shape {wrench.shape}; give (signals, samples, 6).")
        taring = min(max(0, self.tare - state.tare.shape[1]), wrench.shape[1])
        tare = np.concatenate([state.tare, wrench[:, :taring]], axis=1) if taring else state.tare
        cleaned = np.full(wrench.shape, np.nan)
        memory = state.filter
        if wrench.shape[1] > taring:
            zero = tare.mean(axis=1, keepdims=True) if self.tare else np.zeros((len(wrench), 1, 6))
            signal = wrench[:, taring:] - zero
            if self.cutoff is not None:
                signal, memory = sosfilt(
                    self.sections, signal, axis=1, zi=np.ascontiguousarray(np.moveaxis(memory, 0, 1))
                )
                memory = np.ascontiguousarray(np.moveaxis(memory, 1, 0))
            cleaned[:, taring:] = signal
        return cleaned, SensingState(tare, memory)

    def contacts(self, wrench: Array, state: SensingState) -> tuple[Array, SensingState]:
        """Contact locations (N, T, 3) in the peg's frame, NaN where none, of a chunk of raw wrenches.

        Args:
            wrench: (N, T, 6) of the environment on the peg, in the peg's frame about its origin, not tared.
            state: from `start`, or of the chunk before.

        Returns:
            The locations, and the state for the next chunk. Chunks give what the whole gives, to the bit.

        Raises:
            InputError: the wrenches are not (N, T, 6).
        """
        cleaned, state = self.clean(wrench, state)
        return self._located(cleaned), state

    def _touching(self, cleaned: Array) -> npt.NDArray[np.bool_]:
        """Where (N, T) cleaned wrenches (N, T, 6) have the force of a contact."""
        with np.errstate(invalid="ignore"):
            return np.asarray(np.linalg.norm(cleaned[..., :3], axis=-1) >= self.force)

    def _located(self, cleaned: Array) -> Array:
        locations, touching = np.full((*cleaned.shape[:2], 3), np.nan), self._touching(cleaned)
        locations[touching] = self.locate(cleaned[touching])
        return locations

    def locate(self, wrench: Array) -> Array:
        """Where the lines of action of wrenches (M, 6) enter the peg: (M, 3) in its frame, NaN if not."""
        force, torque = wrench[:, :3], wrench[:, 3:]
        magnitude = np.linalg.norm(force, axis=1, keepdims=True)
        direction = force / magnitude
        point = np.cross(direction, torque / magnitude)
        center, radius = self._ball
        along = np.sum((center - point) * direction, axis=1, keepdims=True)
        point = point + along * direction
        locations = np.full((len(wrench), 3), np.nan)
        near = np.linalg.norm(point - center, axis=1) <= radius + self.miss_tolerance
        if not near.any():
            return locations
        point, direction = point[near], direction[near]
        origin = point - 1.1 * radius * direction
        face = np.asarray(self._scene.run(origin.astype(np.float32), direction.astype(np.float32)))
        found, hit = np.full((len(point), 3), np.nan), face >= 0
        # The ray tracer says which face; where exactly is computed in double precision.
        anchor, normal = self._planes[0][face[hit]], self._planes[1][face[hit]]
        slope = np.sum(direction[hit] * normal, axis=1)
        reach = np.sum((anchor - origin[hit]) * normal, axis=1) / slope
        found[hit] = origin[hit] + reach[:, None] * direction[hit]
        flat = np.zeros(len(point), dtype=bool)
        flat[hit] = -slope < self._least_slope
        missed = ~hit | flat
        found[missed] = self._beside(point[missed], direction[missed])
        locations[near] = found
        return locations

    def _beside(self, point: Array, direction: Array) -> Array:
        """The points (M, 3) of the convex hull's edges nearest to lines (M, 3), NaN beyond the tolerance.

        Only edges that the force pushes into the peg, within the friction cone of a normal there, count.
        """
        start, extent, normals = self._edges
        nearest = np.full((len(point), 3), np.nan)
        for first in range(0, len(point), _BATCH):
            p, d = point[first : first + _BATCH, None], direction[first : first + _BATCH, None]
            gap = start - p
            # In the plane across the line, the line is a point and an edge a shorter edge.
            gap = gap - np.sum(gap * d, axis=-1, keepdims=True) * d
            edge = extent - np.sum(extent * d, axis=-1, keepdims=True) * d
            length = np.sum(edge * edge, axis=-1)
            share = np.clip(-np.sum(gap * edge, axis=-1) / np.maximum(length, 1e-30), 0.0, 1.0)
            distance = np.linalg.norm(gap + share[..., None] * edge, axis=-1)
            pushed = np.einsum("ekj,mj->mek", -normals, d[:, 0]).max(axis=-1)
            distance[pushed < self._least_slope] = np.inf
            best = distance.argmin(axis=1)
            rows = np.arange(len(best))
            found = start[best] + share[rows, best][:, None] * extent[best]
            found[distance[rows, best] > self.miss_tolerance] = np.nan
            nearest[first : first + _BATCH] = found
        return nearest

    def measure(self, touches: Sequence[Touch]) -> list[tuple[Tensor, Tensor]]:
        """Contact locations (T, 3) in the peg's frame, its poses (T, 7), of consecutive windows of one probe.

        The first window must be the probe's first, for it holds the samples that the sensor's zero is taken
        from; the filter is carried from window to window. The tool's weight is taken off first.

        Raises:
            InputError: a window's samples are not `rate` per second within 2 %, its arrays do not fit, a
                wrench is not finite (the filter would carry it into all that come after), or its torques are
                in N mm.
        """
        state, measured = self.start(1), []
        for k, touch in enumerate(touches):
            wrench = self._weightless(touch, f"window {k}")
            _refuse_missing(wrench, f"window {k}")
            cleaned, state = self.clean(wrench[None], state)
            refuse_millimetres(
                cleaned[self._touching(cleaned)], float(np.linalg.norm(self._ball[0])) + self._ball[1]
            )
            pose = torch.from_numpy(np.array(touch.world_from_peg, dtype=np.float64))
            measured.append((torch.from_numpy(self._located(cleaned)[0]), pose))
        return measured

    def tared(self, touches: Sequence[Touch]) -> list[Tensor]:
        """The wrench (T, 6) of the same windows, free of the tool's weight and tared but not filtered.

        NaN while taring: what `bcppl.distributions.contact.Wrench` compares with the simulated one, and
        `bcppl.contact.sensing.onset.OnsetDetector` passes over. A later wrench that is not finite stays
        so, for nothing carries it on.

        Raises:
            InputError: a window's samples are not `rate` per second within 2 %, its arrays do not fit, or a
                wrench is not finite while taring.
        """
        plain = replace(self, cutoff=None)
        state, measured = plain.start(1), []
        for k, touch in enumerate(touches):
            wrench = self._weightless(touch, f"window {k}")
            _refuse_missing(wrench[: self.tare - state.tare.shape[1]], f"window {k}")
            cleaned, state = plain.clean(wrench[None], state)
            measured.append(torch.from_numpy(cleaned[0]))
        return measured

    def _weightless(self, touch: Touch, name: str) -> Array:
        """A window's wrench (T, 6), checked, without the tool's weight."""
        count = len(touch.times)
        if touch.wrench.shape != (count, 6) or touch.world_from_peg.shape != (count, 7):
            raise InputError(
                f"{name} has {count} times, wrenches {touch.wrench.shape} and peg poses "
                f"{touch.world_from_peg.shape}; give (T,), (T, 6) and (T, 7)."
            )
        if not np.isfinite(touch.world_from_peg).all():
            row = int((~np.isfinite(touch.world_from_peg).all(axis=1)).argmax())
            raise InputError(
                f"{name} has a peg pose that is not finite at row {row}; fill it by interpolation, "
                "or cut the recording there."
            )
        self.check_rate(touch.times, name)
        wrench = touch.wrench.astype(np.float64)
        return wrench if self.load is None else wrench - self.load.weight(touch.world_from_peg)


def _refuse_missing(wrench: Array, name: str) -> None:
    """Refuse measured wrenches (T, 6) of which one is not finite."""
    missing = ~np.isfinite(wrench).all(axis=1)
    if missing.any():
        raise InputError(
            f"{name} has a wrench that is not finite at row {int(missing.argmax())}; fill it by "
            "interpolation, or cut the recording there."
        )
