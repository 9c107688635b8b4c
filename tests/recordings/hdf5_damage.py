"""Damage to the structure of an HDF5 file, made by h5py: what a mistaken or hostile program could write."""

from __future__ import annotations

import functools
import random
import zlib
from pathlib import Path
from typing import Any

import h5py
import numpy as np

BOMB = 100 << 20  # bytes that a bomb inflates to


@functools.cache
def zeros() -> bytes:
    """A compressed stream of zeros."""
    return zlib.compress(bytes(BOMB), 9)


def _attributes(node: Any, old: Any) -> None:
    for name, value in old.items():
        node.attrs[name] = value


def edited(path: Path, rng: random.Random) -> tuple[str, str]:
    """Change one thing of a file in its place; what, and its rule (see `tests.recordings.damage`)."""
    with h5py.File(path, "r+") as file:
        names: list[str] = []
        file.visit(names.append)
        sets = [name for name in names if isinstance(file[name], h5py.Dataset)]
        name = rng.choice(rng.choice([names, sets]))
        kind = rng.choice(["links", "objects", "attributes", "numbers", "numbers", "claims"])
        if kind in ("numbers", "claims"):
            name = rng.choice(sets)
        deed = rng.choice(DEEDS[kind])
        rule = deed(file, name, rng)
        return f"{deed.__name__} {name}", rule


# ---- links


def external_link(file: h5py.File, name: str, rng: random.Random) -> str:
    other = Path(file.filename).with_name("elsewhere.h5")
    if not other.exists():
        with h5py.File(other, "w") as made:
            made["x"] = np.zeros(3)
    del file[name]
    file[name] = h5py.ExternalLink(str(other), "/x")
    return "refuse"


def soft_link(file: h5py.File, name: str, rng: random.Random) -> str:
    file.move(name, f"{name}_moved")
    file[name] = h5py.SoftLink(rng.choice([f"/{name}_moved", f"/{name}", "/nowhere"]))
    return "refuse"


def hard_cycle(file: h5py.File, name: str, rng: random.Random) -> str:
    group = file[name] if isinstance(file[name], h5py.Group) else file[name].parent
    group["again"] = file
    return "refuse"


# ---- objects


def removed(file: h5py.File, name: str, rng: random.Random) -> str:
    del file[name]
    return "free"


def renamed(file: h5py.File, name: str, rng: random.Random) -> str:
    parent, _, last = name.rpartition("/")
    free = parent in ("cameras", "probes", "background", "latent")  # the names of things
    file.move(name, f"{parent}/{rng.choice(['x', last + 'x', last[::-1] + '_'])}")
    return "free" if free else "refuse"


def added(file: h5py.File, name: str, rng: random.Random) -> str:
    group = file[name] if isinstance(file[name], h5py.Group) else file[name].parent
    group["unknown"] = np.zeros(3)
    return "free"


def exchanged(file: h5py.File, name: str, rng: random.Random) -> str:
    held = isinstance(file[name], h5py.Group)
    old = dict(file[name].attrs)
    del file[name]
    made = file.create_dataset(name, data=np.zeros(3)) if held else file.create_group(name)
    _attributes(made, old)
    return "free" if name == "random_state" else "refuse"  # nothing reads it


# ---- attributes


def attribute(file: h5py.File, name: str, rng: random.Random) -> str:
    node = rng.choice([file, file[name]])
    if not len(node.attrs):
        node = file
    key = rng.choice(sorted(node.attrs))
    if rng.random() < 0.3:
        del node.attrs[key]
        return "refuse" if key in ("units", "format", "schema_version", "kind", "model") else "free"
    values = [
        "\x1b[2Jx",
        "[bold]x[/bold]",
        -1,
        2**62,
        np.nan,
        "",
        "x" * 5000,
        np.zeros(4),
        np.array([b"a", b"b"]),
    ]
    node.attrs[key] = rng.choice([*values, h5py.Empty("f8")])
    return "refuse" if key in ("units", "format", "schema_version", "kind") else "free"


