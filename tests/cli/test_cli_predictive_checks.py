"""`bcppl run` marks measurements that fail their posterior predictive check, and warns in one sentence."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from bcppl import poses
from bcppl.beliefs import Belief
from bcppl.cli.predictive_checks import (
    MEANING,
    NAMED,
    PredictiveChecks,
    jump_sentence,
    piece_errors,
    sentence,
    together,
)
from bcppl.distributions.checks import Check
from bcppl.geometry.parts import Piece
from bcppl.models.worlds.bench.parameters import BenchParameters
from bcppl.models.worlds.bench.scene import bench_scene
from bcppl.recordings import save
from tests.command_line import Ran, short
from tests.made_recordings import assert_one_sentence

SETTINGS = "--model", "look_and_touch", "--inference", "guided_smc", "--particles", 30


@pytest.mark.long
@pytest.mark.parametrize("hidden", [False, True])
def test_a_hidden_view_is_marked_and_named_and_a_clean_one_is_not(
    hidden: bool, bcppl: Callable[..., Ran], tmp_path: Path
) -> None:
    scene = bench_scene(0, BenchParameters(occluder=hidden))
    save(scene.look(), tmp_path / "look.h5")
    ran = bcppl("run", "look.h5", *SETTINGS)
    assert ran.code == 0, ran.err
    rows = json.loads((tmp_path / "runs/look/run.json").read_text())["rows"]
    values = [row["p value"] for row in rows]
    assert values[0] == "" and all(values[1:])
    marked = [k for k, p in enumerate(values) if p == "<0.001!"]
    assert all(0.001 <= float(p) <= 1.0 for k, p in enumerate(values) if k and k not in marked)
    warnings = [line for line in ran.out.splitlines() if "predictive check" in line]
    if hidden:
        assert scene.hidden_view is not None and scene.hidden_view + 1 in marked
        assert len(warnings) == 1 and f"view {scene.hidden_view + 1}" in warnings[0]
        assert "occlude the view" in warnings[0]
    else:
        assert not marked and not warnings


UNCHECKED = """
import pyro
import pyro.distributions as dist
import torch
from bcppl.models.point_probe import prepare
from bcppl.traces import Model

def program(scene, actions):
    part = pyro.sample("part", scene.prior)
    for k in range(len(actions)):
        pyro.sample(f"x_{k}", dist.Laplace(part[..., 0], 0.1))

def observe(scene, measurements):
    return {f"x_{k}": torch.tensor(0.0).double() for k in range(len(measurements))}

model = Model(program, prepare, observe, "part")
"""


@pytest.mark.long
def test_a_model_without_a_check_has_no_p_values(bcppl: Callable[..., Ran], tmp_path: Path) -> None:
    save(short(1), tmp_path / "short.h5")
    (tmp_path / "unchecked.py").write_text(UNCHECKED)
    ran = bcppl("run", "short.h5", "--particles", 4, "--model", "unchecked.py")
    assert ran.code == 0 and "predictive check" not in ran.out
    rows = json.loads((tmp_path / "runs/short/run.json").read_text())["rows"]
    assert [row["p value"] for row in rows] == ["", ""]


def of(kind: str, probability: float = 1e-9) -> Mapping[str, Check]:
    return {kind: Check(probability, kind, 9.0)}


def test_one_sentence_names_the_measurements_and_what_each_kind_may_mean() -> None:
    warning = sentence({"view 1": of("image"), "window 7": of("contacts")})
    assert "view 1, window 7 do not fit" in warning
    assert MEANING["image"] in warning and MEANING["contacts"] in warning and MEANING["normal"] not in warning
    assert_one_sentence(warning)
    many = sentence({f"window {k}": of("contacts") for k in range(1, NAMED + 4)})
    assert "and 3 more" in many and many.count(MEANING["contacts"]) == 1
    # Of several sites that came with one measurement the least likely states what is wrong.
    assert MEANING["normal"] in sentence({"view 2": {**of("image", 0.5), **of("normal")}})


def test_sites_that_came_together_are_counted() -> None:
    three = [Check(p, "normal", 0.0) for p in (0.2, 0.01, 0.9)]
    assert together(three) == pytest.approx(0.03)
    assert together(three[:1]) == 0.2 and together([three[2]] * 2) == 1.0


def test_measurements_from_one_on_or_up_to_one_are_called_a_part_that_moved() -> None:
    every = [f"view {k}" for k in range(1, 7)]
    late = sentence({label: of("through") for label in every[3:]}, every)
    assert "all from view 4 on, as if the part had moved" in late and MEANING["through"] in late
    assert "all up to view 3, as" in sentence({label: of("through") for label in every[:3]}, every)
    for labels in ([], every[2:3], every[1:4], every):
        assert "as if" not in sentence({label: of("through") for label in labels or every[-1:]}, every)


def test_pieces_that_are_not_the_mesh_are_named_and_those_that_are_are_not() -> None:
    recording = bench_scene(0).look()
    assert piece_errors(recording) == []
    for factor in (1.1, 0.9):
        pieces = tuple(Piece(p.kind, factor * p.size, factor * p.center) for p in recording.part.pieces)
        (warning,) = piece_errors(replace(recording, part=replace(recording.part, pieces=pieces)))
        assert recording.part.name in warning and "convex pieces" in warning
        assert_one_sentence(warning)


def test_a_belief_that_jumps_is_named_where_a_check_fails_and_one_that_narrows_is_not() -> None:
    """Means of beliefs of 1 mm, then the same, then 20 mm beside it; the prior is as wide as the jump."""
    checks = PredictiveChecks()
    for k, (mean, spread) in enumerate([(0.0, 0.02), (0.01, 0.001), (0.011, 0.0005), (0.03, 0.0005)]):
        pose = poses.identity().repeat(400, 1)
        pose[:, :3] = spread * torch.randn(400, 3, generator=torch.Generator().manual_seed(k))
        pose[:, 0] += mean
        belief = Belief(pose.double(), torch.zeros(400, dtype=torch.float64))
        checks.compare(belief, f"touch {k}")
        assert checks.jump is None or checks.jump.check.surprising == (k == 3)
    assert checks.jump is not None and checks.jump.label == "touch 3"
    assert checks.jump.distance == pytest.approx(0.019, abs=5e-4)
    warning = jump_sentence(checks.jump)
    assert_one_sentence(warning)
    assert "19 mm at touch 3" in warning and "moved" in warning
