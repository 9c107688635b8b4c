"""Another process for test_saved_runs: it resumes runs from files, and writes the steps that come after.

python -m tests.inference.resume_saved FOLDER NAME...
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import torch

from bcppl.inference import saved
from bcppl.inference.filters.smc import Step
from bcppl.recordings import load
from tests.inference.test_resumed_runs import RUNS, state_of


def resumed(name: str, folder: Path, number: int) -> list[Step]:
    """The steps after the one in a file, on a scene of this process."""
    infer, model, *_ = RUNS[name]
    recording = load(folder / f"{number}.recording.h5")
    scene = model.prepare(recording)
    start = saved.load_step(folder / f"{number}.h5", model, recording, scene)
    return list(infer(model, recording, seed=3, start=start, scene=scene))


def numbers_of(steps: list[Step]) -> list[dict[str, Any]]:
    return [{**state_of(step), "known": step.population.trace.known} for step in steps]


if __name__ == "__main__":
    where, *names = sys.argv[1:]
    for k, each in enumerate(names):
        torch.save(numbers_of(resumed(each, Path(where), k)), Path(where) / f"{k}.pt")
