"""Convex decompositions of closed meshes by CoACD: measured, bounded by a clearance, and cached.

CoACD: Wei, Liu, Ling and Su 2022, "Approximate convex decomposition for 3D meshes with collision-aware
concavity and tree search". Parts with an exact outline are better served by `extrusion` or `layers`.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib.metadata
import json
import os
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from bcppl.arguments import number_within, seed_number
from bcppl.arrays import Array
from bcppl.errors import InputError
from bcppl.geometry.convex.hausdorff import HausdorffError, bodies_of, hausdorff_error
from bcppl.geometry.parts import Part, Piece

FRACTION = 0.2  # of the clearance that the error may use up in either direction
THRESHOLDS = (0.05, 0.02, 0.01)  # CoACD's concavity, for a mesh scaled to a box of side 2
# Of CoACD's tree search; with its defaults of 150 and 2000, twice the time for as many pieces of equal error.
_SEARCH = {"mcts_iterations": 60, "resolution": 1000}
_FINEST = 0.01  # the smallest threshold that CoACD accepts
_FORM = 2  # version of the cached files
_HOPELESS = 1.25  # times the bound: from 0.05 to 0.02 a torus's error fell to 0.36 of it, not 0.4
_GENTLE = np.deg2rad(30.0)  # dihedral angle below which a concave edge belongs to a rounded surface


@dataclass(frozen=True, eq=False)
class Decomposition:
    """A part with convex pieces, their Hausdorff error (m), and CoACD's threshold; 0 if it was not needed."""

    part: Part
    error: HausdorffError
    threshold: float


def decomposed(
    part: Part,
    clearance: float,
    thresholds: Sequence[float] = THRESHOLDS,
    seed: int = 0,
    cache: str | Path | None = None,
    progress: bool | None = None,
) -> Decomposition:
    """A convex decomposition of a part with a Hausdorff error of at most a fifth of a clearance.

    Bodies of the mesh that are convex are kept, even where they overlap. For the others, thresholds are tried
    in order until the error is small enough. On rounded concave surfaces the error is about the threshold
    times half the longest side; where an error scaled to the finest threshold would still be more than 1.25
    times too large, no finer one is tried. Flat concave walls may become exact at any threshold, and all are
    tried.

    CoACD's search dominates the time: a torus of 1024 faces took 5 s at a threshold of 0.05 and 12 s more at
    0.02, a drill of 342 faces 7 s down to 0.02 and two minutes down to 0.01. Results are cached on disk under
    a hash of the mesh, the settings and CoACD's version.

    Args:
        part: with a closed mesh.
        clearance: of the fit that the part is used in, of the diameter, metres.
        thresholds: CoACD's, from coarse to fine, 0.01 to 1; a single one is always tried.
        seed: of CoACD's tree search, and of the samples that measure the error.
        cache: the folder of results; None for `bcppl/decompositions` in the user's cache folder.
        progress: show the current step and its duration on standard error; None where that is a terminal.

    Raises:
        InputError: the mesh is empty, open, inside out or in millimetres; a number is out of range; CoACD is
            not installed; or the finest pieces are coarser than a fifth of the clearance.
    """
    part.check()
    task = f"part {part.name!r} is decomposed"
    bound = FRACTION * number_within(f"{task} for clearance {{}} m", clearance, above=0.0)
    levels = [
        number_within(f"{task} with threshold {{}}", level, least=_FINEST, most=1.0) for level in thresholds
    ]
    seed = seed_number(seed)
    whole = _measured(part, [np.asarray(b.convex_hull.vertices) for b in bodies_of(part.mesh)], 0.0, seed)
    if whole.error.largest <= bound:
        return whole
    results: list[Decomposition] = []
    with _progress(part, progress) as show:
        for threshold in levels:
            show(f"CoACD at threshold {threshold:g}")
            results.append(_cached(part, threshold, seed, cache))
            error = results[-1].error
            if error.largest <= bound:
                return results[-1]
            expected = error.largest * min(levels) / threshold
            if threshold > min(levels) and expected > _HOPELESS * bound and _rounded_inside(part):
                raise InputError(
                    f"part {part.name!r} at threshold {threshold:g} has an error of "
                    f"{1000 * error.largest:.2g} mm, and at {min(levels):g} would still have about "
                    f"{1000 * expected:.2g} mm, more than {FRACTION:g} of its clearance of "
                    f"{1000 * clearance:g} mm; extrude it from its exact outline, or try thresholds="
                    f"({min(levels):g},) all the same."
                )
    best = min(results, key=lambda result: result.error.largest)
    raise InputError(
        f"part {part.name!r} in {len(best.part.pieces)} convex pieces gains {1000 * best.error.added:.2g} mm "
        f"and loses up to {1000 * best.error.lost:.2g} mm, more than {FRACTION:g} of its clearance of "
        f"{1000 * clearance:g} mm; extrude it from its exact outline, or give finer thresholds or more of it."
    )


