"""Convex decompositions: the error is measured, bounded by the clearance, and the result is cached."""

from __future__ import annotations

import importlib.metadata
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
import trimesh

from bcppl.errors import InputError
from bcppl.geometry.convex import decomposition
from bcppl.geometry.convex.decomposition import decomposed
from bcppl.geometry.convex.hausdorff import hausdorff_error
from bcppl.geometry.extrusion import block
from bcppl.geometry.parts import Part, Piece


def angle(tall: float = 0.01) -> Part:
    outline = shapely.Polygon([(0, 0), (0.03, 0), (0.03, 0.01), (0.01, 0.01), (0.01, 0.03), (0, 0.03)])
    mesh = trimesh.creation.extrude_polygon(outline, tall)
    return Part("angle", np.asarray(mesh.vertices), np.asarray(mesh.faces))


def ring() -> Part:
    mesh = trimesh.creation.annulus(0.0051, 0.01, 0.01, sections=32)
    mesh.merge_vertices()
    return Part("ring", np.asarray(mesh.vertices), np.asarray(mesh.faces))


def test_the_error_of_pieces_is_exact_on_both_sides() -> None:
    half = np.array([0.03, 0.02, 0.01])
    solid = block((0.06, 0.04, 0.02))
    moved = replace(solid, pieces=[Piece("box", half, np.array([0.0003, 0.0, -0.01]))])
    error = hausdorff_error(moved, count=500)
    assert error.added == pytest.approx(0.0003, abs=1e-9) and error.lost == pytest.approx(0.0003, abs=1e-9)
    smaller = replace(solid, pieces=[Piece("box", half - 0.001, np.array([0.0, 0.0, -0.01]))])
    error = hausdorff_error(smaller, count=500)
    # The corners, which are always among the points, are off along the diagonal.
    assert error.added == 0.0 and error.lost == pytest.approx(0.001 * np.sqrt(3.0), rel=1e-6)
    halves = [Piece("box", half * [0.5, 1, 1], np.array([x, 0.0, -0.01])) for x in (-0.015, 0.015)]
    assert hausdorff_error(replace(solid, pieces=halves), count=500).largest < 1e-12


@pytest.mark.parametrize("off", [0.0005, 0.005])
def test_what_is_lost_beyond_an_edge_of_a_piece_is_the_distance_to_that_edge(off: float) -> None:
    """A wedge, and a piece that is moved back from its edge: the planes are off by less than the edge."""
    mesh = trimesh.creation.extrude_polygon(shapely.Polygon([(0, 0), (-0.04, 0.04), (-0.04, -0.04)]), 0.01)
    wedge = Part("wedge", np.asarray(mesh.vertices), np.asarray(mesh.faces))
    back = Piece("hull", wedge.vertices - [off, 0.0, 0.0])
    error = hausdorff_error(replace(wedge, pieces=[back]), count=500)
    assert error.lost == pytest.approx(off, rel=1e-6) and error.added == pytest.approx(off, rel=1e-6)


