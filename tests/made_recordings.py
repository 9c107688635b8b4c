"""Recordings simulated for tests, and how two are compared."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import trimesh

from bcppl.geometry.camera import Camera
from bcppl.geometry.parts import Part, Piece
from bcppl.recordings import (
    DepthImage,
    Guess,
    Measurement,
    Probe,
    ProbeWindow,
    Push,
    Recording,
    Touch,
    View,
)

HALF = math.sqrt(0.5)


def block(name: str, side: float = 0.1) -> Part:
    mesh = trimesh.creation.box((side, 0.8 * side, 0.3 * side))
    pieces = (
        Piece("box", np.array([0.05, 0.04, 0.015])),
        Piece("hull", np.asarray(mesh.vertices), np.ones(3)),
    )
    return Part(name, np.asarray(mesh.vertices), np.asarray(mesh.faces, dtype=np.int64), pieces, "made here")


def poses(rows: int, rng: np.random.Generator) -> Any:
    quaternion = rng.normal(size=(rows, 4))
    quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
    return np.concatenate([rng.normal(scale=0.1, size=(rows, 3)), quaternion], axis=1)


def camera(name: str, height: float = 0.5) -> Camera:
    return Camera(name, 8, 6, 9.0, 9.5, 3.7, 2.4, np.array([0.0, 0, height, 0, 1, 0, 0]), 0.06, 4.0)


def depth(rng: np.random.Generator) -> Any:
    image = rng.uniform(0.3, 0.6, (6, 8)).astype(np.float32).astype(np.float64)
    image[1, 2] = np.nan
    return image


def probe(name: str, rng: np.random.Generator) -> Probe:
    return Probe(
        name,
        np.linspace(0, 1, 5),
        poses(5, rng),
        rng.uniform(1, 9, 6),
        rng.uniform(1, 9, 6),
        np.arange(20) * 0.05,
    )


def touch(times: Any, rng: np.random.Generator, held: bool = True) -> Touch:
    return Touch(times, rng.normal(size=(len(times), 6)), poses(len(times) if held else 0, rng))


def full(seed: int = 0) -> Recording:
    """A recording with something of everything."""
    rng = np.random.default_rng(seed)
    left, right = camera("left"), camera("wrist/right.2", 0.6)
    slide, press = probe("slide", rng), probe("press", rng)
    times = np.cumsum(rng.uniform(0.01, 0.02, 400))
    windows = [
        Measurement(ProbeWindow(p, a, b), touch(p.stamps[a:b], rng))
        for p, a, b in ((slide, 0, 7), (press, 0, 9), (slide, 7, 20))
    ]
    colour = rng.integers(0, 255, (6, 8, 3)).astype(np.uint8)
    views = [
        Measurement(View(c), DepthImage(depth(rng), rgb))
        for c, rgb in ((left, colour), (right, None), (left, None))
    ]
    push = Measurement(Push(times[::3], poses(len(times[::3]), rng)), touch(times, rng, held=False))
    return Recording(
        part=block("block"),
        guess=Guess(np.array([0.01, 0.02, 0, HALF, 0, 0, HALF]), np.array([0.02, 0.01, 0.0]), 0.1, 0.3, 0.2),
        measurements=[views[0], windows[0], views[1], push, windows[1], windows[2], views[2]],
        peg=block("peg", 0.02),
        background={"left": depth(rng)},
        truth=np.array([0.012, 0.018, 0, HALF, 0, 0, HALF]),
        model="peg_in_hole",
        source="nowhere, ©",
    )


def assert_identical(first: Any, second: Any, where: str = "recording") -> None:
    """Equal to the last bit, all the way down."""
    if dataclasses.is_dataclass(first):
        assert type(first) is type(second), where
        for field in dataclasses.fields(first):
            assert_identical(getattr(first, field.name), getattr(second, field.name), f"{where}.{field.name}")
    elif isinstance(first, np.ndarray):
        assert first.dtype == second.dtype and first.shape == second.shape, where
        assert first.tobytes() == second.tobytes(), where
    elif isinstance(first, Mapping):
        assert first.keys() == second.keys(), where
        for key in first:
            assert_identical(first[key], second[key], f"{where}[{key!r}]")
    elif isinstance(first, Sequence) and not isinstance(first, str):
        assert len(first) == len(second), where
        for k, (ours, theirs) in enumerate(zip(first, second, strict=True)):
            assert_identical(ours, theirs, f"{where}[{k}]")
    else:
        assert first == second and type(first) is type(second), where


def assert_one_sentence(text: str) -> None:
    assert "\n" not in text and text.endswith(".") and ". " not in text.rstrip("."), text
