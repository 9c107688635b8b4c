"""What a page holds: the bodies, and by step the particles, the measurement and the table's row.

Arrays stay arrays here; `bcppl.viewer.page` writes them as base64. Text is as files have it, with all that is
not printable spelled out.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from bcppl.arrays import Array
from bcppl.beliefs import Belief
from bcppl.errors import InputError
from bcppl.figures import palette
from bcppl.figures.space_elements import outline
from bcppl.figures.touches import COLOURS
from bcppl.geometry.parts import Part
from bcppl.robot.arm_with_peg import ArmWithPeg
from bcppl.sensors import Recording
from bcppl.untrusted.visible_text import visible
from bcppl.viewer.arm import DrawnArm
from bcppl.viewer.of_measurements import GAP_UNIT, Bodies, shown

MOST = 2000  # particles of a step that are drawn, the heaviest
MOST_FACES = 10_000  # of a body that is drawn
MOST_LINK_FACES = 1500  # of each link of an arm
CELLS = (300.0, 200.0, 150.0, 100.0, 70.0, 40.0, 25.0, 15.0)  # along the longest side, of a finer body
MOST_EDGES = 2000

PALETTE = {
    "strong": palette.STRONG,
    "truth": palette.TRUTH,
    "seen": palette.SEEN,
    "felt": palette.FELT,
    "particle": palette.PARTICLE,
    "body": palette.BODY,
    "peg": "#E6C35C",
    "cloud": "#303030",
    "arm": "#D8D8D2",
    **COLOURS,
}

History = Sequence[tuple[str, Belief]]


def content(
    recording: Recording,
    history: History = (),
    rows: Sequence[Mapping[str, str]] = (),
    facts: Mapping[str, object] | None = None,
    notes: Sequence[str] = (),
    arm: ArmWithPeg | None = None,
) -> dict[str, Any]:
    """All that a page shows, by name: the `head` of a page, and under `entries` its steps.

    Args:
        recording: with part, peg, cameras, measurements, and the truth where known.
        history: by step its label and belief, the prior first; nothing shows the guess alone.
        rows: of a table, one for each step.
        facts: about the run, for the page's head.
        notes: sentences about the run, such as its warnings.
        arm: that holds the peg.

    Raises:
        InputError: there are more steps than measurements and the prior, or rows for other steps; or the arm
            reaches no touch.
    """
    last = len(recording.measurements)
    if len(history) > last + 1:
        raise InputError(
            f"a page is given {len(history)} beliefs for a recording of {last} measurements; give one for "
            "the prior and one for each measurement, of the recording that was run."
        )
    if rows and len(rows) != len(history):
        raise InputError(
            f"a page is given {len(rows)} rows of a table for {len(history)} beliefs; give one for each."
        )
    beliefs: Sequence[tuple[str, Belief | None]] = history or [
        (label, None)
        for label in ("start", *(f"{m.kind} {k}" for k, m in enumerate(recording.measurements, 1)))
    ]
    steps = Steps(recording, arm)
    columns = list(dict.fromkeys(name for row in rows for name in row))
    entries = [
        steps.entry(
            recording, number, label, belief, [rows[number].get(name, "") for name in columns] if rows else []
        )
        for number, (label, belief) in enumerate(beliefs)
    ]
    touches = [each["measurement"] for each in entries if "times" in (each["measurement"] or {})]
    if arm is not None and touches and not any("arm" in touch for touch in touches):
        raise InputError(
            f"{arm.robot.name} reaches no touch of the recording; correct how it stands and how its link "
            f"{arm.link} holds the peg."
        )
    return {**steps.head(facts, notes, columns, inferred=bool(history)), "entries": entries}


class Steps:
    """What a page of a recording shows, step by step in their order."""

    def __init__(self, recording: Recording, arm: ArmWithPeg | None = None) -> None:
        self.recording, self.bodies = recording, Bodies(recording)
        self.arm = None if arm is None else DrawnArm(arm)

    def head(
        self,
        facts: Mapping[str, object] | None = None,
        notes: Sequence[str] = (),
        columns: Sequence[str] = (),
        inferred: bool = True,
    ) -> dict[str, Any]:
        """What belongs to no step: bodies, truth, colours, words."""
        of = self.recording
        named = {"part": of.part.name, "model": of.model, **(facts or {})}
        arm = self.arm and {
            "name": self.arm.arm.robot.name,
            "links": [_link(each) for each in self.arm.links],
        }
        head = {
            "facts": [[name, str(value)] for name, value in named.items() if str(value)],
            "source": of.source,
            "notes": list(notes),
            "columns": list(columns),
            "inferred": inferred,
            "gap_unit": GAP_UNIT,
            "palette": PALETTE,
            "part": shape(of.part),
            "peg": None if of.peg is None else shape(of.peg),
            "arm": arm,
            "truth": None if of.truth is None else np.asarray(of.truth, dtype=np.float32),
        }
        return dict(_printable(head))

    def entry(
        self,
        recording: Recording,
        number: int,
        label: str,
        belief: Belief | None,
        cells: Sequence[object] = (),
    ) -> dict[str, Any]:
        """One step: its label, particles, the table's cells, and the measurement before it.

        Args:
            recording: with this measurement at least.
            number: of the step; 0 is the prior, without a measurement.
            label: of the step.
            belief: None where there is none, and the part is at its guess.
            cells: of the table's row.
        """
        step, poses = _step(recording, belief)
        measurement: dict[str, Any] | None = None
        if number:
            action = recording.measurements[number - 1].action
            measurement = dict(shown(action, number - 1, recording, poses, self.bodies))
            if self.arm is not None and "pose" in measurement:
                placed = self.arm.placed(np.asarray(measurement["pose"], dtype=np.float64))
                if placed is not None:
                    rows, links = placed[0].astype(np.uint16), placed[1].astype(np.float32)
                    measurement["arm"] = {"rows": rows, "poses": links}
        entry = {
            "label": label,
            "step": step,
            "measurement": measurement,
            "cells": [str(each) for each in cells],
        }
        return dict(_printable(entry))


def shape(part: Part, most: int = MOST_FACES) -> dict[str, Any]:
    """Name, vertices (V, 3) in metres, faces (F, 3), sharp edges (E, 2, 3) and extent of a drawn body."""
    triangles, edges = outline(part, most, CELLS[0])
    for cells in CELLS[1:]:
        if len(triangles) > most:
            triangles, edges = outline(part, most, cells)
    flat = np.asarray(triangles, dtype=np.float32).reshape(-1, 3)
    vertices, faces = np.unique(flat, axis=0, return_inverse=True)
    longest = np.argsort(-np.linalg.norm(edges[:, 0] - edges[:, 1], axis=-1), kind="stable")[:MOST_EDGES]
    return {
        "name": part.name,
        "vertices": vertices,
        "faces": faces.reshape(-1).astype(np.uint32),
        "edges": np.asarray(edges[longest], dtype=np.float32),
        "extent": float(part.extent.max()),
        "of_faces": len(part.faces),
    }


def _link(part: Part) -> dict[str, Any]:
    """A link's `shape` without its edges."""
    drawn = shape(part, MOST_LINK_FACES)
    return {name: drawn[name] for name in ("name", "vertices", "faces")}