def test_a_convex_part_needs_no_coacd(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def missing(name: str) -> str:
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(importlib.metadata, "version", missing)
    whole = decomposed(replace(block((0.06, 0.04, 0.02)), pieces=()), clearance=0.0001, cache=tmp_path)
    assert len(whole.part.pieces) == 1 and whole.error.largest < 1e-12
    with pytest.raises(InputError, match=r"not convex.*pip install 'bcppl\[mesh\]'") as caught:
        decomposed(angle(), clearance=0.0001, cache=tmp_path)
    assert "\n" not in str(caught.value)
    # The cache folder is determined by a package that is installed together with CoACD.
    monkeypatch.setitem(sys.modules, "platformdirs", None)
    assert decomposed(replace(block((0.06, 0.04, 0.02)), pieces=()), clearance=0.0001).error.largest < 1e-12
    with pytest.raises(InputError, match=r"not convex.*pip install 'bcppl\[mesh\]'"):
        decomposed(angle(), clearance=0.0001)


def test_pieces_are_cached_by_content_and_damage_is_reported(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    pytest.importorskip("coacd")
    made = decomposed(angle(), clearance=0.0002, cache=tmp_path)
    assert made.error == hausdorff_error(made.part) and made.error.largest <= 0.00004
    assert sum(trimesh.convex.convex_hull(p.size).volume for p in made.part.pieces) == pytest.approx(
        angle().mesh.volume, rel=0.01
    )
    (file,) = tmp_path.iterdir()
    calls, hulls = list[Any](), [piece.size for piece in made.part.pieces]
    monkeypatch.setattr(decomposition, "_coacd", lambda *given: calls.append(given) or hulls)
    again = decomposed(replace(angle(), name="another name"), clearance=0.0002, cache=tmp_path)
    assert not calls and again.error == made.error and again.part.name == "another name"
    for a, b in zip(made.part.pieces, again.part.pieces, strict=True):
        np.testing.assert_array_equal(a.size, b.size)
    with np.load(file) as stored:
        content = dict(stored)
    wrong = tmp_path.parent / "wrong.npz"  # valid, with hulls that are none
    np.savez_compressed(wrong, **content | {"corners": content["corners"][:, :2]})
    for damage in (wrong.read_bytes(), b"", file.read_bytes()[:-40]):
        file.write_bytes(damage)
        calls.clear()
        with pytest.warns(RuntimeWarning, match="damaged"):
            mended = decomposed(angle(), clearance=0.0002, cache=tmp_path)
        assert len(calls) == 1 and mended.error == made.error
    assert list(tmp_path.iterdir()) == [file]  # no unfinished file is left
    calls.clear()
    same = decomposed(
        angle(), 0.0002, thresholds=np.array([0.05], np.float32), seed=np.int64(0), cache=str(tmp_path)
    )
    assert same.error == made.error and len(calls) == 1  # single precision has another 0.05
    decomposed(angle(tall=0.011), clearance=0.01, cache=tmp_path)
    assert len(list(tmp_path.iterdir())) == 3


@pytest.mark.long
def test_a_decomposition_coarser_than_the_clearance_allows_is_refused(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("coacd")
    tried: list[float] = []
    real = decomposition._coacd
    monkeypatch.setattr(decomposition, "_coacd", lambda *given: tried.append(given[1]) or real(*given))
    with pytest.raises(InputError, match=r"would still have about .* all the same\.") as caught:
        decomposed(ring(), 0.0001, thresholds=(0.1, 0.05), cache=tmp_path, progress=True)
    assert tried == [0.1] and "\n" not in str(caught.value)
    assert "CoACD at threshold 0.1" in capsys.readouterr().err
    with pytest.raises(InputError, match=r"'ring' in \d+ convex pieces gains .* mm") as caught:
        decomposed(ring(), clearance=0.0002, thresholds=(0.1,), cache=tmp_path)
    assert "\n" not in str(caught.value)
    coarse = decomposed(ring(), clearance=0.01, thresholds=(0.1,), cache=tmp_path)
    # The pieces extend into the hole: a ring of 10.2 mm that admits no peg of 10 mm.
    assert coarse.error.added > 0.0001 and tried == [0.1]
    with pytest.raises(InputError, match="above 0"):
        decomposed(ring(), clearance=0.0, cache=tmp_path)


def test_convex_bodies_are_kept_even_where_they_overlap(tmp_path: Path) -> None:
    boxes = [trimesh.creation.box([0.02, 0.01, 0.01]) for _ in range(2)]
    boxes[1].apply_translation([0.005, 0.005, 0.002])
    both = trimesh.util.concatenate(boxes)
    made = decomposed(Part("two", np.asarray(both.vertices), np.asarray(both.faces)), 0.0001, cache=tmp_path)
    assert len(made.part.pieces) == 2 and made.error.largest < 1e-9 and made.threshold == 0.0
    # Halves of the first box: their common face lies deep in the solid, next to the other box's surface.
    halves = [Piece("box", np.array([0.005, 0.005, 0.005]), np.array([x, 0.0, 0.0])) for x in (-0.005, 0.005)]
    second = Piece("box", np.array([0.01, 0.005, 0.005]), np.array([0.005, 0.005, 0.002]))
    assert hausdorff_error(replace(made.part, pieces=(*halves, second)), count=5000).largest < 1e-9
    with pytest.raises(ValueError, match="at least one array"):
        hausdorff_error(angle())


def test_a_cache_that_cannot_be_written_is_reported_and_does_not_stop(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    pytest.importorskip("coacd")
    boxes = trimesh.creation.box([0.03, 0.01, 0.01]), trimesh.creation.box([0.01, 0.03, 0.01])
    hulls = [np.asarray(box.vertices - box.bounds[0]) for box in boxes]
    monkeypatch.setattr(decomposition, "_coacd", lambda *given: hulls)
    (tmp_path / "file").write_text("in the way")
    with pytest.warns(RuntimeWarning, match="cannot be cached"):
        made = decomposed(angle(), clearance=0.001, cache=tmp_path / "file")
    assert made.error.largest < 1e-9

    def full(*given: Any, **arrays: Any) -> None:
        raise OSError("no space left on device")

    monkeypatch.setattr(np, "savez_compressed", full)
    with pytest.warns(RuntimeWarning, match="no space left"):
        decomposed(angle(), clearance=0.001, cache=tmp_path / "other")
    assert not list((tmp_path / "other").iterdir())
