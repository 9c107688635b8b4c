"""Parts from outlines and cross sections: exact solids without seams, and refusals in one sentence."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import shapely
import torch
import trimesh
from scipy.signal import butter, sosfiltfilt
from scipy.spatial.transform import Rotation
from shapely.affinity import translate

from bcppl.contact.mujoco_model import ContactParameters
from bcppl.contact.nuisances import Nuisances
from bcppl.contact.physics import PegPhysics
from bcppl.errors import InputError
from bcppl.geometry import extrusion
from bcppl.geometry.convex.hausdorff import hausdorff_error, solid_of
from bcppl.geometry.extrusion import block, block_with_hole, box_peg, cylinder_peg, extruded, peg_for
from bcppl.geometry.holes import hole_of
from bcppl.geometry.layers import prismatic
from bcppl.geometry.outlines import NAMED, check_fit, named_outline, round_outline
from bcppl.geometry.parts import Part, load_mesh
from bcppl.models.parts import SHAPES, insert_peg, insert_tray
from bcppl.robot.motion import Probe

NIST = Path(__file__).parents[3] / "shared/data/nist_insertion"
BORDER = [(0, -0.05), (0.06, -0.05), (0.06, 0.05), (0, 0.05)]
SOLID = block((0.06, 0.06, 0.025))
nist_needed = pytest.mark.skipif(not NIST.is_dir(), reason=f"the published insertion parts are not in {NIST}")


def volume_of_union(part: Part) -> float:
    return float(trimesh.boolean.union([solid_of(piece) for piece in part.pieces], engine="manifold").volume)


@pytest.mark.long
@pytest.mark.parametrize("name", NAMED)
def test_a_block_and_its_peg_are_exactly_their_outlines(name: str) -> None:
    hole = named_outline(name, 0.0161)
    part = block_with_hole(hole, offset=(0.006, -0.004), turn=0.3)
    peg = peg_for(hole, 0.0001, 0.05)
    for drawn, volume in ((part, (0.06**2 - hole.area) * 0.025), (peg, peg.mesh.volume)):
        error = hausdorff_error(drawn, count=4000)
        assert error.added < 1e-9 and error.lost < 1e-9
        assert volume_of_union(drawn) == pytest.approx(volume, rel=1e-6)
    section = shapely.Polygon(np.asarray(peg.mesh.section([0, 0, 1], [0, 0, -0.025]).discrete[0])[:, :2])
    assert check_fit(hole, section) == pytest.approx(0.0001, abs=1e-9)
    np.testing.assert_allclose(part.mesh.bounds, [[-0.03, -0.03, -0.025], [0.03, 0.03, 0.0]], atol=1e-15)


def test_the_stated_error_of_a_round_outline_is_its_error_either_way() -> None:
    for sides in (7, 64):
        ring = shapely.get_coordinates(round_outline(0.016, sides).exterior)
        inside = 0.008 - np.linalg.norm(0.5 * (ring[1:] + ring[:-1]), axis=1)
        outside = np.linalg.norm(ring, axis=1) - 0.008
        stated = 0.008 * math.tan(math.pi / (2 * sides)) ** 2
        np.testing.assert_allclose(inside, stated, rtol=1e-9)
        np.testing.assert_allclose(outside, stated, rtol=1e-9)


def slide(part: Part, peg: Part) -> tuple[np.ndarray, np.ndarray]:
    """The force and the position at each step of a peg that slides over the top, pressed on with 7.5 N."""
    track = np.array([(-0.021, -0.021), (0.021, -0.018), (0.021, 0.02), (-0.02, 0.021)])
    times = np.array([0.0, 0.3, 0.8, 1.3, 1.8])
    command = np.zeros((5, 7))
    command[:, :2], command[:, 2], command[:, 3] = track[[0, 0, 1, 2, 3]], [0.052] + 4 * [0.047], 1.0
    stiffness, damping = np.array(3 * [2500.0] + 3 * [150.0]), np.array(3 * [120.0] + 3 * [2.5])
    probe = Probe("slide", times, command, stiffness, damping, np.arange(0.0, 1.8, 0.0005))
    pose = torch.tensor([[0.0, 0, 0, 1, 0, 0, 0]], dtype=torch.float64)
    rollout = PegPhysics(part, peg, ContactParameters(time_step=0.0005)).start(pose, probe)
    rollout.advance(len(probe.stamps))
    force = sosfiltfilt(butter(2, 20, fs=2000, output="sos"), rollout.wrench[0, :, :3], axis=0)
    return force[700:], rollout.world_from_peg[0, 700:, :3]


def test_a_peg_that_slides_over_the_top_catches_on_no_seam(monkeypatch: pytest.MonkeyPatch) -> None:
    peg = box_peg(0.004, 0.05)
    _, smooth = slide(block((0.06, 0.06, 0.025)), peg)
    for name in ("hexagon", "round"):
        force, where = slide(block_with_hole(named_outline(name, 0.0161)), peg)
        assert abs(where - smooth)[:, :2].max() < 6e-6 and abs(where - smooth)[:, 2].max() < 15e-6
        assert np.median(force[:, 2]) == pytest.approx(7.5, rel=0.02)
    monkeypatch.setattr(extrusion, "BEVEL", 0.0)  # the peg catches on prisms without a bevel
    _, caught = slide(block_with_hole(named_outline("hexagon", 0.0161)), peg)
    assert abs(caught - smooth)[:, :2].max() > 15e-6


@pytest.mark.long
def test_a_stepped_part_with_a_chamfered_bore_is_exactly_its_prisms_along_any_axis() -> None:
    cylinder, cone = trimesh.creation.cylinder, trimesh.creation.cone
    foot = trimesh.creation.box([0.05, 0.04, 0.005])
    post = trimesh.creation.box([0.03, 0.03, 0.02])
    post.apply_translation([0.002, 0.0, 0.0125])
    bore = cylinder(0.006, 0.02, sections=24)
    bore.apply_translation([0.002, 0.0, 0.0165])
    chamfer = cone(0.0225, 0.0225, sections=24)  # 45 degrees, 7 mm wide at the top, 6 mm one below
    chamfer.apply_transform(np.diag([1.0, -1.0, -1.0, 1.0]))
    chamfer.apply_translation([0.002, 0.0, 0.0225 - 0.007 + 0.0225])
    screw = cylinder(0.002, 0.02, sections=12)
    screw.apply_translation([-0.018, 0.01, 0.0])
    solid = trimesh.boolean.difference(
        [trimesh.boolean.union([foot, post], engine="manifold"), bore, chamfer, screw], engine="manifold"
    )
    turn = np.roll(np.eye(3), 1, axis=0)  # its z to the part's x
    part = Part("stepped", np.asarray(solid.vertices) @ turn.T, np.asarray(solid.faces))
    made = prismatic(part, axis="x", tolerance=1e-7)
    error = hausdorff_error(made, count=5000)
    assert error.added < 1e-6 and error.lost < 1e-6
    assert volume_of_union(made) == pytest.approx(solid.volume, rel=1e-5)
    with pytest.raises(InputError, match="walls along y"):
        prismatic(part, axis="y")


@pytest.mark.long
@pytest.mark.parametrize("shape", SHAPES)
def test_the_shipped_trays_and_pegs_are_within_5_um_of_their_meshes(shape: str) -> None:
    for part in (insert_tray(shape), insert_peg(shape)):
        error = hausdorff_error(part, count=1000)
        assert error.added <= 5.1e-6 and error.lost <= 5.1e-6
        assert "BSD-3" in part.source
        if NIST.is_dir():
            stem = f"{'tray_insert_' if 'tray' in part.name else ''}{shape}_peg_8mm"
            published = load_mesh(NIST / f"industreal_{stem}.obj")
            assert part.mesh.volume == pytest.approx(published.mesh.volume, rel=1e-6)
    bore = hole_of(insert_tray(shape)).outline
    assert bore.area == pytest.approx(math.pi * 0.0045**2 if shape == "round" else 0.009 * 0.008, rel=2e-3)


@nist_needed
@pytest.mark.parametrize("kind, edges", [("round", 36), ("rectangular", 72)])
def test_an_open_hole_plate_is_refused_with_its_open_edges(kind: str, edges: int) -> None:
    with pytest.raises(InputError, match=rf"{edges} open edges"):
        load_mesh(NIST / f"factory_{kind}_hole_8mm_subdiv_3x.obj")


def test_a_mesh_in_millimetres_is_refused_unless_scaled(tmp_path: Path) -> None:
    path = tmp_path / "block.stl"
    trimesh.creation.box([60.0, 60.0, 25.0]).export(path)
    with pytest.raises(InputError, match="in millimetres"):
        load_mesh(path)
    small = tmp_path / "cube.stl"
    trimesh.creation.box([2.0, 2.0, 2.0]).export(small)
    with pytest.raises(InputError, match=r"2 m long.*scale=0\.001"):
        load_mesh(small)
    assert load_mesh(small, scale=1.0).extent.max() == 2.0
    turned = trimesh.creation.box([0.06, 0.06, 0.025])
    turned.invert()
    turned.export(tmp_path / "turned.stl")
    with pytest.warns(RuntimeWarning, match="inside out"):
        assert load_mesh(tmp_path / "turned.stl").mesh.volume > 0
    part = load_mesh(path, scale=0.001)
    np.testing.assert_allclose(part.extent, [0.06, 0.06, 0.025])
    assert len(part.vertices) == 8
    with pytest.raises(InputError, match="there is no mesh file"):
        load_mesh(tmp_path / "none.obj")
    (tmp_path / "bad.obj").write_text("v 0 0\nf 1 2 nonsense\n")
    with pytest.raises(InputError, match=r"cannot be read|empty mesh"):
        load_mesh(tmp_path / "bad.obj")


def test_invalid_outlines_are_refused_in_one_sentence() -> None:
    square = named_outline("square")
    cases = {
        "Self-intersection": lambda: extruded("bow", shapely.Polygon([(0, 0), (1, 1), (1, 0), (0, 1)]), 0, 1),
        "millimetres": lambda: extruded("big", shapely.box(0, 0, 60, 60), 0, 25),
        "MultiPolygon": lambda: extruded("two", shapely.MultiPolygon([square]), 0, 1),
        "empty": lambda: extruded("none", shapely.Polygon(), 0, 1),
        "top above": lambda: extruded("flat", square, 0.0, 0.0),
        "does not lie inside": lambda: block_with_hole(square, offset=(0.025, 0.0)),
        "no peg": lambda: peg_for(square, 0.017, 0.05),
        "clearance": lambda: peg_for(square, -0.001, 0.05),
        "touches its border at": lambda: extruded(
            "rim", shapely.Polygon(BORDER, [[(0, 0), (0.01, -0.01), (0.01, 0.01)]]), 0, 0.1
        ),
        "touches another at": lambda: extruded(
            "pair",
            shapely.Polygon(
                BORDER,
                [
                    [(0.01, 0.0), (0.02, -0.01), (0.02, 0.01)],
                    [(0.02, 0.0), (0.03, -0.01), (0.03, 0.01)],
                ],
            ),
            0,
            0.1,
        ),
        "tolerance nan": lambda: prismatic(block((0.06, 0.06, 0.025)), tolerance=math.nan),
        "by up to 0.95 mm": lambda: check_fit(square, translate(named_outline("square", 0.0159), 0.001)),
        "no clearance": lambda: check_fit(square, square),
        "inside out": lambda: prismatic(replace(SOLID, faces=SOLID.faces[:, ::-1])),
        "by up to 0.707 mm": lambda: check_fit(square, named_outline("square", 0.017)),
        "no outline 'star'": lambda: named_outline("star"),
        "no insert tray": lambda: insert_tray("oval"),
    }
    for words, call in cases.items():
        with pytest.raises(InputError, match=words) as caught:
            call()
        assert "\n" not in str(caught.value) and str(caught.value).endswith(".")


def test_a_moved_part_is_the_same_solid_in_another_frame() -> None:
    hole = block_with_hole(named_outline("hexagon"))
    pegs = [box_peg(0.004, 0.05), cylinder_peg(0.004, 0.05)]
    askew = [0.01, -0.02, 0.03, *Rotation.from_rotvec([0.3, -0.7, 0.2]).as_quat()[[3, 0, 1, 2]]]
    quarter = [0.0, 0.0, -0.05, math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)]
    for part, pose in ((hole, askew), (pegs[0], askew), (pegs[0], quarter), (pegs[1], quarter)):
        moved = part.moved(pose)
        before, after = hausdorff_error(part, count=500).largest, hausdorff_error(moved, count=500).largest
        assert after == pytest.approx(before, abs=1e-9)
        expected = Rotation.from_quat(np.array(pose)[[4, 5, 6, 3]]).apply(part.vertices) + pose[:3]
        np.testing.assert_allclose(moved.vertices, expected, atol=1e-12)
    assert [pegs[0].moved(p).pieces[0].kind for p in (quarter, askew)] == ["box", "hull"]
    with pytest.raises(InputError, match="cylinder among its pieces"):
        pegs[1].moved(askew)
    raised = pegs[0].moved([0, 0, 0.05, 1, 0, 0, 0])  # with its origin at the tip, as in many files
    with pytest.warns(RuntimeWarning, match=r"wholly above its origin.*Part\.moved"):
        PegPhysics(hole, raised)


def test_contact_parameters_and_poses_that_are_not_finite_are_refused() -> None:
    for wrong in ({"friction": math.nan}, {"impedance": (math.nan,) * 5}, {"time_step": math.inf}):
        with pytest.raises(InputError, match=next(iter(wrong))):
            ContactParameters(**wrong)
    with pytest.raises(InputError, match="finite number above 0"):
        ContactParameters(time_step=10**400)
    physics = PegPhysics(SOLID, box_peg(0.004, 0.05))
    times, command = np.array([0.0, 0.01]), np.tile([0.0, 0, 0.1, 1, 0, 0, 0], (2, 1))
    probe = Probe("still", times, command, np.full(6, 100.0), np.full(6, 10.0), times)
    with pytest.raises(InputError, match="quaternion of length 0"):
        physics.start(np.zeros((2, 7)), probe)
    place = np.tile([0.0, 0, 0, 1, 0, 0, 0], (2, 1))
    rollout = physics.start(place, probe, Nuisances(friction=np.array([0.2, 0.4])))
    np.testing.assert_array_equal(rollout.nuisances["friction"], [0.2, 0.4])
