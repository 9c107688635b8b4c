"""Any closed mesh as convex pieces by CoACD, with its error measured, bounded by a clearance, and cached.

CoACD: Wei, Liu, Ling and Su 2022, "Approximate convex decomposition for 3D meshes with collision-aware
concavity and tree search". What has an exact outline is better drawn by `extrusion` or `layers`.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib.metadata
import json
import os
import tempfile
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from bcppl.arguments import number_within, seed_number
from bcppl.errors import InputError
from bcppl.geometry.fidelity import GeometricError, bodies_of, geometric_error
from bcppl.geometry.parts import Part, Piece

Array = npt.NDArray[np.float64]

THRESHOLDS = (0.05, 0.02, 0.01)  # CoACD's concavity, of a mesh scaled to a box of side 2
# Of CoACD's tree search, by default 150 iterations and 2000 points: in half the time as many pieces, as good.
_SEARCH = {"mcts_iterations": 60, "resolution": 1000}
_FINEST = 0.01  # that CoACD takes
_FORM = 2  # of the cached files
_HOPELESS = 1.25  # times the bound: from 0.05 to 0.02 a torus's error fell to 0.36 of it, not 0.4
_GENTLE = np.deg2rad(30.0)  # an inner edge that bends less is of a rounded surface


@dataclass(frozen=True, eq=False)
class Decomposition:
    """A part in convex pieces, and how well they stand in for its mesh.

    Attributes:
        part: the part with its pieces.
        error: between the pieces and the mesh, metres, over points on both surfaces.
        threshold: CoACD's concavity threshold that gave it; 0 where the mesh's bodies are convex already.
    """

    part: Part
    error: GeometricError
    threshold: float


def decomposed(
    part: Part,
    clearance: float,
    fraction: float = 0.2,
    thresholds: Sequence[float] = THRESHOLDS,
    seed: int = 0,
    cache: str | Path | None = None,
    progress: bool | None = None,
) -> Decomposition:
    """A part taken apart into convex pieces that are off its mesh by a fraction of a clearance at most.

    Bodies of the mesh that are convex already stay as they are, be it that they overlap. For the others,
    thresholds are tried in order until one is fine enough. On rounded inner surfaces the error is about the
    threshold times half the longest side; where an error, brought down in proportion to the finest
    threshold, would still be more than 1.25 times too large, no finer one is tried. Flat inner walls may
    become exact at any threshold, and all are tried.

    CoACD's search takes the time, the finer the longer; the error's measurement takes about a second. On
    two busy cores a torus of 1024 faces took 5 s down to a threshold of 0.05 and 17 s down to 0.02; a drill
    of nine overlapping bodies, 342 faces, took 0.6 s where their hulls will do, 7 s down to 0.02, two
    minutes down to 0.01.

    Results are kept on disk under a hash of the mesh, the settings and CoACD's version.

    Args:
        part: with a closed mesh.
        clearance: of what is to be inserted or to receive, metres, of the diameter.
        fraction: of the clearance that the error may come to, on either side.
        thresholds: CoACD's, from coarse to fine, 0.01 to 1; a single one is always tried.
        seed: of CoACD's tree search, and of the points that measure the error.
        cache: the folder of results; None for `bcppl/decompositions` in the user's cache folder.
        progress: show on standard error what is being done and for how long; None where that is a terminal.

    Raises:
        InputError: the mesh is empty, open, inside out or in millimetres; a number is out of range; CoACD is
            not installed; or the finest pieces are coarser than the fraction of the clearance.
    """
    part.check()
    task = f"part {part.name!r} is to be taken apart"
    bound = number_within(f"{task} for clearance {{}} m", clearance, above=0.0)
    bound *= number_within(f"{task} to fraction {{}} of the clearance", fraction, above=0.0)
    levels = [
        number_within(f"{task} with threshold {{}}", level, least=_FINEST, most=1.0) for level in thresholds
    ]
    if not levels:
        raise InputError(f"{task} without thresholds; give at least one, such as 0.05.")
    seed = seed_number(seed)
    hulls = [np.asarray(body.convex_hull.vertices) for body in bodies_of(part.mesh)]
    whole = replace(part, pieces=tuple(Piece("hull", corners) for corners in hulls))
    error = geometric_error(whole, seed=seed)
    if error.largest <= bound:
        return Decomposition(whole, error, 0.0)
    found: list[Decomposition] = []
    with _told(part, progress) as tell:
        for threshold in levels:
            tell(f"CoACD at threshold {threshold:g}")
            found.append(_kept(part, threshold, seed, cache))
            if found[-1].error.largest <= bound:
                return found[-1]
            expected = found[-1].error.largest * min(levels) / threshold
            if threshold > min(levels) and expected > _HOPELESS * bound and _rounded_inside(part):
                raise InputError(
                    f"part {part.name!r} at threshold {threshold:g} is off by "
                    f"{1000 * found[-1].error.largest:.2g} mm, and at {min(levels):g} would still be by "
                    f"about {1000 * expected:.2g} mm, more than {fraction:g} of its clearance of "
                    f"{1000 * clearance:g} mm; draw it from its exact outline, or try thresholds="
                    f"({min(levels):g},) all the same."
                )
    best = min(found, key=lambda result: result.error.largest)
    raise InputError(
        f"part {part.name!r} in {len(best.part.pieces)} convex pieces gains {1000 * best.error.added:.2g} mm "
        f"and loses up to {1000 * best.error.lost:.2g} mm, more than {fraction:g} of its clearance of "
        f"{1000 * clearance:g} mm; draw it from its exact outline, or give finer thresholds or more of it."
    )


def _rounded_inside(part: Part) -> bool:
    """Whether most of a mesh's inner edges are those of facets of a rounded surface."""
    angles = part.mesh.face_adjacency_angles[~part.mesh.face_adjacency_convex]
    angles = angles[angles > 1e-3]
    return bool(len(angles) and (angles < _GENTLE).mean() > 0.5)


