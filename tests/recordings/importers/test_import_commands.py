"""What `bcppl check` prints of a recording's names, and what a published set's force cannot be."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import yaml
from typer.testing import CliRunner

from bcppl.cli import app
from bcppl.errors import InputError
from bcppl.models.shipped import load_recording
from bcppl.recordings import save
from bcppl.recordings.importers.bench.configuration.reading import read_configuration
from bcppl.recordings.importers.reassemble.reading import ReassembleArrays

TEMPLATE = Path(__file__).parents[3] / "bcppl/recordings/importers/bench/configuration/template.yaml"


def test_a_probes_name_is_neither_markup_nor_a_terminals_command(tmp_path: Path) -> None:
    recording = load_recording("peg_probe")
    probe = next(m.action.probe for m in recording.measurements if m.kind == "window")
    named = replace(probe, name="touch [/b] \x1b[2J")
    measurements = [
        replace(m, action=replace(m.action, probe=named)) if m.kind == "window" else m
        for m in recording.measurements
    ]
    save(replace(recording, measurements=measurements), tmp_path / "named.h5")
    shown = CliRunner().invoke(app, ["check", str(tmp_path / "named.h5")], env={"COLUMNS": "200"})
    assert "touch [/b]" in shown.output and "\x1b[2J" not in shown.output


@pytest.mark.parametrize("load", ["compensated", "identified"])
def test_the_weight_in_a_measured_force_is_not_compensated(load: str, tmp_path: Path) -> None:
    content = yaml.safe_load(TEMPLATE.read_text(encoding="utf-8"))
    wrench = {"topic": "measured_force", "axes": "sensor", "about": "sensor", "sign": "on_peg"}
    content.update(wrench=wrench, pose={"topic": "pose"}, cameras={}, gravity={"load": load})
    (tmp_path / "bench.yaml").write_text(yaml.safe_dump(content))
    fields = read_configuration(tmp_path / "bench.yaml")
    words = "measured_force, with the tool's weight in it" if load == "compensated" else "missing"
    with pytest.raises(InputError, match=words):
        ReassembleArrays(tmp_path / "missing.h5", fields)
