"""The recordings that come with bcppl, and those that a model's own world simulates."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from importlib import import_module
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any

from bcppl.errors import InputError
from bcppl.recordings import Recording, load


def load_recording(name: str | Path) -> Recording:
    """A shipped recording by its name, or any other by its file.

    Args:
        name: "peg_probe", "point_probe_10_pushes", "arm_view", or the path of a recording (.h5).

    Raises:
        InputError: there is neither a shipped recording nor a file of that name, or it cannot be read.
    """
    path = Path(name)
    if path.exists() or path.suffix:
        return load(path)
    shipped = files("bcppl.models") / "recordings"
    names = sorted(p.name.removesuffix(".h5") for p in shipped.iterdir() if p.name.endswith(".h5"))
    if name not in names:
        raise InputError(f"there is no recording {str(name)!r}: give a file, or one of {', '.join(names)}.")
    with as_file(shipped / f"{name}.h5") as file:
        return load(file)


def simulated_in(world: str) -> Callable[..., Recording]:
    """The `simulate_recording` of a module of `bcppl.models.worlds`, which is imported when it is called."""
    return partial(_simulated, world)  # a closure could not be sent to another process


def _simulated(world: str, seed: int, **options: Any) -> Recording:
    module: Any = import_module(f"bcppl.models.worlds.{world}")
    recording: Recording = module.simulate_recording(seed, **options)
    return recording