@contextlib.contextmanager
def _told(part: Part, progress: bool | None) -> Iterator[Callable[[str], None]]:
    """A line on standard error with what is being done, and for how long."""
    console = Console(stderr=True, force_terminal=True if progress else None)
    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    shown = console.is_terminal if progress is None else progress
    with Progress(*columns, console=console, transient=True, disable=not shown) as bar:
        task = bar.add_task("")
        yield lambda what: bar.update(task, description=f"{part.name}: {what}")


def _kept(part: Part, threshold: float, seed: int, cache: str | Path | None) -> Decomposition:
    """A decomposition from the cache, or made anew and put there."""
    version = _version(part)
    # Only now: what finds the folder is installed together with CoACD.
    folder = _user_cache() if cache is None else Path(cache)
    settings = {"form": _FORM, "coacd": version, "threshold": threshold, "seed": seed, **_SEARCH}
    content = hashlib.sha256(json.dumps(settings, sort_keys=True).encode())
    for array in (part.vertices.astype("<f8"), part.faces.astype("<i8")):
        content.update(np.ascontiguousarray(array).tobytes())
    path = folder / f"{content.hexdigest()}.npz"
    known = _read(path)
    if known is None:
        hulls = _coacd(part, threshold, seed)
        made = replace(part, pieces=tuple(Piece("hull", hull) for hull in hulls))
        error = geometric_error(made, seed=seed)
        _write(path, hulls, error)
    else:
        hulls, error = known
        made = replace(part, pieces=tuple(Piece("hull", hull) for hull in hulls))
    return Decomposition(made, error, threshold)


def _version(part: Part) -> str:
    try:
        return importlib.metadata.version("coacd")
    except importlib.metadata.PackageNotFoundError:
        raise InputError(
            f"part {part.name!r} is not convex, and taking it apart needs the package coacd, which is not "
            "installed; install it with: pip install 'bcppl[mesh]'."
        ) from None


def _coacd(part: Part, threshold: float, seed: int) -> list[Array]:
    import coacd

    coacd.set_log_level("error")
    found = []
    for body in bodies_of(part.mesh):
        hull = body.convex_hull
        if hull.volume - body.volume <= 1e-6 * hull.volume:
            found.append((hull.vertices, hull.faces))
        else:
            mesh = coacd.Mesh(np.array(body.vertices), np.array(body.faces))
            found += coacd.run_coacd(mesh, threshold=threshold, preprocess_mode="off", seed=seed, **_SEARCH)
    return [np.asarray(vertices, dtype=np.float64) for vertices, _ in found]


def _user_cache() -> Path:
    import platformdirs

    return platformdirs.user_cache_path("bcppl") / "decompositions"


def _read(path: Path) -> tuple[list[Array], GeometricError] | None:
    """What a cached file holds; None, with a warning, where it is damaged."""
    if not path.is_file():
        return None
    try:
        with np.load(path, allow_pickle=False) as stored:
            corners, counts, error = stored["corners"], stored["counts"], stored["error"]
            checksum = stored["checksum"]
        if not np.array_equal(checksum, _checksum(corners, counts, error)):
            raise ValueError("its checksum is wrong")
        hulls = np.split(corners, np.cumsum(counts)[:-1])
        return hulls, GeometricError(float(error[0]), float(error[1]))
    except Exception as damage:  # zip, numpy and the file system each have errors of their own
        warnings.warn(
            f"the cached decomposition {path} is damaged ({damage}) and is made again.",
            RuntimeWarning,
            stacklevel=5,
        )
        return None


def _checksum(*arrays: npt.NDArray[np.generic]) -> npt.NDArray[np.uint8]:
    """SHA-256 (32,) of some arrays, their shapes and types."""
    content = hashlib.sha256()
    for array in arrays:
        content.update(f"{array.dtype.str} {array.shape} ".encode())
        content.update(np.ascontiguousarray(array).tobytes())
    return np.frombuffer(content.digest(), dtype=np.uint8)


def _write(path: Path, hulls: list[Array], error: GeometricError) -> None:
    """Write a cached file whole or not at all."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        stored: dict[str, Any] = {
            "corners": np.concatenate(hulls),
            "counts": np.array([len(hull) for hull in hulls]),
            "error": np.array([error.added, error.lost]),
        }
        with tempfile.NamedTemporaryFile(dir=path.parent, suffix=".part", delete=False) as file:
            try:
                np.savez_compressed(file, checksum=_checksum(*stored.values()), **stored)
                file.close()
                os.replace(file.name, path)
            except BaseException:
                Path(file.name).unlink()
                raise
    except OSError as refusal:
        warnings.warn(
            f"the decomposition cannot be kept at {path} ({refusal}); it will be made again next time.",
            RuntimeWarning,
            stacklevel=5,
        )