def units(file: h5py.File, name: str, rng: random.Random) -> str:
    sets: list[str] = []
    file.visititems(lambda n, node: sets.append(n) if "units" in node.attrs else None)
    if not sets:
        return removed(file, name, rng)
    node = file[rng.choice(sets)]
    node.attrs["units"] = rng.choice(["mm", "kN", "deg", "mm mm mm 1 1 1 1", 5, "", "in"])
    return "refuse"


# ---- numbers


def _put(file: h5py.File, name: str, **made: Any) -> None:
    old = dict(file[name].attrs)
    del file[name]
    _attributes(file.create_dataset(name, **made), old)


def other_type(file: h5py.File, name: str, rng: random.Random) -> str:
    values = np.asarray(file[name][()])
    if values.dtype.kind not in "fiu":
        _put(file, name, data=np.zeros(values.shape or (1,)))
        return "refuse"
    compound = np.zeros(values.shape, dtype=[("a", "f8"), ("b", "i4")])
    text = np.full(values.shape, b"1.0")
    made = rng.choice([compound, text, values.astype(complex), np.zeros(values.shape, "V16")])
    _put(file, name, data=made)
    return "refuse"


def variable_length(file: h5py.File, name: str, rng: random.Random) -> str:
    dtype = rng.choice([h5py.vlen_dtype(np.float64), h5py.ref_dtype])
    _put(file, name, shape=file[name].shape or (1,), dtype=dtype)
    return "refuse"


def not_a_number(file: h5py.File, name: str, rng: random.Random) -> str:
    node = file[name]
    values = np.array(node[()])
    if values.dtype.kind != "f" or not values.size:
        return other_type(file, name, rng)
    values.reshape(-1)[rng.randrange(values.size)] = rng.choice([np.nan, np.inf, -1e300, 1e300, -1.0])
    node[...] = values
    return "free"


def other_shape(file: h5py.File, name: str, rng: random.Random) -> str:
    values = np.asarray(file[name][()])
    if values.dtype.kind not in "fiu":
        return other_type(file, name, rng)
    shapes = [values[None], values[None, None], values.reshape(-1)]
    if values.ndim:
        shapes += [values[:-1], values[..., :0], values.T]
    made = rng.choice(shapes)
    _put(file, name, data=made)
    return "free"


def no_numbers(file: h5py.File, name: str, rng: random.Random) -> str:
    _put(file, name, data=h5py.Empty("f8"))
    return "refuse"


# ---- claims


def huge(file: h5py.File, name: str, rng: random.Random) -> str:
    shape = rng.choice([(2**40,), (2**31, 3), (10**9, 7), (2**26,)])
    _put(file, name, shape=shape, dtype="f8", chunks=(min(shape[0], 2**16), *shape[1:]))
    return "refuse"


def bomb(file: h5py.File, name: str, rng: random.Random) -> str:
    count = BOMB // 8
    _put(file, name, shape=(4 * count,), dtype="f8", chunks=(count,), compression="gzip")
    for k in range(4):
        file[name].id.write_direct_chunk((k * count,), zeros())
    return "refuse"


def long_stream(file: h5py.File, name: str, rng: random.Random) -> str:
    _put(file, name, shape=(64,), dtype="f8", chunks=(16,), compression="gzip")
    for k in range(4):
        file[name].id.write_direct_chunk((16 * k,), zeros())
    return "free"


def outside(file: h5py.File, name: str, rng: random.Random) -> str:
    _put(file, name, shape=(100,), dtype="f8", external=[("/etc/hostname", 0, 800)])
    return "refuse"


def virtual(file: h5py.File, name: str, rng: random.Random) -> str:
    shape = rng.choice([(10,), (2**36,)])
    layout = h5py.VirtualLayout(shape=shape, dtype="f8")
    layout[:3] = h5py.VirtualSource(str(Path(file.filename).with_name("elsewhere.h5")), "x", shape=(3,))
    old = dict(file[name].attrs)
    del file[name]
    _attributes(file.create_virtual_dataset(name, layout), old)
    return "refuse"


DEEDS: dict[str, list[Any]] = {
    "links": [external_link, soft_link, hard_cycle],
    "objects": [removed, renamed, added, exchanged],
    "attributes": [attribute, units],
    "numbers": [other_type, variable_length, not_a_number, other_shape, no_numbers],
    "claims": [huge, bomb, long_stream, outside, virtual],
}
