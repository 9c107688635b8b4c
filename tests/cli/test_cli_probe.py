"""`bcppl probe`: what it ranks, writes and refuses."""

from __future__ import annotations

import dataclasses
import functools
import inspect
import json
import re
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from bcppl import poses
from bcppl.beliefs import Belief
from bcppl.cli.commands import probe
from bcppl.geometry.holes import hole_of
from bcppl.inference.filters.guided_smc import infer
from bcppl.inference.planning.candidate_layout import MIXED
from bcppl.models import load_recording
from bcppl.models.look_and_touch import model
from bcppl.models.worlds.bench.scene import bench_scene
from bcppl.recordings import save
from bcppl.recordings.action_file import load_actions, save_actions
from bcppl.recordings.beliefs import load_belief, load_fingerprint, load_latent, save_belief
from bcppl.recordings.fingerprint import fingerprint
from bcppl.robot.plan import Plan
from tests.command_line import SHIPPED, Ran, short

KINDS = "touch:2,pair:1"


@functools.cache
def saved() -> tuple[bytes, dict[str, bytes]]:
    """A recording of two views, and the beliefs of a run over it, as files hold them."""
    with tempfile.TemporaryDirectory() as folder:
        look = bench_scene(5).look()
        save(look, f"{folder}/look.h5")
        beliefs = {}
        for k, step in enumerate(infer(model, look, particles=12, seed=0)):
            path = Path(folder) / f"belief_{k:03d}.h5"
            save_belief(
                step.belief,
                path,
                label=step.info.label,
                log_evidence=step.info.log_evidence,
                random_state=step.random_state,
                latent=dict(step.population.trace.choices),
                of=fingerprint(look, k),
            )
            beliefs[path.name] = path.read_bytes()
        return Path(f"{folder}/look.h5").read_bytes(), beliefs


@pytest.fixture
def here(tmp_path: Path) -> Path:
    """A folder with the recording and what a run of it left."""
    recording, beliefs = saved()
    (tmp_path / "look.h5").write_bytes(recording)
    (tmp_path / "runs").mkdir()
    (tmp_path / "folder.json").mkdir()
    for name, content in beliefs.items():
        (tmp_path / "runs" / name).write_bytes(content)
    noted = {"recording": str(tmp_path / "look.h5"), "model": "look_and_touch"}
    (tmp_path / "runs/run.json").write_text(json.dumps(noted))
    return tmp_path


def ranked(ran: Ran) -> list[tuple[str, float]]:
    """Names and gains of the table."""
    rows = re.findall(r"^ *\d+  (\S.*?) {2,}(-?[\d.]+) +± ", ran.out, flags=re.MULTILINE)
    return [(name, float(gain)) for name, gain in rows]