def _rounded_inside(part: Part) -> bool:
    """Whether most concave edges of a mesh belong to rounded surfaces."""
    angles = part.mesh.face_adjacency_angles[~part.mesh.face_adjacency_convex]
    angles = angles[angles > 1e-3]
    return bool(len(angles) and (angles < _GENTLE).mean() > 0.5)


@contextlib.contextmanager
def _progress(part: Part, progress: bool | None) -> Iterator[Callable[[str], None]]:
    """A line on standard error with the current step and the time elapsed."""
    console = Console(stderr=True, force_terminal=True if progress else None)
    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    shown = console.is_terminal if progress is None else progress
    with Progress(*columns, console=console, transient=True, disable=not shown) as bar:
        task = bar.add_task("")
        yield lambda step: bar.update(task, description=f"{part.name}: {step}")


def _cached(part: Part, threshold: float, seed: int, cache: str | Path | None) -> Decomposition:
    """A decomposition from the cache, measured again, or computed and written to the cache."""
    version = _version(part)
    import platformdirs  # not before: it is installed together with CoACD

    folder = platformdirs.user_cache_path("bcppl") / "decompositions" if cache is None else Path(cache)
    settings = {"form": _FORM, "coacd": version, "threshold": threshold, "seed": seed, **_SEARCH}
    content = hashlib.sha256(json.dumps(settings, sort_keys=True).encode())
    for array in (part.vertices.astype("<f8"), part.faces.astype("<i8")):
        content.update(np.ascontiguousarray(array).tobytes())
    path = folder / f"{content.hexdigest()}.npz"
    if path.is_file():
        try:
            with np.load(path, allow_pickle=False) as stored:
                hulls = np.split(stored["corners"], np.cumsum(stored["counts"])[:-1])
            return _measured(part, hulls, threshold, seed)
        except Exception as damage:  # zip, numpy, the file system and convex hulls have errors of their own
            warnings.warn(
                f"the cached decomposition {path} is damaged ({damage}) and is computed again.",
                RuntimeWarning,
                stacklevel=3,
            )
    hulls = _coacd(part, threshold, seed)
    _write(path, hulls)
    return _measured(part, hulls, threshold, seed)


def _measured(part: Part, hulls: Sequence[Array], threshold: float, seed: int) -> Decomposition:
    whole = replace(part, pieces=tuple(Piece("hull", hull) for hull in hulls))
    return Decomposition(whole, hausdorff_error(whole, seed=seed), threshold)


def _version(part: Part) -> str:
    try:
        return importlib.metadata.version("coacd")
    except importlib.metadata.PackageNotFoundError:
        raise InputError(
            f"part {part.name!r} is not convex, and its decomposition needs the package coacd, which is not "
            "installed; install it with: pip install 'bcppl[mesh]'."
        ) from None


def _coacd(part: Part, threshold: float, seed: int) -> list[Array]:
    import coacd

    coacd.set_log_level("error")
    hulls = []
    for body in bodies_of(part.mesh):
        hull = body.convex_hull
        if hull.volume - body.volume <= 1e-6 * hull.volume:
            hulls.append((hull.vertices, hull.faces))
        else:
            mesh = coacd.Mesh(np.array(body.vertices), np.array(body.faces))
            hulls += coacd.run_coacd(mesh, threshold=threshold, preprocess_mode="off", seed=seed, **_SEARCH)
    return [np.asarray(vertices, dtype=np.float64) for vertices, _ in hulls]


def _write(path: Path, hulls: Sequence[Array]) -> None:
    """Write a cached file atomically."""
    unfinished = path.with_name(f"{path.stem}.{os.getpid()}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with unfinished.open("wb") as file:
            np.savez_compressed(file, corners=np.concatenate(hulls), counts=[len(hull) for hull in hulls])
        os.replace(unfinished, path)
    except OSError as refusal:
        warnings.warn(
            f"the decomposition cannot be cached at {path} ({refusal}); it will be computed again next time.",
            RuntimeWarning,
            stacklevel=4,
        )
    finally:
        with contextlib.suppress(OSError):
            unfinished.unlink()
