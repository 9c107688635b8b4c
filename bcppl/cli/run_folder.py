"""The folder of a run: a belief after each measurement, the newest step, run.json, and two figures."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bcppl.beliefs import Belief
from bcppl.cli import latent_sites
from bcppl.errors import InputError
from bcppl.inference.filters.smc import Step
from bcppl.inference.population import Population
from bcppl.inference.saved import save_step
from bcppl.recordings import Recording
from bcppl.recordings.beliefs import load_belief, load_label, save_belief
from bcppl.recordings.fingerprint import fingerprint
from bcppl.recordings.hdf5 import replacing
from bcppl.sensors import sensor_of
from bcppl.untrusted import strict_json

if TYPE_CHECKING:
    from matplotlib.figure import Figure

RECORD, STEP, PAGE = "run.json", "step.h5", "report.html"
OVER_TIME, IN_SPACE = "add_over_time.png", "belief_in_3d.png"
_NUMBERED = re.compile(r"belief_\d{3,}\.h5")


class RunFolder:
    """Holds what a run has computed so far, whenever it is stopped.

    Args:
        path: of the folder, which is made.
        recording: that is run.
        settings: of the run, for run.json.
        begun: whether the folder has a run.json of this run already, and no step to go on from.

    Attributes:
        record: the content of run.json.
        rows: of the table so far.
        history: by step so far, its label and belief.

    Raises:
        InputError: the folder holds a run, or what a run would write over, or cannot be made.
    """

    def __init__(
        self, path: Path, recording: Recording, settings: Mapping[str, Any], begun: bool = False
    ) -> None:
        blocked = next((p for p in (path, *path.parents) if p.exists() and not p.is_dir()), None)
        if blocked is not None:
            raise InputError(f"the folder {path} cannot be made, {blocked} is a file; give another by --out.")
        self.path = path
        self.recording = recording
        self.record: dict[str, Any] = {**settings, "version": version("bcppl")}
        self.rows: list[Mapping[str, str]] = []
        self.history: list[tuple[str, Belief]] = []
        try:
            path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"{path} cannot be made ({error.strerror}); give another --out.") from error
        if not begun:
            _claim(path)
        elif (path / belief_name(1)).exists():
            raise InputError(
                f"the run in {path} has beliefs and no {STEP} to go on from; run the recording again into "
                "another folder."
            )
        try:
            self.note(complete=False, rows=[], checked={})
        except InputError:
            if not begun:  # of a run that has not begun nothing is left in its way
                self.discard()
            raise

    @classmethod
    def resumed(cls, path: Path, record: Mapping[str, Any], recording: Recording, taken: int) -> RunFolder:
        """The folder of a run that was stopped, as it was after so many measurements."""
        folder = cls.__new__(cls)
        folder.path, folder.recording, folder.record = path, recording, dict(record)
        folder.rows = list(record["rows"][: taken + 1])
        files = [path / belief_name(number) for number in range(taken + 1)]
        folder.history = [(load_label(file), load_belief(file)) for file in files]
        return folder

    def add(self, step: Any, row: Mapping[str, str], checked: Mapping[str, str]) -> None:
        """Write a step's belief, run.json with the table so far, and the step, from which a run goes on.

        `checked` are the labels of the measurements by address, as of `PredictiveChecks`.
        """
        number = len(self.rows)
        save_belief(
            step.belief,
            self.path / belief_name(number),
            label=step.info.label,
            log_evidence=step.info.log_evidence,
            random_state=step.random_state,
            latent=latent_sites.values_of(step),
            of=fingerprint(self.recording, number),
        )
        self.rows.append(row)
        self.history.append((step.info.label, step.belief))
        self.note(rows=self.rows, latent=latent_sites.summarised(step), checked=dict(checked))
        # Last: whatever stops the run, all that the step follows is there.
        if isinstance(step, Step) and isinstance(step.population, Population):
            save_step(step, self.path / STEP, self.recording)

    def note(self, **entries: Any) -> None:
        """Add entries to run.json, or replace them."""
        self.record.update(entries)
        with replacing(self.path / RECORD) as beside:
            beside.write_text(self.text, encoding="utf-8")

    @property
    def text(self) -> str:
        """The content of run.json as text."""
        return json.dumps(self.record, indent=1)

    def discard(self) -> None:
        """Leave no trace of a run that has made no step."""
        with suppress(OSError):
            (self.path / RECORD).unlink()
            self.path.rmdir()

    def draw(self) -> None:
        """Draw ADD over the measurements, from the final mean where the truth is unknown, and beliefs."""
        from bcppl.figures import add_over_time, belief_in_3d  # matplotlib takes longer than a first step

        recording, points = self.recording, self.recording.part.surface_points()
        known = recording.truth is not None
        true = self.history[-1][1].mean if recording.truth is None else recording.truth
        adds = np.stack([belief.add(points, true).numpy() for _, belief in self.history])
        weights = np.stack([belief.weights.numpy() for _, belief in self.history])
        touching = [sensor_of(m.action).contact for m in recording.measurements][: len(self.history) - 1]
        labels = [label for label, _ in self.history]
        contact = touching.index(True) + 1 if len(set(touching)) > 1 else None
        figure = add_over_time(np.arange(len(labels), dtype=np.float64), adds, weights, labels, contact)
        if not known:
            figure.axes[0].set_ylabel("distance from the final mean (mm)")
        self._keep(figure, OVER_TIME)
        looked = [k for k, touches in enumerate(touching, 1) if not touches]
        shown = [
            (
                f"after {labels[k]}" if k else "start",
                self.history[k][1].world_from_part.numpy(),
                self.history[k][1].log_weights.numpy(),
            )
            for k in dict.fromkeys([0, looked[-1] if looked else len(labels) // 2, len(labels) - 1])
        ]
        self._keep(belief_in_3d(recording.part, shown, recording.truth), IN_SPACE)

    def write_page(self, conclusion: str, last: Any) -> None:
        """Write report.html, given the result in words and the last step."""
        from bcppl.cli.page import figures, page

        with replacing(self.path / PAGE) as beside:
            drawn = list(figures(self.recording, self.history, self.rows, last))
            beside.write_text(page(self.record, conclusion, self.rows, drawn), encoding="utf-8")

    def _keep(self, figure: Figure, name: str) -> None:
        with replacing(self.path / name) as beside:
            figure.savefig(beside, dpi=150, format="png")


def belief_name(number: int) -> str:
    """The file of the belief after so many measurements."""
    return f"belief_{number:03d}.h5"


def _written(path: Path) -> list[Path]:
    """The files in a folder that have names of those that a run writes, but for run.json."""
    beliefs = [file for file in path.glob("belief_*.h5") if _NUMBERED.fullmatch(file.name)]
    others = [path / name for name in (STEP, PAGE, OVER_TIME, IN_SPACE)]
    return [*sorted(beliefs), *(file for file in others if file.exists())]


def _claim(path: Path) -> None:
    """Make run.json, which no other run has made: of two that begin at once, one is refused."""
    held = f"{path} holds a run already; give another folder by --out, or go on with that run by"
    if not (path / RECORD).exists() and (others := _written(path)):
        raise InputError(
            f"{path} has a file {others[0].name} and no {RECORD}: a run would write over it; give another "
            "folder by --out."
        )
    try:
        (path / RECORD).open("x").close()
    except FileExistsError:
        raise InputError(f"{held} `bcppl run --resume {path}`.") from None
    except OSError as error:
        raise InputError(f"{path} cannot be written into ({error.strerror}); give another --out.") from error


def beside(path: Path) -> Path:
    """The folder, made; where it is taken the next one: `runs/name`, `runs/name_2`, `runs/name_3`."""
    number, free = 1, path
    while True:
        try:
            free.mkdir(parents=True)
        except FileExistsError:
            number += 1
            free = path.with_name(f"{path.name}_{number}")
        except OSError:
            return free  # which `RunFolder` refuses
        else:
            return free


_OF_LISTS: Mapping[str, type] = {"rows": dict, "doubts": str, "warnings": str}


def _all_are(kind: type, values: Any) -> bool:
    return values is None or (isinstance(values, list) and all(isinstance(each, kind) for each in values))


def read_record(path: Path) -> dict[str, Any]:
    """The content of run.json in the folder of a run.

    Raises:
        InputError: there is none, or it is none that `bcppl run` wrote.
    """
    if not (path / RECORD).is_file():
        raise InputError(f"there is no run in {path}: it has no {RECORD}; give the folder of a run.")
    record = strict_json.read(path / RECORD, "run the recording again", finite=False)
    kinds = {"recording": str, "model": str, "inference": str, "particles": int, "seed": int}
    kinds |= {"device": str, "settings": dict, "rows": list, "checked": dict, "files": dict}
    if isinstance(record, dict):
        record.setdefault("device", "cpu")  # of versions that had no other
        record.setdefault("files", {})
    wrong = [] if isinstance(record, dict) else ["recording"]
    wrong = wrong or [name for name, kind in kinds.items() if not isinstance(record.get(name), kind)]
    wrong = wrong or [name for name, kind in _OF_LISTS.items() if not _all_are(kind, record.get(name))]
    if wrong:
        raise InputError(
            f"{path / RECORD} has no {wrong[0]} as `bcppl run` writes it; run the recording again."
        )
    return record
