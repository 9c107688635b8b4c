"""The command line: what it runs and what it writes."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch

from bcppl.beliefs import Belief
from bcppl.cli.commands.run import next_label
from bcppl.cli.run_folder import RunFolder, beside
from bcppl.errors import InputError
from bcppl.recordings import save
from bcppl.recordings.beliefs import load_belief, load_latent
from tests.command_line import FEW_MOVES, PROBE, SHIPPED, Ran, short


@pytest.mark.long
def test_a_users_own_files_are_taken_as_readily_as_names(bcppl: Callable[..., Ran], tmp_path: Path) -> None:
    mine = (
        PROBE.read_text().replace('f"onset_{k}"', 'f"begin_{k}"').replace("def point_probe(", "def my_probe(")
    )
    (tmp_path / "my_probe.py").write_text(mine.replace("program=point_probe", "program=my_probe"))
    (tmp_path / "my_smc.py").write_text(
        "from bcppl.inference import smc, tempered\n"
        "def infer(model, recording, *, particles, seed, scene):\n"
        "    options = {'particles': particles, 'seed': seed, 'scene': scene}\n"
        "    yield from smc(model, recording, step=tempered(), **options)\n"
    )
    save(short(), tmp_path / "short.h5")
    words = ("--particles", 8, "--model", "my_probe.py", "--inference", tmp_path / "my_smc.py")
    ran = bcppl("run", "short.h5", *words)
    assert ran.code == 0, ran.err
    assert "push 3" in ran.out and "standard deviation" in ran.out
    found = sorted(p.name for p in (tmp_path / "runs/short").iterdir())
    assert found == [
        "add_over_time.png",
        *(f"belief_{k:03d}.h5" for k in range(4)),
        "belief_in_3d.png",
        "report.html",
        "run.json",
        "step.h5",
    ]


@pytest.mark.long
def test_the_same_seed_writes_the_same_beliefs(bcppl: Callable[..., Ran], tmp_path: Path) -> None:
    save(short(2), tmp_path / "short.h5")
    for out, seed in (("a", 1), ("b", 1), ("c", 2)):
        words = ("--particles", 8, "--inference", FEW_MOVES, "--seed", seed, "--out", out)
        assert bcppl("run", "short.h5", *words).code == 0
    read = {out: h5py.File(tmp_path / out / "belief_002.h5") for out in "abc"}
    poses = {out: np.array(file["world_from_part"]) for out, file in read.items()}
    assert np.array_equal(poses["a"], poses["b"]) and not np.array_equal(poses["a"], poses["c"])


STOPS = {
    "RuntimeError('boom')": (1, "boom"),
    "InferenceError('no particle is left; use more.')": (1, "no particle is left; use more."),
    "InputError('what was given is wrong.')": (2, "what was given is wrong."),
    "KeyboardInterrupt": (130, None),
}


@pytest.mark.long
@pytest.mark.parametrize("error", STOPS)
def test_what_was_computed_before_a_stop_is_kept(
    error: str, bcppl: Callable[..., Ran], tmp_path: Path
) -> None:
    (tmp_path / "stops.py").write_text(
        "from bcppl.errors import InferenceError, InputError\n"
        "from tests.few_moves import infer as whole\n"
        "def infer(*args, **options):\n"
        "    for count, step in enumerate(whole(*args, **options)):\n"
        "        if count == 3:\n"
        f"            raise {error}\n"
        "        yield step\n"
    )
    ran = bcppl("run", SHIPPED, "--particles", 8, "--inference", "stops.py", "--out", "kept")
    code, message = STOPS[error]
    assert ran.code == code and "Traceback" not in ran.err + ran.out
    if message is not None:
        assert message in ran.err and len(ran.err.strip().splitlines()) == 1
    found = sorted(p.name for p in (tmp_path / "kept").iterdir())
    assert found == [
        "add_over_time.png",
        *(f"belief_{k:03d}.h5" for k in range(3)),
        "belief_in_3d.png",
        "report.html",
        "run.json",
        "step.h5",
    ]
    assert "push 2" in ran.out and "standard deviation" in ran.out


@pytest.mark.long
def test_what_a_folder_holds_of_others_is_left_as_it_is(bcppl: Callable[..., Ran], tmp_path: Path) -> None:
    save(short(1), tmp_path / "short.h5")
    (tmp_path / "out").mkdir()
    others = ("view_0.png", "belief_of_mine.h5", "notes.txt")
    for name in (*others, "belief_007.h5"):
        (tmp_path / "out" / name).write_text("old")
    words = ("run", "short.h5", "--particles", 4, "--inference", FEW_MOVES, "--out", "out")
    ran = bcppl(*words)
    assert ran.code == 2 and "out has a file belief_007.h5 and no run.json" in ran.err
    (tmp_path / "out/belief_007.h5").unlink()
    assert bcppl(*words).code == 0
    assert all((tmp_path / "out" / name).read_text() == "old" for name in others)


def test_of_two_runs_that_begin_at_once_in_one_folder_one_is_refused(tmp_path: Path) -> None:
    recording, settings = short(1), {"particles": 4}
    RunFolder(tmp_path / "out", recording, settings)  # has made no step so far
    with pytest.raises(InputError, match="holds a run already"):
        RunFolder(tmp_path / "out", recording, settings)
    taken = [beside(tmp_path / "runs/log").name for _ in range(3)]
    assert taken == ["log", "log_2", "log_3"]


def test_a_run_that_makes_no_step_leaves_no_folder(bcppl: Callable[..., Ran], tmp_path: Path) -> None:
    save(short(1), tmp_path / "short.h5")
    (tmp_path / "fails.py").write_text(
        "from bcppl.errors import InferenceError\n"
        "def infer(model, recording, **options):\n    raise InferenceError('nothing to be done.')\n"
    )
    ran = bcppl("run", "short.h5", "--inference", "fails.py")
    assert ran.code == 1 and "nothing to be done." in ran.err
    assert not (tmp_path / "runs/short").exists()


def test_names_with_dollars_and_escapes_are_drawn_and_printed(
    bcppl: Callable[..., Ran], tmp_path: Path
) -> None:
    recording = short(1)
    part = replace(recording.part, name="tray $5 {a and $6 \x1b]0;owned\x07")
    save(replace(recording, part=part), tmp_path / "dollar.h5")
    ran = bcppl("run", "dollar.h5", "--particles", 4, "--inference", FEW_MOVES, "--out", "o/[red]y")
    assert ran.code == 0, ran.err
    assert "o/[red]y" in ran.out and "\x1b]" not in ran.out
    assert (tmp_path / "o/[red]y/report.html").exists()


MANY = """
import pyro
import torch
from pyro.distributions import Categorical, Normal
from bcppl import poses
from bcppl.distributions.poses import NormalPose
from bcppl.models import point_probe
from bcppl.sensors.scene import Scene
from bcppl.traces import Model

