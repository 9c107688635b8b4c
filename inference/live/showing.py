"""Steps of a live belief on its pages."""

from __future__ import annotations

from typing import TYPE_CHECKING

from bcppl.inference.filters.smc import Step
from bcppl.sensors import Recording
from bcppl.viewer.live import LivePage

if TYPE_CHECKING:
    from bcppl.inference.live.updates import UpdateInfo

COLUMNS = ("measurement", "particles", "joined", "late s", "log Z")


def show(page: LivePage, step: Step, recording: Recording, update: UpdateInfo | None = None) -> None:
    """Add the newest step, and what its update did."""
    late = ["", ""] if update is None else [str(update.joined), f"{update.seconds:.2f}"]
    cells = [step.info.label, str(len(step.population)), *late, f"{step.info.log_evidence:.2f}"]
    page.add(step.info.label, step.belief, recording, cells)


def show_earlier(page: LivePage, recording: Recording) -> None:
    """Add the steps before the newest, whose beliefs are not kept."""
    for k in range(len(recording.measurements)):
        label = f"{recording.measurements[k - 1].kind} {k}" if k else "prior"
        page.add(label, None, recording, [label, *[""] * (len(COLUMNS) - 1)])
