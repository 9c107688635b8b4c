"""Plans and views on disk: what an arm is asked to do, as HDF5 (.h5) or as JSON (.json).

Both hold the same, a list of actions in SI units, frames in the names (schema version 1):

    format, schema_version    "bcppl actions", 1
    actions                   a list; in HDF5 a group actions/000000.. with one group for each

    kind "plan"   name; times (K), world_from_peg (K, 7), manners (K - 1), force, stiffness (6), damping (6),
                  rate, sink: the fields of `bcppl.robot.plan.Plan`; rate and sink may be left out
    kind "view"   name; width, height, fx, fy, cx, cy, near, far, world_from_camera (7): a camera, as in a
                  recording; distortion, wrist_from_camera (7) and device where there is one

The JSON also says its units, and in words (`about`) what the numbers are; neither is read again. Numbers
come back bit for bit from either.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from bcppl import poses
from bcppl.arguments import whole_number
from bcppl.errors import InputError
from bcppl.geometry.camera import Camera
from bcppl.recordings.cameras import INTRINSICS, RANGE, read_camera, write_camera
from bcppl.recordings.datasets import POSE_UNITS, array, number, put
from bcppl.robot.plan import Plan
from bcppl.sensors.measurements import View

FORMAT = "bcppl actions"
SCHEMA_VERSION = 1
SUFFIXES = (".h5", ".json")
ABOUT = (
    "Poses are x y z qw qx qy qz in the world; world_from_peg is the peg's frame, its tip at its lowest z. "
    "manners[k] is how pose k is left for pose k + 1, from times[k] to times[k + 1]: free (as commanded), "
    "guarded (until a force of `force` is felt; the way that was left then stays undone), held (pressed on, "
    "as planned but for that way) or searching (held, until the peg has sunk by `sink`). stiffness, damping "
    "are of the arm along, then about, the commanded peg's axes; rate is of what is measured."
)

_PLAN_UNITS = {
    "times": "s",
    "world_from_peg": POSE_UNITS,
    "force": "N",
    "stiffness": "N/m N/m N/m N m/rad N m/rad N m/rad",
    "damping": "N s/m N s/m N s/m N m s/rad N m s/rad N m s/rad",
    "rate": "1/s",
    "sink": "m",
}
_MAY_LACK = ("rate", "sink")
_PLAN_KEYS = ("kind", "name", "manners", *_PLAN_UNITS)
_VIEW_KEYS = (
    *("kind", "name", "world_from_camera", *INTRINSICS, *RANGE),
    *("distortion", "wrist_from_camera", "device"),
)

_CAMERA_KEYS = {"world_from_camera", *INTRINSICS, *RANGE}
_UNITS = {
    **_PLAN_UNITS,
    **INTRINSICS,
    **RANGE,
    "world_from_camera": POSE_UNITS,
    "wrist_from_camera": POSE_UNITS,
}

Action = Plan | View


def save_actions(actions: Sequence[Action], path: str | os.PathLike[str]) -> None:
    """Write actions to a file, whole or not at all.

    Raises:
        InputError: the file's name ends in neither .h5 nor .json, or it cannot be written.
    """
    path = Path(path)
    _refuse_suffix(path)
    if not path.parent.is_dir():
        raise InputError(f"{path} cannot be written: there is no folder {path.parent}; make it first.")
    unfinished = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        if path.suffix == ".json":
            tree = {
                "format": FORMAT,
                "schema_version": SCHEMA_VERSION,
                "about": ABOUT,
                "units": _UNITS,
                "actions": [_tree_of(action) for action in actions],
            }
            unfinished.write_text(json.dumps(tree, indent=1) + "\n", encoding="utf-8")
        else:
            with h5py.File(unfinished, "w") as file:
                file.attrs.update(format=FORMAT, schema_version=SCHEMA_VERSION)
                file.create_group("actions")
                for k, action in enumerate(actions):
                    _write(file.create_group(f"actions/{k:06d}"), action)
        os.replace(unfinished, path)
    except (OSError, ValueError) as error:
        raise InputError(f"{path} cannot be written: {error}.") from error
    finally:
        # What could not be made, such as a name that is too long, cannot be removed either.
        with suppress(OSError, ValueError):
            unfinished.unlink(missing_ok=True)


def load_actions(path: str | os.PathLike[str]) -> list[Action]:
    """Read actions that `save_actions` wrote, or that somebody wrote by hand as JSON.

    Raises:
        InputError: there is no such file, it holds no actions, or one of them lacks something or is none.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"there is no file of actions {path}; give one ending in {' or '.join(SUFFIXES)}.")
    _refuse_suffix(path)
    return _from_json(path) if path.suffix == ".json" else _from_hdf5(path)


