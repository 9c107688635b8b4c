"""The folder of a run: a belief after each measurement, run.json, and two figures."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from bcppl.cli import latent_sites
from bcppl.recordings import Recording
from bcppl.recordings.beliefs import save_belief
from bcppl.recordings.file import replacing
from bcppl.recordings.fingerprint import fingerprint
from bcppl.sensors import sensor_of


class RunFolder:
    """Holds what a run has computed so far, whenever it is stopped; an earlier run's files are removed.

    Args:
        path: of the folder, made with the first step.
        recording: that is run.
        settings: of the run, for run.json.
    """

    def __init__(self, path: Path, recording: Recording, settings: Mapping[str, Any]) -> None:
        self.path = path
        self.recording = recording
        self.record: dict[str, Any] = {**settings, "version": version("bcppl")}
        self.rows: list[Mapping[str, str]] = []

    def add(self, step: Any, row: Mapping[str, str]) -> None:
        """Write a step's belief, and run.json with the table so far and a summary of every latent site."""
        number = len(self.rows)
        if number == 0:
            self.path.mkdir(parents=True, exist_ok=True)
            for old in (*self.path.glob("belief_*.h5"), *self.path.glob("*.png")):
                old.unlink()
        save_belief(
            step.belief,
            self.path / f"belief_{number:03d}.h5",
            label=step.info.label,
            log_evidence=step.info.log_evidence,
            random_state=step.random_state,
            latent=latent_sites.values_of(step),
            of=fingerprint(self.recording, number),
        )
        self.rows.append(row)
        self.note(rows=self.rows, latent=latent_sites.summarised(step))

    def note(self, **entries: Any) -> None:
        """Add entries to run.json, or replace them."""
        self.record.update(entries)
        with replacing(self.path / "run.json") as beside:
            beside.write_text(json.dumps(self.record, indent=1), encoding="utf-8")

    def draw(self, steps: Sequence[Any]) -> None:
        """Draw ADD over the measurements, from the final mean where the truth is unknown, and beliefs."""
        from bcppl.figures import add_over_time, belief_in_3d  # matplotlib takes longer than a first step

        recording, points = self.recording, self.recording.part.surface_points()
        known = recording.truth is not None
        true = recording.truth if known else steps[-1].belief.mean
        adds = np.stack([step.belief.add(points, true).numpy() for step in steps])
        weights = np.stack([step.belief.weights.numpy() for step in steps])
        touching = [sensor_of(m.action).contact for m in recording.measurements][: len(steps) - 1]
        labels = [step.info.label for step in steps]
        contact = touching.index(True) + 1 if len(set(touching)) > 1 else None
        figure = add_over_time(np.arange(len(steps), dtype=np.float64), adds, weights, labels, contact)
        if not known:
            figure.axes[0].set_ylabel("distance from the final mean (mm)")
        figure.savefig(self.path / "add_over_time.png", dpi=150)
        looked = [k for k, touches in enumerate(touching, 1) if not touches]
        shown = [
            (
                f"after {labels[k]}" if k else "start",
                steps[k].belief.world_from_part.numpy(),
                steps[k].belief.log_weights.numpy(),
            )
            for k in dict.fromkeys([0, looked[-1] if looked else len(steps) // 2, len(steps) - 1])
        ]
        belief_in_3d(recording.part, shown, recording.truth).savefig(self.path / "belief_in_3d.png", dpi=150)
