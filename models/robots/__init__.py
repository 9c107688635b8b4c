"""Shipped robots: the Franka Emika Panda with its hand, and the KUKA LBR iiwa 14."""

from __future__ import annotations

import importlib.resources
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal

from bcppl.errors import InputError
from bcppl.robot.kinematics import Robot

SHIPPED = ("iiwa", "panda")


def load_robot(
    name: str | Path,
    tip: str | None = None,
    held: Mapping[str, float] | None = None,
    geometry: Literal["visual", "collision"] = "visual",
    mesh_folders: str | Path | Sequence[str | Path] = (),
) -> Robot:
    """A shipped robot by name, or any other by its URDF file.

    Args:
        name: "panda" (7 joints and the gripper's; tip "panda_hand_tcp" for the 7) or "iiwa" (7 joints; its
            flange is "lbr_iiwa_flange"), or the path of a URDF file.
        tip: a link; joints outside the chain from the base to it are fixed.
        held: values of fixed joints.
        geometry: which of the links' shapes are drawn.
        mesh_folders: folders of meshes; all four as in `bcppl.robot.kinematics.Robot`.

    Raises:
        InputError: there is neither a shipped robot nor a file of that name, or as for `Robot`.
    """
    if name in SHIPPED:
        with importlib.resources.as_file(importlib.resources.files(__name__).joinpath(str(name))) as folder:
            return Robot(folder / f"{name}.urdf", tip, held, geometry, mesh_folders)
    if not Path(name).is_file():
        raise InputError(f"{name} is no URDF file and no shipped robot; shipped are {', '.join(SHIPPED)}.")
    return Robot(name, tip, held, geometry, mesh_folders)