def _refuse_suffix(path: Path) -> None:
    if path.suffix not in SUFFIXES:
        raise InputError(
            f"actions are kept in files that end in {' or '.join(SUFFIXES)}, not {path.name}; rename it."
        )


def _refuse_header(path: Path, header: Mapping[str, Any]) -> None:
    if header.get("format", FORMAT) != FORMAT:
        raise InputError(f"{path} holds a {header['format']}, no actions; give a file of plans and views.")
    version = whole_number(f"{path} has schema_version {{}}", header.get("schema_version", SCHEMA_VERSION))
    if version > SCHEMA_VERSION:
        raise InputError(f"{path} was written by a later bcppl (schema {version}); upgrade bcppl.")


# ---- JSON


def _tree_of(action: Action) -> dict[str, Any]:
    if isinstance(action, Plan):
        named: dict[str, Any] = {"kind": "plan", "name": action.name, "manners": list(action.manners)}
        return named | {name: np.asarray(getattr(action, name)).tolist() for name in _PLAN_UNITS}
    camera = action.camera
    tree: dict[str, Any] = {"kind": "view", "name": camera.name}
    for name in ("world_from_camera", *INTRINSICS, *RANGE):
        tree[name] = np.asarray(getattr(camera, name)).tolist()
    if camera.distortion:
        tree["distortion"] = list(camera.distortion)
    if camera.wrist_from_camera is not None:
        tree["wrist_from_camera"] = np.asarray(camera.wrist_from_camera).tolist()
    return tree | ({"device": camera.device} if camera.device else {})


def _from_json(path: Path) -> list[Action]:
    try:
        tree = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path} is no valid JSON ({error}); write it again.") from error
    if not isinstance(tree, dict) or not isinstance(tree.get("actions"), list):
        raise InputError(f'{path} holds no list of "actions"; see `bcppl.recordings.action_file` for one.')
    _refuse_header(path, tree)
    return [_action_of(entry, f"action {k} of {path}") for k, entry in enumerate(tree["actions"])]


def _action_of(entry: Any, what: str) -> Action:
    if not isinstance(entry, dict) or entry.get("kind") not in ("plan", "view"):
        raise InputError(f'{what} is neither of kind "plan" nor "view"; say which it is.')
    is_plan = entry["kind"] == "plan"
    unknown = set(entry) - set(_PLAN_KEYS if is_plan else _VIEW_KEYS)
    if unknown:
        raise InputError(
            f"{what} has {', '.join(map(repr, sorted(unknown)))}, which a {entry['kind']} does not have; its "
            f"fields are {', '.join(_PLAN_KEYS if is_plan else _VIEW_KEYS)}."
        )
    try:
        if is_plan:
            given = {n: np.array(entry[n], dtype=np.float64) for n in _PLAN_UNITS if n in entry}
            return _plan(str(entry["name"]), tuple(entry["manners"]), given)
        numbers = {n: entry[n] for n in (*INTRINSICS, *RANGE)}
        wrist = entry.get("wrist_from_camera")
        return _view(
            Camera(
                name=str(entry["name"]),
                world_from_camera=np.array(entry["world_from_camera"], dtype=np.float64),
                distortion=entry.get("distortion", ()),
                wrist_from_camera=None if wrist is None else np.array(wrist, dtype=np.float64),
                device=str(entry.get("device", "")),
                **numbers,
            )
        )
    except InputError as error:
        raise InputError(f"{what}: {error}") from None
    except KeyError as error:
        raise InputError(f"{what} lacks {error.args[0]!r}; add it.") from error
    except (TypeError, ValueError) as error:
        raise InputError(f"{what} holds what is no number ({error}); write numbers in SI units.") from error