def many(scene, actions):
    pyro.sample("slot", Categorical(torch.tensor([0.1, 0.3, 0.6])))
    pyro.sample("wear/mm", Normal(torch.tensor([0.25, -4.0]), torch.tensor([0.1, 2.0])).to_event(1))
    turned = torch.tensor([0.1, 0.0, -0.2, 0.0, 0.0, 0.0, 1.0], dtype=torch.float64)
    spread = torch.tensor([0.001] * 3 + [0.01] * 3, dtype=torch.float64)
    pyro.sample("grip", NormalPose(turned, spread))
    point_probe.point_probe(scene, actions)

model = Model(program=many, prepare=point_probe.prepare, observe=Scene.observed, pose="part")
"""


def test_every_latent_site_comes_out(bcppl: Callable[..., Ran], tmp_path: Path) -> None:
    (tmp_path / "many.py").write_text(MANY)
    save(short(1), tmp_path / "short.h5")
    words = ("--particles", 8, "--inference", FEW_MOVES, "--out", "out")
    ran = bcppl("run", "short.h5", "--model", "many.py", *words)
    assert ran.code == 0, ran.err
    path = tmp_path / "out/belief_001.h5"
    belief, values = load_belief(path), load_latent(path)
    assert set(values) == {"part", "slot", "wear/mm", "grip"}
    assert torch.equal(values["part"], belief.world_from_part)
    record = json.loads((tmp_path / "out/run.json").read_text())["latent"]

    weights, slot = belief.weights.numpy(), values["slot"].numpy()
    shares = {k: float(weights[slot == k].sum()) for k in range(3) if (slot == k).any()}
    ordered = sorted(shares.items(), key=lambda pair: -pair[1])
    assert record["slot"]["values"] == [k for k, _ in ordered]
    assert record["slot"]["probabilities"] == pytest.approx([share for _, share in ordered])
    assert ", ".join(f"{k}: {100 * share:.1f} %" for k, share in ordered) in ran.out

    wear = values["wear/mm"].numpy()
    assert record["wear/mm"]["mean"] == pytest.approx(weights @ wear)
    for k in range(2):
        low, high = record["wear/mm"]["from"][k], record["wear/mm"]["to"][k]
        assert low <= record["wear/mm"]["mean"][k] <= high
        assert weights[wear[:, k] < low].sum() <= 0.05 and weights[wear[:, k] > high].sum() <= 0.05
        assert f"wear/mm[{k}]" in ran.out and f"{low:.4g} to {high:.4g}" in ran.out

    grip = Belief(values["grip"], belief.log_weights)
    assert record["grip"]["mean"] == pytest.approx(grip.mean.tolist())
    assert record["grip"]["spread"] == pytest.approx(grip.spread.tolist())
    assert " ".join(f"{1e3 * x:.3f}" for x in grip.mean[:3].tolist()) + " mm" in ran.out
    assert "empty" not in ran.out  # a column without numbers needs no words


@pytest.mark.long
def test_a_model_of_the_pose_alone_prints_no_other_sites(bcppl: Callable[..., Ran], tmp_path: Path) -> None:
    for name, truth in (("known", short(1).truth), ("unknown", None)):
        save(dataclasses.replace(short(1), truth=truth), tmp_path / f"{name}.h5")
        ran = bcppl("run", f"{name}.h5", "--particles", 4, "--inference", FEW_MOVES)
        assert ran.code == 0 and "other latent values" not in ran.out
        assert "empty" not in ran.out
    path = tmp_path / "runs/known/belief_001.h5"
    with h5py.File(path, "r+") as file:
        del file["latent"]  # as earlier versions wrote it
    assert len(load_belief(path)) == 4
    with pytest.raises(InputError, match="the pose alone"):
        load_latent(path)


def test_what_cannot_be_run_or_simulated_is_refused(bcppl: Callable[..., Ran]) -> None:
    ran = bcppl("simulate", "part_in_view")
    assert ran.code == 2 and "camera_error, grasped_peg, look_and_touch, peg_in_hole" in ran.err
    for name in ("arm_in_view", str(PROBE.with_name("arm_in_view.py"))):
        ran = bcppl("run", SHIPPED, "--model", name)
        assert ran.code == 2 and "help(bcppl.models.arm_in_view)" in ran.err, ran.err
        assert len(ran.err.strip().splitlines()) == 1
    assert "no model 'arm'" in bcppl("run", SHIPPED, "--model", "arm").err
    assert "names no device" in bcppl("run", SHIPPED, "--device", "abacus").err


def test_the_bar_names_the_measurement_in_progress() -> None:
    assert [next_label(short(3), taken) for taken in range(1, 5)] == ["push 1", "push 2", "push 3", "push 3"]


@pytest.mark.long
def test_a_run_keeps_its_warnings_and_explains_touches(bcppl: Callable[..., Ran], tmp_path: Path) -> None:
    """Pushes of a finger have no peg that could be turned: no hypothesis is compared, which is stated."""
    save(short(1), tmp_path / "short.h5")
    ran = bcppl("run", "short.h5", "--particles", 20, "--out", "out", "--explain")
    assert ran.code == 0
    assert "no other hypothesis explains the touches" in " ".join(ran.out.split())
    record = json.loads((tmp_path / "out/run.json").read_text())
    assert record["explanations"] == [] and isinstance(record["warnings"], list)


@pytest.mark.long
def test_settings_of_the_model_reach_the_run_and_the_next_probe(
    bcppl: Callable[..., Ran], tmp_path: Path
) -> None:
    """A finger that is off by a centimetre puts the part a centimetre elsewhere."""
    save(short(3), tmp_path / "short.h5")

    def mean(folder: str, *options: object) -> np.ndarray:
        ran = bcppl("run", "short.h5", "--particles", 50, "--out", folder, *options)
        assert ran.code == 0
        return load_belief(tmp_path / folder / "belief_003.h5").mean.numpy()

    plain, off = mean("plain"), mean("off", "--set", "offset=0.01")
    assert np.linalg.norm(plain[:2] - off[:2]) > 0.003
    assert json.loads((tmp_path / "off/run.json").read_text())["settings"] == {"offset": 0.01}
    # What run.json holds is what a probe of the run's belief is given.
    path = tmp_path / "off/run.json"
    path.write_text(path.read_text().replace('"offset"', '"offest"'))
    ran = bcppl("probe", "off/belief_003.h5")
    assert ran.code == 2 and "has no setting 'offest'" in ran.err


REFUSED = {
    "x": "give a setting's name and value",
    "offest=0.1": "has no setting 'offest'; its settings are ",
    "outlier=2": "outlier",
    "offset=near": "setting 'offset' of point_probe is given 'near'",
    "offset=[0.1]": "setting 'offset' of point_probe is given [0.1]",
}


@pytest.mark.parametrize("setting", REFUSED)
def test_a_setting_that_cannot_be_is_refused(setting: str, bcppl: Callable[..., Ran], tmp_path: Path) -> None:
    save(short(1), tmp_path / "short.h5")
    ran = bcppl("run", "short.h5", "--set", setting, "--out", "out")
    assert ran.code == 2 and "Traceback" not in ran.err
    assert REFUSED[setting] in ran.err and len(ran.err.strip().splitlines()) == 1


@pytest.mark.long
def test_a_model_without_settings_is_given_none(bcppl: Callable[..., Ran], tmp_path: Path) -> None:
    save(short(1), tmp_path / "short.h5")
    (tmp_path / "plain.py").write_text(
        "from dataclasses import replace\n"
        "from bcppl.models.point_probe import model as shipped\n"
        "def prepare(recording):\n"
        "    return shipped.prepare(recording)\n"
        "model = replace(shipped, prepare=prepare)\n"
    )
    words = ("run", "short.h5", "--particles", 20, "--model", "plain.py", "--out", "out")
    assert bcppl(*words).code == 0
    ran = bcppl(*words, "--set", "offset=0.01")
    assert (
        ran.code == 2 and "model plain.py takes no setting 'offset': its `prepare` is called with" in ran.err
    )
    (tmp_path / "own.py").write_text(
        (tmp_path / "plain.py").read_text().replace("(recording):", "(recording, spread=1):")
    )
    ran = bcppl(*words, "--model", "own.py", "--set", "spred=0.01")
    assert ran.code == 2 and "model own.py takes no setting 'spred': it has spread." in ran.err
