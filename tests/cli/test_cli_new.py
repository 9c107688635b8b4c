"""What `bcppl new` writes runs as it stands."""

from __future__ import annotations

import importlib
import json
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from bcppl.geometry.parts import Guess
from bcppl.inference import guided_smc, importance_sampling, observations_of, tempered_smc
from bcppl.models.look_and_touch import model
from bcppl.recordings import load, problems, save
from bcppl.sensors import Measurement, protocol, sensor_named
from tests.command_line import FEW_MOVES, Ran, short


@pytest.mark.long
def test_a_new_model_runs_and_takes_its_setting(bcppl: Callable[..., Ran], tmp_path: Path) -> None:
    assert bcppl("new", "model", "mine").code == 0
    save(short(1), tmp_path / "push.h5")
    words = ("run", "push.h5", "--particles", 20, "--inference", FEW_MOVES, "--model", "mine.py", "--json")
    first, second = (json.loads(bcppl(*words, "--set", f"spread={s}").out) for s in ("0.0004", "0.004"))
    assert first["complete"] and first["rows"][1]["log Z"] != second["rows"][1]["log Z"]
    assert json.loads((tmp_path / "runs/push/run.json").read_text()) == first


@pytest.mark.long
@pytest.mark.parametrize("kind", ["proposal", "kernel"])
def test_a_new_inference_program_runs(bcppl: Callable[..., Ran], tmp_path: Path, kind: str) -> None:
    assert bcppl("new", kind, "mine.py").code == 0
    save(short(1), tmp_path / "push.h5")
    ran = bcppl("run", "push.h5", "--particles", 20, "--inference", "mine.py", "--json")
    assert ran.code == 0, ran.err
    assert 0.0 < float(json.loads(ran.out)["rows"][1]["acc."]) < 1.0


def evidence_by_draws(recording: Any) -> float:
    """The log evidence of a recording by draws of the prior."""
    torch.manual_seed(0)
    each = list(observations_of(model, model.prepare(recording), recording.measurements))
    values = {address: value for one in each for address, value in one.observations.items()}
    return importance_sampling(model.program, each[-1].args, values, 20000).log_evidence


@pytest.mark.usefixtures("own_registry")
def test_a_new_sensor_is_saved_checked_and_explained(
    bcppl: Callable[..., Ran], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert bcppl("new", "sensor", "gauge").code == 0
    monkeypatch.syspath_prepend(tmp_path)
    gauge = importlib.import_module("gauge")
    pushes = short(1)
    middle = pushes.guess.world_from_part[:3]
    truth = np.array([*middle, 1.0, 0.0, 0.0, 0.0])
    reach = 0.5 * pushes.part.extent[2] + 0.01
    place = gauge.Place("over", middle + np.array([0.0, 0.0, reach]))
    readings = [Measurement(place, gauge.Reading(m)) for m in (0.0101, 0.0098, -1.0)]
    recording = replace(pushes, measurements=readings[:2], truth=truth)
    save(recording, tmp_path / "own.h5")
    assert sensor_named("gauge").kind == "gauge" and not problems(load(tmp_path / "own.h5"))
    assert "the reading is negative" in problems(replace(recording, measurements=readings))[0]
    scene = model.prepare(load(tmp_path / "own.h5"))
    *_, last = tempered_smc.infer(model, recording, particles=40, scene=scene, sweeps=2)
    assert last.taken == 2 and np.isfinite(last.info.log_evidence)
    # It has no quadratic approximation, which guided SMC does without.
    free = replace(recording, guess=Guess(truth, translation=[0.003] * 3, angle=0.05))
    *_, guided = guided_smc.infer(model, free, particles=200)
    assert guided.info.log_evidence == pytest.approx(evidence_by_draws(free), abs=0.5)

    # Of another process, in which the model's file imports the sensor's.
    assert bcppl("new", "model", "gauged").code == 0
    file = tmp_path / "gauged.py"
    file.write_text(file.read_text().replace("\nimport ", "\nimport gauge\nimport ", 1))
    monkeypatch.delitem(sys.modules, "gauge")
    for registered in (protocol._registered, protocol._by_type):
        for key in [k for k, v in registered.items() if "gauge" in (k, getattr(v, "kind", ""))]:
            del registered[key]
    assert "unknown kind 'gauge'" in bcppl("run", "own.h5", "--particles", 8).err
    ran = bcppl("run", "own.h5", "--particles", 8, "--inference", FEW_MOVES, "--model", "gauged.py")
    assert ran.code == 0, ran.err


def test_what_is_there_is_not_written_over_and_names_are_names(bcppl: Callable[..., Ran]) -> None:
    assert bcppl("new", "kernel", "mine").code == 0
    again = bcppl("new", "kernel", "mine")
    assert again.code == 2 and "mine.py exists already" in again.err
    assert "no name of a Python module" in bcppl("new", "model", "my-model").err
