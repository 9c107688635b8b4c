"""Contact locations from wrenches, by the same code for measured and simulated ones.

A single contact that exerts no moment of its own exerts a wrench (f, tau) whose line of action passes through
it: the points r with r x f = tau, that is f x tau / |f|^2 + s f. The contact is where that line enters the
peg along f, because the environment can only push (Bicchi, Salisbury and Brock 1993, "Contact sensing from
force measurements", section 3). Several contacts at once yield one location, measured and simulated alike.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.signal import butter, sosfilt
from torch import Tensor

from bcppl.arguments import number_within, whole_number
from bcppl.arrays import Array, ArrayRecord, Mask
from bcppl.cached import cached_property
from bcppl.compiled import compiled
from bcppl.contact.sensing.load import ToolLoad, refuse_millimetres
from bcppl.contact.sensing.surface import PegSurface
from bcppl.contact.touch import Touch
from bcppl.errors import InputError
from bcppl.geometry.gap.sharp_edges import dot
from bcppl.geometry.parts import Part


@dataclass(frozen=True, eq=False)
class SensingState(ArrayRecord):
    """The state between two chunks of N wrench signals.

    Attributes:
        tare: (N, n, 6) the first samples, at most as many as are needed.
        filter: (N, sections, 2, 6) the low-pass filter's state.
    """

    tare: Array
    filter: Array


@dataclass(frozen=True, eq=False)
class ContactSensing:
    """Contact locations from a wrench signal.

    Attributes:
        peg: the held peg; wrenches are in its frame, about its origin.
        rate: samples per second.
        tare: the number of first samples, free of contact, whose mean is the sensor's zero; no contact is
            reported during them.
        cutoff: Hz, of the causal second-order Butterworth low-pass; None for no filter.
        threshold: force of a contact, N. The error of a line of action is the torque's noise over the force:
            at 3 N and 5 mN m it is 1.7 mm before filtering.
        friction: upper bound of the friction coefficient. Where a line of action enters the peg outside of
            that friction cone, noise has moved it past the contact, which is then the nearest edge.
        miss_tolerance: metres; where noise moves the line of action past the peg by no more than this, the
            contact is the nearest point of the convex hull's edges; beyond it there is none.
        load: the tool's mass and centre, for gravity compensation of measured wrenches; None where sensor or
            arm compensate it. Simulated wrenches contain no weight.

    Raises:
        InputError: the peg's mesh is empty, open, not finite or in millimetres, or a setting is out of range.
    """

    peg: Part
    rate: float
    tare: int = 10
    cutoff: float | None = 20.0
    threshold: float = 3.0
    friction: float = 1.0
    miss_tolerance: float = 0.002
    load: ToolLoad | None = None

    def __post_init__(self) -> None:
        for name in ("rate", "threshold", "friction"):
            number_within(f"sensing has {name} = {{}}", getattr(self, name), above=0.0)
        number_within("sensing has miss_tolerance = {}", self.miss_tolerance, least=0.0)
        whole_number("sensing has tare = {}", self.tare, least=0)
        if self.cutoff is not None and not 0 < self.cutoff < 0.5 * self.rate:
            raise InputError(
                f"the cutoff is {self.cutoff} Hz; give less than half the rate of {self.rate} Hz, or None."
            )
        _ = self._surface

    @cached_property
    def _surface(self) -> PegSurface:
        return PegSurface(self.peg)

    @cached_property
    def sections(self) -> Array:
        """The low-pass filter as second-order sections (S, 6)."""
        if self.cutoff is None:
            return np.empty((0, 6))
        return np.asarray(butter(2, self.cutoff, fs=self.rate, output="sos"), dtype=np.float64)

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
    def _cone(self) -> float:
        """The cosine of the friction cone's half angle."""
        return float(1.0 / np.hypot(1.0, self.friction))

    def start(self, signals: int) -> SensingState:
        """The state before the first sample of N signals."""
        return SensingState(np.empty((signals, 0, 6)), np.zeros((signals, len(self.sections), 2, 6)))

    def check_rate(self, times: Array, name: str) -> None:
        """Refuse times (T,) that are not `rate` per second; rows that a log lost are no other rate.

        Raises:
            InputError: the median interval is off by more than 2 %.
        """
        if len(times) < 2:
            return
        rate = float(1.0 / np.median(np.diff(times)))
        if not abs(rate / self.rate - 1.0) <= 0.02:
            raise InputError(
                f"{name} has {rate:.4g} samples per second, not {self.rate:.4g}; set the rate to that."
            )

    def clean(self, wrench: Array, state: SensingState) -> tuple[Array, SensingState]:
        """Tared and filtered wrenches (N, T, 6) of a chunk of raw ones, NaN while taring, and the new state.

        The results do not depend on the chunks, to the bit.
        """
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
            state: from `start`, or from the chunk before.

        Returns:
            The locations, and the state for the next chunk. They do not depend on the chunks, to the bit.
        """
        cleaned, state = self.clean(wrench, state)
        return self._located(cleaned), state

    def _in_contact(self, cleaned: Array) -> Mask:
        """Samples (...) of cleaned wrenches (..., 6) with the force of a contact."""
        with np.errstate(invalid="ignore"):
            return np.asarray(np.linalg.norm(cleaned[..., :3], axis=-1) >= self.threshold)

    def _located(self, cleaned: Array) -> Array:
        locations, touching = np.full((*cleaned.shape[:-1], 3), np.nan), self._in_contact(cleaned)
        locations[touching] = self.locate(cleaned[touching])
        return locations

    def locate(self, wrench: Array) -> Array:
        """Points (M, 3) where the lines of action of wrenches (M, 6) enter the peg, in its frame, or NaN."""
        force, torque = wrench[:, :3], wrench[:, 3:]
        magnitude = np.linalg.norm(force, axis=1, keepdims=True)
        direction = force / magnitude
        point = np.cross(direction, torque / magnitude)
        surface = self._surface
        along = np.sum((surface.center - point) * direction, axis=1, keepdims=True)
        point = point + along * direction
        locations = np.full((len(wrench), 3), np.nan)
        near = np.linalg.norm(point - surface.center, axis=1) <= surface.radius + self.miss_tolerance
        if not near.any():
            return locations
        point, direction = point[near], direction[near]
        origin = point - 1.1 * surface.radius * direction
        face = surface.first_face(origin, direction)
        entry, hit = np.full((len(point), 3), np.nan), face >= 0
        # The ray tracer returns the face; the point on it is computed in double precision.
        normal = surface.normals[face[hit]]
        cosine = np.sum(direction[hit] * normal, axis=1)
        reach = np.sum((surface.anchors[face[hit]] - origin[hit]) * normal, axis=1) / cosine
        entry[hit] = origin[hit] + reach[:, None] * direction[hit]
        in_cone = np.zeros(len(point), dtype=bool)
        in_cone[hit] = -cosine >= self._cone
        entry[~in_cone] = _nearest_on_edges(
            point[~in_cone], direction[~in_cone], self._edges, self._cone, self.miss_tolerance
        )
        locations[near] = entry
        return locations

    def measure(self, touches: Sequence[Touch]) -> list[tuple[Tensor, Tensor]]:
        """Contact locations (T, 3) in the peg's frame, its poses (T, 7), of consecutive windows of one probe.

        The first window must be the probe's first, which contains the samples of the tare; the filter's state
        is carried from window to window. Gravity is compensated first.

        Raises:
            InputError: a window's samples are not `rate` per second within 2 %, its arrays do not fit, a
                wrench is not finite (the filter would carry it into all later samples), or its torques are
                in N mm.
        """
        measured, reach = [], float(np.linalg.norm(self._surface.center)) + self._surface.radius
        for touch, cleaned in zip(touches, self._cleaned(touches, finite=True), strict=True):
            refuse_millimetres(cleaned[self._in_contact(cleaned)], reach)
            pose = torch.from_numpy(np.array(touch.world_from_peg, dtype=np.float64))
            measured.append((torch.from_numpy(self._located(cleaned)), pose))
        return measured

    def tared(self, touches: Sequence[Touch]) -> list[Tensor]:
        """Wrenches (T, 6) of the same windows, gravity compensated and tared but not filtered.

        NaN while taring: `bcppl.distributions.contact.Wrench` compares them with the simulated ones, and
        `bcppl.contact.sensing.onset.OnsetDetector` ignores those NaN. A later wrench that is not finite is
        returned as it is.

        Raises:
            InputError: a window's samples are not `rate` per second within 2 %, its arrays do not fit, or a
                wrench is not finite while taring.
        """
        unfiltered = replace(self, cutoff=None)
        return [torch.from_numpy(cleaned) for cleaned in unfiltered._cleaned(touches, finite=False)]

    def next_tared(self, touch: Touch, state: SensingState, name: str) -> tuple[Array, SensingState]:
        """The same (T, 6) of one more window, and the state for the window after it.

        `state` is from `start(1)`, or from the window before; `name` is the window's, for messages.

        Raises:
            InputError: as of `tared`.
        """
        return replace(self, cutoff=None)._next_cleaned(touch, state, name, finite=False)

    def _cleaned(self, touches: Sequence[Touch], finite: bool) -> Iterator[Array]:
        """Cleaned wrenches (T, 6) of consecutive windows; they must be finite, or only those of the tare."""
        state = self.start(1)
        for k, touch in enumerate(touches):
            cleaned, state = self._next_cleaned(touch, state, f"window {k}", finite)
            yield cleaned

    def _next_cleaned(
        self, touch: Touch, state: SensingState, name: str, finite: bool
    ) -> tuple[Array, SensingState]:
        count, pose = len(touch.times), touch.world_from_peg
        if touch.wrench.shape != (count, 6) or pose.shape != (count, 7):
            raise InputError(
                f"{name} has {count} times, wrenches {touch.wrench.shape} and peg poses "
                f"{pose.shape}; give (T,), (T, 6) and (T, 7)."
            )
        self.check_rate(touch.times, name)
        wrench = touch.wrench.astype(np.float64)
        needed = count if finite else self.tare - state.tare.shape[1]
        for what, rows in (("peg pose", pose), ("wrench", wrench[:needed])):
            missing = ~np.isfinite(rows).all(axis=1)
            if missing.any():
                raise InputError(
                    f"{name} has a {what} that is not finite at row {int(missing.argmax())}; fill it "
                    "by interpolation, or cut the recording there."
                )
        if self.load is not None:
            wrench = wrench - self.load.weight(pose)
        cleaned, state = self.clean(wrench[None], state)
        return cleaned[0], state


@compiled
def _nearest_on_edges(
    point: Array, direction: Array, edges: tuple[Array, Array, Array], cone: float, tolerance: float
) -> Array:
    """Points (M, 3) of edges, of `ContactSensing._edges`, nearest to lines (M, 3), NaN beyond the tolerance.

    Only edges that the force pushes into the peg, within the friction cone of a normal there, count.
    """
    start, extent, normals = edges
    nearest, gap, edge = np.full((len(point), 3), np.nan), np.empty(3), np.empty(3)
    for m in range(len(point)):
        line, least = direction[m], tolerance
        for e in range(len(start)):
            pushed = -min(dot(normals[e, 0], line), dot(normals[e, 1], line), dot(normals[e, 2], line))
            if pushed < cone:
                continue
            # In the plane across the line, the line is a point and an edge a shorter edge.
            beyond, along = dot(start[e], line) - dot(point[m], line), dot(extent[e], line)
            for axis in range(3):
                gap[axis] = start[e, axis] - point[m, axis] - beyond * line[axis]
                edge[axis] = extent[e, axis] - along * line[axis]
            share = min(max(-dot(gap, edge) / max(dot(edge, edge), 1e-30), 0.0), 1.0)
            gap += share * edge
            distance = np.sqrt(dot(gap, gap))
            if distance <= least and (distance < least or np.isnan(nearest[m, 0])):
                least = distance
                nearest[m] = start[e] + share * extent[e]
    return nearest
