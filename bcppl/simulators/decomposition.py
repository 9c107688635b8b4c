"""Any closed mesh as convex pieces by CoACD, with its error measured, bounded by a clearance, and cached.

CoACD: Wei, Liu, Ling and Su 2022, "Approximate convex decomposition for 3D meshes with collision-aware
concavity and tree search". What has an exact outline is better drawn by `extrusion` or `layers`.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import os
import tempfile
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from bcppl.errors import InputError
from bcppl.parts import Part, Piece
from bcppl.simulators.fidelity import GeometricError, geometric_error

Array = npt.NDArray[np.float64]

THRESHOLDS = (0.05, 0.02, 0.01)  # CoACD's concavity, of a mesh scaled to a box of side 2
_FORM = 1  # of the cached files


@dataclass(frozen=True, eq=False)
class Decomposition:
    """A part in convex pieces, and how well they stand in for its mesh.

    Attributes:
        part: the part with its pieces.
        error: between the pieces and the mesh, metres, over points on both surfaces.
        threshold: CoACD's concavity threshold that gave it; 0 for a convex part, which is one piece.
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
    cache: Path | None = None,
) -> Decomposition:
    """A part taken apart into convex pieces that are off its mesh by a fraction of a clearance at most.

    Thresholds are tried in order until one is fine enough. Results are kept on disk under a hash of the mesh,
    the settings and CoACD's version.

    Args:
        part: with a closed mesh.
        clearance: of what is to be inserted or to receive, metres, of the diameter.
        fraction: of the clearance that the error may come to, on either side.
        thresholds: CoACD's, from coarse to fine.
        seed: of CoACD's tree search, and of the points that measure the error.
        cache: the folder of results; None for `bcppl/decompositions` in the user's cache folder.

    Raises:
        InputError: the mesh is empty, open or in millimetres; CoACD is not installed; or the finest pieces
            are coarser than the fraction of the clearance.
    """
    part.check()
    if not (clearance > 0 and fraction > 0 and len(thresholds)):
        raise InputError(
            f"part {part.name!r} is to be taken apart for a clearance of {clearance!r} m, a fraction of "
            f"{fraction!r} and {len(thresholds)} thresholds; give numbers greater than 0."
        )
    hull = part.mesh.convex_hull
    if hull.volume - part.mesh.volume <= 1e-6 * hull.volume:
        whole = replace(part, pieces=(Piece("hull", np.asarray(hull.vertices)),))
        return Decomposition(whole, geometric_error(whole, seed=seed), 0.0)
    found = []
    for threshold in thresholds:
        found.append(_kept(part, threshold, seed, cache))
        if found[-1].error.largest <= fraction * clearance:
            return found[-1]
    best = min(found, key=lambda result: result.error.largest)
    raise InputError(
        f"part {part.name!r} in {len(best.part.pieces)} convex pieces gains {1000 * best.error.added:.2g} mm "
        f"and loses up to {1000 * best.error.lost:.2g} mm, more than {fraction:g} of its clearance of "
        f"{1000 * clearance:g} mm; draw it from its exact outline, or give finer thresholds or more of it."
    )


def _kept(part: Part, threshold: float, seed: int, cache: Path | None) -> Decomposition:
    """A decomposition from the cache, or made anew and put there."""
    version = _version(part)
    settings = {"form": _FORM, "coacd": version, "threshold": threshold, "seed": seed}
    content = hashlib.sha256(json.dumps(settings, sort_keys=True).encode())
    for array in (part.vertices.astype("<f8"), part.faces.astype("<i8")):
        content.update(np.ascontiguousarray(array).tobytes())
    path = (_user_cache() if cache is None else cache) / f"{content.hexdigest()}.npz"
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
    mesh = coacd.Mesh(part.vertices, part.faces)
    pieces = coacd.run_coacd(mesh, threshold=threshold, preprocess_mode="off", seed=seed)
    return [np.asarray(vertices, dtype=np.float64) for vertices, _ in pieces]


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
        sound = corners.shape == (counts.sum(), 3) and (counts > 3).all() and error.shape == (2,)
        if not (sound and np.isfinite(corners).all() and np.isfinite(error).all()):
            raise ValueError("its arrays do not fit together")
    except Exception as damage:  # zip, numpy and the file system each have errors of their own
        warnings.warn(
            f"the cached decomposition {path} is damaged ({damage}) and is made again.",
            RuntimeWarning,
            stacklevel=5,
        )
        return None
    return np.split(corners, np.cumsum(counts)[:-1]), GeometricError(float(error[0]), float(error[1]))


def _write(path: Path, hulls: list[Array], error: GeometricError) -> None:
    """Write a cached file whole or not at all."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, suffix=".part", delete=False) as file:
            np.savez_compressed(
                file,
                corners=np.concatenate(hulls),
                counts=np.array([len(hull) for hull in hulls]),
                error=np.array([error.added, error.lost]),
            )
        os.replace(file.name, path)
    except OSError as refusal:
        warnings.warn(
            f"the decomposition cannot be kept at {path} ({refusal}); it will be made again next time.",
            RuntimeWarning,
            stacklevel=5,
        )
