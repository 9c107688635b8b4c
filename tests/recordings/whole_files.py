"""Undamaged files of all kinds that bcppl reads, small, and the loader of each; see `damaged_files`."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from PIL import Image

from bcppl import Plan
from bcppl.beliefs import Belief
from bcppl.cli import posterior
from bcppl.errors import InputError
from bcppl.geometry.parts import load_mesh
from bcppl.inference import saved
from bcppl.inference.calibration import rounds
from bcppl.models.arm_calibration import read_seatings
from bcppl.poses import Freedom
from bcppl.recordings import describe, load, notes, problems, save
from bcppl.recordings.action_file import load_actions, save_actions
from bcppl.recordings.beliefs import load_belief, load_fingerprint, load_label, load_latent, save_belief
from bcppl.recordings.importers import bop, point_probe
from bcppl.robot.kinematics import Robot
from bcppl.sweeps import keep, kept
from tests.inference.saved.saved_programs import KEPT
from tests.made_recordings import full

MODELS = Path(__file__).parents[2] / "models"


@dataclass(frozen=True)
class Whole:
    """A file that is damaged, or lies beside the one that is.

    Attributes:
        kind: of the file, for tables.
        loader: of `LOADERS`, given `path`.
        path: what is loaded.
        form: of the damaged file: "hdf5", "json", "urdf", "mesh", "png", "numbers", "npz".
        damaged_path: the file that is damaged.
        checked: "all" where any change of content is noticed, "bytes" where it is unless HDF5 made it.
    """

    kind: str
    loader: str
    path: Path
    form: str
    damaged_path: Path
    checked: str = ""


def _recording(path: Path) -> Any:
    loaded = load(path)
    describe(loaded)
    notes(loaded)
    for problem in problems(loaded):
        raise InputError(f"{path}: {problem}")
    return loaded


def _belief(path: Path) -> Any:
    return [load_label(path), load_belief(path), load_latent(path), load_fingerprint(path)]


def _population(path: Path) -> Any:
    population = saved.load(path, KEPT["groups"].program)
    return [dict(population.trace.choices), population.log_weights, population.log_evidence]


def _robot(path: Path) -> Any:
    robot = Robot(path, tip="hand")
    angles = torch.zeros(len(robot.joints), dtype=torch.float64)
    part = robot.as_part(angles)
    return [robot.base_from_link("hand", angles), part.vertices, part.faces]


LOADERS: dict[str, Callable[[Path], Any]] = {
    "recording": _recording,
    "belief": _belief,
    "population": _population,
    "actions": load_actions,
    "bop": lambda path: bop.command(path, 1),
    "log": lambda path: point_probe.command([path], pushes=1),
    "mesh": load_mesh,
    "robot": _robot,
    "run.json": lambda path: posterior.run_record(path / "belief_000.h5"),
    "seatings": read_seatings,
    "round": rounds.kept,
    "sweep": kept,
}


def whole_files(folder: Path) -> list[Whole]:
    """Write one file of every kind into a folder."""
    made = [
        _native("shipped recording", "recording", folder / "shipped.h5", "", _copied("peg_probe")),
        _native("shipped pushes", "recording", folder / "pushes.h5", "", _copied("point_probe_10_pushes")),
        _native("recording", "recording", folder / "saved.h5", "all", lambda path: save(full(), path)),
        _native("belief", "belief", folder / "belief.h5", "bytes", _save_belief),
        _native("population", "population", folder / "population.h5", "all", _save_population),
        _native("actions", "actions", folder / "actions.h5", "bytes", _save_plans),
        *_text(folder),
        *_scene(folder / "scene"),
        *_meshes(folder),
    ]
    return made


def _native(kind: str, loader: str, path: Path, checked: str, write: Callable[[Path], Any]) -> Whole:
    write(path)
    return Whole(kind, loader, path, "hdf5", path, checked)


def _copied(name: str) -> Callable[[Path], Any]:
    return lambda path: shutil.copy(MODELS / f"recordings/{name}.h5", path)


def _save_belief(path: Path) -> None:
    torch.manual_seed(0)
    poses = torch.zeros(50, 7, dtype=torch.float64)
    poses[:, :3], poses[:, 3] = torch.randn(50, 3).double(), 1.0
    belief = Belief(poses, torch.randn(50).double(), Freedom())
    latent = {"hole": poses, "bias": torch.randn(50, 2).double(), "a/b": torch.arange(50)}
    state = torch.get_rng_state()
    save_belief(belief, path, label="view 1", log_evidence=-3.5, random_state=state, latent=latent, of="2:ab")


def _save_population(path: Path) -> None:
    saved.save(KEPT["groups"].begun(0), path)


def _save_plans(path: Path) -> None:
    poses = np.array([[0.0, 0.0, z, 1.0, 0.0, 0.0, 0.0] for z in (0.2, 0.1)])
    stiffness, damping = np.array([2500.0] * 3 + [150.0] * 3), np.array([120.0] * 3 + [2.5] * 3)
    plan = {"times": np.array([0.0, 2.0]), "world_from_peg": poses, "manners": ("guarded",), "force": 4.0}
    save_actions([Plan(name=n, **plan, stiffness=stiffness, damping=damping) for n in ("down", "on")], path)


def _text(folder: Path) -> list[Whole]:
    _save_plans(folder / "actions.json")
    run = folder / "run"
    run.mkdir()
    record = {
        "recording": "peg_probe",
        "model": "look_and_touch",
        "settings": {"profile": "ur5e"},
        "rows": [],
    }
    (run / "run.json").write_text(json.dumps(record, indent=1))
    seatings = folder / "seatings"
    seatings.mkdir()
    angles = np.random.default_rng(0).normal(size=(20, 7))
    np.savetxt(seatings / "hole_0.csv", angles, delimiter=",")
    rounds.keep(folder / "round.npz", {"ranks": np.arange(50.0), "values": angles})
    for cell in range(5):
        keep(folder / "sweep.jsonl", {"seed": cell}, {"add": 0.1 * cell, "name": "a"})
    rows = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]
    forces = [[0.01 * k, 0.1 if k < 20 else 2.0, 0.0] for k in range(60)]
    tips = [[0.01 * k, 100.0 - k, 0.0, 10.0, 1.0, 0.0, 0.0, 0.0] for k in range(70)]
    numbers = [1, *rows, *rows, 60, *np.ravel(forces), 70, *np.ravel(tips)]
    (folder / "log.txt").write_text(" ".join(f"{number:g}" for number in numbers))
    return [
        Whole("actions.json", "actions", folder / "actions.json", "json", folder / "actions.json"),
        Whole("run.json", "run.json", run, "json", run / "run.json"),
        Whole("sweep", "sweep", folder / "sweep.jsonl", "json", folder / "sweep.jsonl"),
        Whole("seatings", "seatings", seatings, "numbers", seatings / "hole_0.csv"),
        Whole("push log", "log", folder / "log.txt", "numbers", folder / "log.txt"),
        Whole("round", "round", folder / "round.npz", "npz", folder / "round.npz", "all"),
    ]


def _scene(folder: Path) -> list[Whole]:
    (folder / "models_eval").mkdir(parents=True)
    rng = np.random.default_rng(0)
    depth = (800 + rng.integers(0, 30, (48, 64))).astype(np.uint16)
    Image.fromarray(depth).save(folder / "depth_000003.png")
    Image.fromarray(rng.integers(0, 255, (48, 64, 3)).astype(np.uint8)).save(folder / "rgb_000003.png")
    k = [60.0, 0.0, 32.0, 0.0, 60.0, 24.0, 0.0, 0.0, 1.0]
    (folder / "camera.json").write_text(json.dumps({"cam_K": k, "depth_scale": 1.0}))
    entry = {"obj_id": 1, "cam_R_m2c": np.eye(3).ravel().tolist(), "cam_t_m2c": [0.0, 10.0, 800.0]}
    (folder / "scene_gt.json").write_text(json.dumps({"3": [entry, {**entry, "obj_id": 5}]}))
    mesh = trimesh.creation.icosphere(2, 50.0)
    mesh.export(folder / "models_eval/obj_000001.ply")
    return [
        Whole("BOP truth", "bop", folder, "json", folder / "scene_gt.json"),
        Whole("BOP camera", "bop", folder, "json", folder / "camera.json"),
        Whole("BOP depth", "bop", folder, "png", folder / "depth_000003.png", "all"),
        Whole("BOP colour", "bop", folder, "png", folder / "rgb_000003.png", "all"),
        Whole("BOP mesh", "bop", folder, "mesh", folder / "models_eval/obj_000001.ply"),
    ]


URDF = """<?xml version="1.0"?>
<robot name="arm"><link name="base"><visual><origin xyz="0 0 0.1" rpy="0 0 0"/><geometry>
<mesh filename="finger.stl" scale="1 1 1"/></geometry></visual></link>
<link name="arm"><visual><geometry><cylinder radius="0.05" length="0.3"/></geometry></visual></link>
<link name="hand"><visual><geometry><sphere radius="0.05"/></geometry></visual><visual><geometry>
<box size="0.1 0.2 0.1"/></geometry></visual></link>
<joint name="shoulder" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 0 1"/>
<origin xyz="0 0 0.2" rpy="0 0.1 0"/><limit lower="-2" upper="2" effort="1" velocity="1"/></joint>
<joint name="elbow" type="prismatic"><parent link="arm"/><child link="hand"/><axis xyz="0 0 1"/>
<limit lower="-0.2" upper="0.2" effort="1" velocity="1"/></joint></robot>
"""


def _meshes(folder: Path) -> list[Whole]:
    part = trimesh.creation.annulus(0.02, 0.05, 0.03)
    for suffix in ("obj", "stl", "ply"):
        part.export(folder / f"ring.{suffix}")
    part.export(folder / "text.stl", file_type="stl_ascii")
    robot = folder / "robot"
    robot.mkdir()
    shutil.copy(MODELS / "robots/panda/meshes/finger.stl", robot / "finger.stl")
    (robot / "arm.urdf").write_text(URDF)
    meshes = [folder / name for name in ("ring.obj", "ring.stl", "ring.ply", "text.stl")]
    return [
        *(Whole(f"mesh {path.name}", "mesh", path, "mesh", path) for path in meshes),
        Whole("URDF", "robot", robot / "arm.urdf", "urdf", robot / "arm.urdf"),
        Whole("URDF's mesh", "robot", robot / "arm.urdf", "mesh", robot / "finger.stl"),
    ]
