"""Files of actions: plans, views and other candidates that an arm carries out, as HDF5 (.h5) or JSON.

Both hold the same, a list of actions in SI units, frames in the names (schema version 1):

    format, schema_version    "bcppl actions", 1
    actions                   a list; in HDF5 a group actions/000000.. with one group for each
    kind                      of each action, such as "plan" or "view": its fields are those of the layout
                              of that kind's candidates (see `bcppl.sensors.probe`, `bcppl.sensors.depth`)

The JSON also holds its units, and a description of the numbers (`about`); neither is read again. Numbers
come back bit for bit from either.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py

from bcppl.arguments import whole_number
from bcppl.errors import InputError
from bcppl.recordings.hdf5 import created, opened, replacing
from bcppl.sensors.candidates import Candidate, planner_of
from bcppl.sensors.layout import Layout
from bcppl.sensors.protocol import Plannable, sensors
from bcppl.untrusted import strict_json

FORMAT = "bcppl actions"
SCHEMA_VERSION = 1
SUFFIXES = (".h5", ".json")


def save_actions(actions: Sequence[Candidate], path: str | os.PathLike[str]) -> None:
    """Write actions to a file, whole or not at all.

    Raises:
        InputError: the file's name ends in neither .h5 nor .json, it cannot be written, or an action is of
            a kind that cannot be planned.
    """
    path = Path(path)
    _refuse_suffix(path)
    if path.suffix == ".json":
        with replacing(path) as beside:
            beside.write_text(json.dumps(_tree(actions), indent=1) + "\n", encoding="utf-8")
        return
    with created(path) as file:
        file.attrs.update(format=FORMAT, schema_version=SCHEMA_VERSION)
        file.create_group("actions")
        for k, action in enumerate(actions):
            group, planner = file.create_group(f"actions/{k:06d}"), planner_of(action)
            group.attrs["kind"] = planner.candidate_kind
            planner.candidate.write(group, action)


def load_actions(path: str | os.PathLike[str]) -> list[Candidate]:
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
        raise InputError(f"files of actions end in {' or '.join(SUFFIXES)}, not {path.name}; rename it.")


def _refuse_header(path: Path, header: Mapping[str, Any]) -> None:
    if header.get("format", FORMAT) != FORMAT:
        raise InputError(
            f"{path} holds a {str(header['format'])[:40]}, no actions; give a file of plans and views."
        )
    version = whole_number(f"{path} has schema_version {{}}", header.get("schema_version", SCHEMA_VERSION))
    if version > SCHEMA_VERSION:
        raise InputError(f"{path} was written by a later bcppl (schema {version}); upgrade bcppl.")


def _planners() -> dict[str, Plannable]:
    return {each.candidate_kind: each for each in sensors() if isinstance(each, Plannable)}


def _read(kind: object, what: str, source: h5py.Group | Mapping[str, Any]) -> Candidate:
    """One action; all that is wrong with it is one sentence that begins with `what`."""
    known = _planners()
    if not isinstance(kind, str) or kind not in known:
        words = ", ".join(f'"{each}"' for each in known)
        raise InputError(f"{what} is of kind {str(kind)[:40]!r}; give one of {words}.")
    layout = known[kind].candidate
    try:
        return layout.read(source) if isinstance(source, h5py.Group) else _of_fields(source, layout)
    except InputError as error:
        raise InputError(f"{what}: {error}") from None
    except KeyError as error:
        raise InputError(f"{what} lacks {error.args[0]!r}; add it.") from error
    except (TypeError, ValueError) as error:
        raise InputError(f"{what} cannot be read ({error}); write numbers in SI units.") from error


# ---- JSON


def _tree(actions: Sequence[Candidate]) -> dict[str, Any]:
    layouts = [planner.candidate for planner in _planners().values()]
    planned = [(planner_of(action), action) for action in actions]
    return {
        "format": FORMAT,
        "schema_version": SCHEMA_VERSION,
        "about": " ".join(layout.about for layout in layouts if layout.about),
        "units": {key: units for layout in layouts for key, units in layout.units.items()},
        "actions": [{"kind": p.candidate_kind, **p.candidate.tree(each)} for p, each in planned],
    }


def _from_json(path: Path) -> list[Candidate]:
    tree = strict_json.read(path, "write it again")
    if not isinstance(tree, dict) or not isinstance(tree.get("actions"), list):
        raise InputError(f'{path} holds no list of "actions"; see `bcppl.recordings.action_file` for one.')
    _refuse_header(path, tree)

    entries = [dict(entry) if isinstance(entry, dict) else {} for entry in tree["actions"]]
    return [_read(e.pop("kind", None), f"action {k} of {path}", e) for k, e in enumerate(entries)]


def _of_fields(fields: Mapping[str, Any], layout: Layout[Any]) -> Candidate:
    known = [layout.key(name) for name in layout.fields]
    if unknown := ", ".join(map(repr, sorted(set(fields) - set(known)))):
        raise InputError(
            f"a {layout.type.__name__} has no field {unknown}; its fields are {', '.join(known)}."
        )
    return layout.parsed(fields)


# ---- HDF5


def _from_hdf5(path: Path) -> list[Candidate]:
    with opened(path, "make it again") as file:
        header = dict(file.attrs)
        if "format" not in header:
            raise InputError(f"{path} is an HDF5 file but holds no actions; give one of plans and views.")
        _refuse_header(path, header)
        entries = [file["actions"][f"{k:06d}"] for k in range(len(file["actions"]))]
        return [_read(e.attrs.get("kind"), f"action {k} of {path}", e) for k, e in enumerate(entries)]