@pytest.mark.long
def test_a_recording_is_run_ranked_and_its_best_action_written(
    bcppl: Callable[..., Ran], here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ("--candidates", KINDS, "--particles", 12, "--outer-samples", 4, "--top", 3)
    ran = bcppl("probe", "look.h5", *words, "--output", "next.h5")
    assert ran.code == 0, ran.err
    table = ranked(ran)
    assert "3 candidates" in ran.out and "entropy now: -" in ran.out and len(table) == 3
    assert [gain for _, gain in table] == sorted((gain for _, gain in table), reverse=True)
    (best,) = load_actions("next.h5")
    assert isinstance(best, Plan) and best.name == table[0][0]
    assert (here / "next.png").stat().st_size > 10_000
    # The belief that a run left ranks as the run does, and a file of one's own is taken.
    monkeypatch.setenv("COLUMNS", "80")  # as of a pipe; no header is cut
    long = dataclasses.replace(best, name=f"{best.name}, thought over{' and over' * 4}")
    save_actions([long], "own.h5")
    own = bcppl("probe", "runs/belief_002.h5", "--candidates", "own.h5", "--outer-samples", 4)
    assert own.code == 0, own.err
    assert re.search(r"^rank  what .* time \(s\)  press \(N\)$", own.out, flags=re.MULTILINE), own.out
    ((name, gain),) = ranked(own)
    assert name == long.name and gain == pytest.approx(table[0][1], abs=0.02)
    (again,) = load_actions(here / "belief_002_next.json")
    assert np.array_equal(again.world_from_peg, best.world_from_peg)


@pytest.mark.long
def test_views_and_touches_are_ranked_together_and_other_models_by_reweighting(
    bcppl: Callable[..., Ran], here: Path
) -> None:
    words = ("--candidates", "touch:1,view:2", "--outer-samples", 4)
    table = dict(ranked(bcppl("probe", "runs/belief_002.h5", *words)))
    listed = json.loads(bcppl("probe", "runs/belief_002.h5", *words, "--json").out)["ranking"]
    assert {each["what"]: round(each["information_gain"], 2) for each in listed} == table
    views = [gain for name, gain in table.items() if name.startswith("view")]
    (touched,) = (gain for name, gain in table.items() if name.startswith("touch"))
    # A third view of a camera that is off by millimetres informs less than a touch.
    assert len(views) == 2 and 0.5 < max(views) < touched
    save(short(1), here / "push.h5")
    for kind, message in (
        ("view", "point_probe does not explain a measurement of kind 'view'"),
        ("touch", "holds no peg to carry out 'touch' with"),
    ):
        refused(bcppl("probe", "push.h5", "--candidates", f"{kind}:1", "--particles", 6), message)
    refused(
        bcppl("probe", "runs/belief_002.h5", "--by", "luck"),
        "'luck' is not one of 'linearised', 'reweighted'",
    )


def refused(ran: Ran, message: str) -> None:
    lines = ran.err.strip().splitlines()
    assert ran.code == 2, (ran.code, ran.out, ran.err)
    assert len(lines) == 1 and lines[0].startswith("bcppl: ") and lines[0].endswith("."), ran.err
    assert message in lines[0], lines[0]


HAND = ["--robot", "panda", "--link", "panda_hand"]
WRONG = {
    "none": (["--candidates", ""], "there are no candidates: --candidates is ''"),
    "kind": (["--candidates", "poke:3"], "'poke:3'; give kinds (touch"),
    "number": (["--candidates", "touch:x"], "'touch:x'"),
    "zero": (["--candidates", "touch:0"], "there are no candidates"),
    "no file": (["--candidates", "plans.json"], "no file of actions plans.json"),
    "top": (["--top", "0"], "'--top'"),
    "rate": (["--rate", "-1"], "'--rate'"),
    "output": (["--output", "next.txt"], "ends in .h5 or .json"),
    "folder": (["--output", "nowhere/next.h5"], "no folder nowhere"),
    "force": (["--force", "3"], "press with more than 3 N"),
    "below": (["--above", "0", "--candidates", "slide:1"], "from straight above"),
    "table": (["--table", "0.5"], "lead into the table"),
    "robot": (["--robot", "panda"], "without --link"),
    "robot's name": (["--robot", "hal", "--link", "x"], "no URDF file and no shipped robot"),
    "held": ([*HAND, "--link-from-peg", "1 2"], "a pose is seven numbers"),
    "held somehow": (HAND, "without --link-from-peg"),
    "reach": (
        [*HAND, "--link-from-peg", "0 0 0.1 0 1 0 0", "--world-from-base", "9 0 0 1 0 0 0"],
        "out of panda's reach",
    ),
    "link": (["--link", "panda_hand"], "give it with --robot"),
    "horizon": (["--horizon", "3"], "'--horizon'"),
    "seconds": (["--seconds", "0.5"], "last longer than 0.5 s"),
    "itself": (["--output", "runs/belief_002.h5"], "would overwrite runs/belief_002.h5"),
    "folder's name": (["--output", "folder.json"], "is a directory"),
    "many": (["--candidates", "touch:" + "9" * 5000], "10000 at most"),
    "outer samples": (["--outer-samples", "1"], "'--outer-samples'"),
    "table's height": (["--table", "nan"], "--table is nan"),
    "inference": (["--inference", "guided_smc"], "--inference is given with"),
    "of": (["--of", "nothing"], "there is no recording 'nothing'"),
}


@pytest.mark.parametrize("what", WRONG)
def test_what_is_wrong_is_one_sentence_and_nothing_is_written(
    what: str, bcppl: Callable[..., Ran], here: Path
) -> None:
    words, message = WRONG[what]
    before = sorted(here.rglob("*"))
    given = words if "--candidates" in words else [*words, "--candidates", "touch:1"]
    refused(bcppl("probe", "runs/belief_002.h5", *given), message)
    assert sorted(here.rglob("*")) == before


def test_another_recording_and_a_plan_through_the_part_are_noticed(
    bcppl: Callable[..., Ran], here: Path
) -> None:
    save(bench_scene(6).look(), here / "other.h5")
    ran = bcppl("probe", "runs/belief_002.h5", "--of", "other.h5", "--candidates", "touch:1")
    refused(ran, "is of another recording than other.h5")
    refused(bcppl("probe", "runs/belief_000.h5", "--of", "other.h5"), "is of another recording")
    down = load_belief("runs/belief_002.h5").mean.expand(2, 7).clone()
    down[0, 2] += 0.2
    plan = Plan("down", np.array([0.0, 1.0]), down.numpy(), ("free",), 4.0, np.ones(6), np.ones(6))
    save_actions([plan], here / "down.json")
    refused(bcppl("probe", "runs/belief_002.h5", "--candidates", "down.json"), "lead through the part (1)")


def test_beliefs_that_say_nothing_are_refused(bcppl: Callable[..., Ran], here: Path) -> None:
    belief = load_belief("runs/belief_002.h5")
    count, latent = len(belief), load_latent("runs/belief_002.h5")

    def written(name: str, changed: Belief, values: dict[str, torch.Tensor]) -> str:
        state = torch.Generator().get_state()
        save_belief(
            changed, f"runs/{name}", label="view 2", log_evidence=0.0, random_state=state, latent=values
        )
        return f"runs/{name}"

    save_belief(
        belief,
        "runs/mine.h5",
        label="mine",
        log_evidence=0.0,
        random_state=torch.Generator().get_state(),
        latent=latent,
    )
    refused(bcppl("probe", "runs/mine.h5", "--candidates", "touch:1"), "has the label 'mine'")
    none = torch.full((count,), -torch.inf, dtype=torch.float64)
    weightless = written("none.h5", Belief(belief.world_from_part, none), latent)
    same = {a: v[:1].expand_as(v).clone() for a, v in latent.items()}
    point = written("point.h5", Belief(same["part"], torch.zeros_like(none)), same)
    refused(bcppl("probe", weightless, "--candidates", "touch:1"), "has no weight")
    refused(bcppl("probe", point, "--candidates", "touch:1"), "collapsed to a point")
    (here / "runs/run.json").unlink()
    refused(bcppl("probe", point), "give --of RECORDING")
    refused(bcppl("probe", "look.h5", "--of", "look.h5"), "leave it out")
    refused(bcppl("probe", point, "--of", SHIPPED), "does not fit the model or the recording")
    twice = load_twice(here)
    refused(bcppl("probe", "runs/belief_002.h5", "--of", "look.h5", "--candidates", twice), "two candidates")


def load_twice(folder: Path) -> Path:
    """A file of two plans of one name."""
    plan = Plan(
        "same",
        np.array([0.0, 1.0]),
        np.tile([0.5, 0.0, 0.5, 1.0, 0.0, 0.0, 0.0], (2, 1)),
        ("free",),
        4.0,
        np.full(6, 100.0),
        np.full(6, 1.0),
    )
    save_actions([plan, plan], folder / "twice.json")
    return folder / "twice.json"


def test_help_states_the_default_candidates(bcppl: Callable[..., Ran]) -> None:
    default = ",".join(f"{kind}:{count}" for kind, count in MIXED.items())
    assert f"{default} by default" in " ".join(str(inspect.signature(probe.probe)).split())


# ---- bcppl insert


def test_an_insertion_is_planned_from_a_belief_within_limits(bcppl: Callable[..., Ran], here: Path) -> None:
    words = ("--simulations", 0, "--speed", 0.004, "--force", 9, "--json")
    ran = bcppl("insert", "runs/belief_002.h5", *words)
    assert ran.code == 0, ran.err
    assert json.loads(ran.out)["output"] == "insertion.json" and "the hole is at" in ran.err
    search, push = load_actions("insertion.json")
    assert isinstance(search, Plan) and isinstance(push, Plan) and push.force == 9.0
    for plan in (search, push):
        for k, manner in enumerate(plan.manners):
            moved = np.linalg.norm(np.diff(plan.world_from_peg[k : k + 2, :3], axis=0))
            if manner in ("guarded", "searching") or plan is push:
                assert moved / (plan.times[k + 1] - plan.times[k]) < 0.0041, (plan.name, k, manner)
    box = "0 0 0 0.001 0.001 0.001"
    refused(bcppl("insert", "runs/belief_002.h5", "--workspace", box), "outside --workspace")
    refused(bcppl("insert", "runs/belief_002.h5", "--workspace", "1 2"), "give six numbers")
    refused(bcppl("insert", "runs/belief_002.h5", "-o", "plan.txt"), "ends in .h5 or .json")
    save(short(1), here / "push.h5")
    refused(bcppl("insert", "push.h5", "--particles", 6), "no peg to insert")


def test_a_recording_is_played_and_its_belief_kept(bcppl: Callable[..., Ran], here: Path) -> None:
    save(short(2), here / "pushes.h5")
    ran = bcppl("live", "pushes.h5", "--particles", 6, "--speed", 100, "-o", "last.h5", "--deadline", 60)
    assert ran.code == 0, ran.err
    assert "2 of 2 updates were done within 60 s" in ran.out and "push 2" in ran.out
    assert len(load_belief(here / "last.h5")) == 6
    refused(bcppl("live", "pushes.h5", "-o", "nowhere/last.h5"), "no folder nowhere")
    for command in (("live", "-o"), ("view", "--save"), ("insert", "-o")):
        refused(bcppl(command[0], "pushes.h5", command[1], "pushes.h5"), "would overwrite pushes.h5")


def test_what_is_planned_is_planned_of_the_belief_that_was_kept(
    bcppl: Callable[..., Ran], here: Path
) -> None:
    """A file that lacks the values of a camera's errors would have them, and the pose, from the prior."""
    whole = load_recording("peg_probe")
    save(replace(whole, measurements=whole.measurements[:1]), here / "seen.h5")
    assert bcppl("live", "seen.h5", "--particles", 8, "--speed", 1000, "-o", "last.h5").code == 0
    words = ("--of", "seen.h5", "--simulations", 0, "--json")
    ran = bcppl("insert", "last.h5", *words)
    assert ran.code == 0, ran.err
    belief = load_belief(here / "last.h5")
    hole = poses.compose(belief.mean, torch.from_numpy(hole_of(whole.part).part_from_hole))
    np.testing.assert_allclose(json.loads(ran.out)["world_from_hole"][:3], hole[:3], atol=1e-6)
    kept = {"label": "view 1", "of": load_fingerprint(here / "last.h5")}
    kept |= {"log_evidence": 0.0, "random_state": torch.get_rng_state()}
    save_belief(belief, here / "poses.h5", **kept)
    refused(bcppl("insert", "poses.h5", *words), "holds no values of bias_camera")
    other = {**load_latent(here / "last.h5"), "part": belief.world_from_part.flip(0)}
    save_belief(belief, here / "other.h5", latent=other, **kept)
    refused(bcppl("insert", "other.h5", *words), "has other poses at 'part'")


def test_a_first_touch_is_planned_before_anything_is_measured(
    bcppl: Callable[..., Ran], tmp_path: Path
) -> None:
    """From part, guess and peg; what the plan is warned of is said once, without a place in the source."""
    save(replace(load_recording("peg_probe"), measurements=[]), tmp_path / "none.h5")
    ran = bcppl("probe", "none.h5", "--candidates", "touch:2", "--particles", 10)
    assert ran.code == 0 and len(load_actions(tmp_path / "none_next.json")) == 1
    warned = ran.err.strip().splitlines()
    assert len(warned) == 1 and warned[0].startswith("bcppl: warning: a surface may be farther away")
    ran = bcppl("run", "none.h5")
    assert ran.code == 2 and "holds no measurement" in ran.err