def _view(camera: Camera) -> View:
    camera.stated_pose()
    if camera.wrist_from_camera is not None:
        poses.as_pose(camera.wrist_from_camera, f"the wrist_from_camera of {camera.name!r}")
    return View(camera)


def _plan(name: str, manners: tuple[Any, ...], given: Mapping[str, Any]) -> Plan:
    for needed in _PLAN_UNITS:
        if needed not in given and needed not in _MAY_LACK:
            raise KeyError(needed)
    values: dict[str, Any] = {n: float(v) if np.ndim(v) == 0 else v for n, v in given.items()}
    return Plan(name=name, manners=manners, **values)


# ---- HDF5


def _write(group: h5py.Group, action: Action) -> None:
    if isinstance(action, View):
        group.attrs.update(kind="view", name=action.camera.name)
        write_camera(group, action.camera)
        return
    group.attrs.update(kind="plan", name=action.name)
    # No attribute: those hold 64 KiB.
    group.create_dataset("manners", data=list(action.manners), dtype=h5py.string_dtype())
    for name, units in _PLAN_UNITS.items():
        put(group, name, getattr(action, name), units)


def _from_hdf5(path: Path) -> list[Action]:
    try:
        with h5py.File(path, "r") as file:
            header = dict(file.attrs)
            if "format" not in header:
                raise InputError(f"{path} is an HDF5 file but holds no actions; give one of plans and views.")
            _refuse_header(path, header)
            entries = file["actions"]
            if not isinstance(entries, h5py.Group):
                raise InputError(f"{path} has actions that are no group; make it again.")
            return [_read(entry, f"action {k} of {path}") for k, entry in enumerate(_sorted(entries))]
    except InputError:
        raise
    except KeyError as error:
        raise InputError(f"{path} lacks its group of actions; make it again.") from error
    except (OSError, TypeError, ValueError) as error:
        raise InputError(f"{path} is damaged or no HDF5 file ({error}); make it again.") from error


def _sorted(entries: h5py.Group) -> list[Any]:
    return [entry for _, entry in sorted(entries.items())]


def _read(entry: Any, what: str) -> Action:
    attributes = dict(entry.attrs) if isinstance(entry, h5py.Group) else {}
    if attributes.get("kind") not in ("plan", "view"):
        raise InputError(f'{what} is neither of kind "plan" nor "view"; say which it is.')
    is_plan = attributes["kind"] == "plan"
    lacking = {"manners", *_PLAN_UNITS} - {*_MAY_LACK, *entry} if is_plan else _CAMERA_KEYS - set(entry)
    if lacking or "name" not in attributes:
        raise InputError(f"{what} lacks {', '.join(map(repr, sorted(lacking or {'name'})))}; add it.")
    for name, value in entry.items():
        said = value.attrs.get("units") if isinstance(value, h5py.Dataset) else "a group"
        if said != (asked := _UNITS.get(name, said)):
            raise InputError(f"{what} has {name} in {said!r}; give a dataset in {asked!r}.")
    try:
        name = str(attributes["name"])
        if not is_plan:
            return _view(read_camera(name, entry))
        given = {
            each: number(entry, each) if entry[each].ndim == 0 else array(entry, each)
            for each in _PLAN_UNITS
            if each in entry
        }
        manners = entry["manners"].asstr()[()]
        return _plan(name, tuple(str(manner) for manner in manners), given)
    except InputError as error:
        raise InputError(f"{what}: {error}") from None
    except (TypeError, ValueError) as error:
        raise InputError(f"{what} holds what is no number ({error}); write numbers in SI units.") from error