def _step(recording: Recording, belief: Belief | None) -> tuple[dict[str, Any], Tensor]:
    """A step, and the poses (1 + N, 7) for which measurements are asked: the mean, then the particles."""
    if belief is None:
        guess = torch.as_tensor(recording.guess.world_from_part, dtype=torch.float64).reshape(1, 7)
        none = {"poses": np.zeros((0, 7), np.float32), "weights": np.zeros(0, np.float32), "particles": 0}
        return {"mean": guess[0].numpy().astype(np.float32), **none}, guess
    heaviest = belief.log_weights.argsort(descending=True, stable=True)[:MOST].sort().values
    poses, weights = belief.world_from_part[heaviest], belief.weights[heaviest]
    variance = belief.covariance.diagonal()
    step = {
        "mean": belief.mean.numpy().astype(np.float32),
        "poses": _float32(poses),
        "weights": _float32(weights),
        "numbers": heaviest.numpy().astype(np.uint32),
        "particles": len(belief),
        "ess": belief.effective_sample_size,
        "spread_mm": 1e3 * math.sqrt(float(variance[:3].sum())),
        "spread_degrees": math.degrees(math.sqrt(float(variance[3:].sum()))),
    }
    return step, torch.cat([belief.mean[None], poses])


def _float32(values: Tensor) -> Array:
    return np.asarray(values.numpy(), dtype=np.float32)


def _printable(value: Any) -> Any:
    """The same with every text as `visible`."""
    if isinstance(value, str):
        return visible(value)
    if isinstance(value, Mapping):
        return {name: _printable(each) for name, each in value.items()}
    if isinstance(value, list):
        return [_printable(each) for each in value]
    return value
