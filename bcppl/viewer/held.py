"""What a page holds: the bodies, the particles after each measurement, the measurements and the table.

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
from bcppl.sensors import Recording
from bcppl.viewer.of_measurements import GAP_UNIT, Bodies, shown
from bcppl.visible_text import visible

MOST = 2000  # particles of a step that are drawn, the heaviest
MOST_FACES = 10_000  # of a body that is drawn
CELLS = (300.0, 200.0, 150.0, 100.0, 70.0, 40.0)  # along the longest side, of a finer body
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
    **COLOURS,
}

History = Sequence[tuple[str, Belief]]


def content(
    recording: Recording,
    history: History = (),
    rows: Sequence[Mapping[str, str]] = (),
    facts: Mapping[str, object] | None = None,
    notes: Sequence[str] = (),
) -> dict[str, Any]:
    """All that a page shows, by name.

    Args:
        recording: with part, peg, cameras, measurements, and the truth where known.
        history: by step its label and belief, the prior first; nothing shows the guess alone.
        rows: of a table, one for each step.
        facts: about the run, for the page's head.
        notes: sentences about the run, such as its warnings.

    Raises:
        InputError: there are more steps than measurements and the prior, or rows for other steps.
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
    labels = [label for label, _ in history]
    labels = labels or ["start", *(f"{m.kind} {k}" for k, m in enumerate(recording.measurements, 1))]
    bodies = Bodies(recording)
    steps, measurements = [], []
    for number in range(len(labels)):
        step, poses = _step(recording, history[number][1] if history else None)
        steps.append(step)
        if number:
            action = recording.measurements[number - 1].action
            measurements.append(shown(action, number - 1, recording, poses, bodies))
    columns = list(dict.fromkeys(name for row in rows for name in row))
    named = {"part": recording.part.name, "model": recording.model, **(facts or {})}
    held = recording.peg
    truth = recording.truth
    return _printable(
        {
            "facts": [[name, str(value)] for name, value in named.items() if str(value)],
            "source": recording.source,
            "notes": list(notes),
            "columns": columns,
            "rows": [[str(row.get(name, "")) for name in columns] for row in rows],
            "labels": labels,
            "inferred": bool(history),
            "gap_unit": GAP_UNIT,
            "palette": PALETTE,
            "part": shape(recording.part),
            "peg": None if held is None else shape(held),
            "truth": None if truth is None else np.asarray(truth, dtype=np.float32),
            "steps": steps,
            "measurements": measurements,
        }
    )


def shape(part: Part) -> dict[str, Any]:
    """Name, vertices (V, 3) in metres, faces (F, 3), sharp edges (E, 2, 3) and extent of a drawn body."""
    triangles, edges = outline(part, MOST_FACES, CELLS[0])
    for cells in CELLS[1:]:
        if len(triangles) > MOST_FACES:
            triangles, edges = outline(part, MOST_FACES, cells)
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
