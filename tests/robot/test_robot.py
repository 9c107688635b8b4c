"""Robots: poses against an independent computation, one batch against a loop, and invalid input."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from bcppl import poses
from bcppl.errors import InputError
from bcppl.geometry.camera import Camera, looking_at
from bcppl.models.robots import SHIPPED, load_robot
from bcppl.rendering.ray_casting import RayCaster
from bcppl.robot.inverse_kinematics import joint_paths
from bcppl.robot.kinematics import Robot

FOLDER = Path(__file__).parents[2] / "models/robots"
FLANGE = {"panda": "panda_hand", "iiwa": "lbr_iiwa_flange"}
# Franka's own Denavit-Hartenberg table (Craig's convention): a, d, alpha of joints 1 to 7.
PANDA = (
    (0.0, 0.333, 0.0),
    (0.0, 0.0, -math.pi / 2),
    (0.0, 0.316, math.pi / 2),
    (0.0825, 0.0, math.pi / 2),
    (-0.0825, 0.384, -math.pi / 2),
    (0.0, 0.0, math.pi / 2),
    (0.088, 0.0, math.pi / 2),
)


@pytest.fixture(scope="module", params=SHIPPED)
def robot(request: pytest.FixtureRequest) -> Robot:
    return load_robot(request.param, tip=FLANGE[request.param])


def postures(robot: Robot, *shape: int, seed: int = 0) -> Tensor:
    low, high = (torch.tensor([getattr(j, k) for j in robot.joints]) for k in ("lower", "upper"))
    drawn = torch.rand(*shape, len(robot.joints), generator=torch.Generator().manual_seed(seed))
    return (low + (high - low) * drawn).to(torch.float64)


def same(a: Tensor, b: Tensor, within: float = 1e-12) -> bool:
    return float(poses.local(a, b).abs().max()) < within


def test_panda_follows_its_table_of_denavit_and_hartenberg() -> None:
    panda = load_robot("panda", tip="panda_link7")
    for angles in postures(panda, 5):
        whole = np.eye(4)
        for (a, d, alpha), angle in zip(PANDA, angles.tolist(), strict=True):
            before, after = np.eye(4), np.eye(4)
            before[:3, :3], before[0, 3] = Rotation.from_euler("x", alpha).as_matrix(), a
            after[:3, :3], after[2, 3] = Rotation.from_euler("z", angle).as_matrix(), d
            whole = whole @ before @ after
        expected = poses.from_rotation_matrix(torch.from_numpy(whole[:3, 3]), torch.from_numpy(whole[:3, :3]))
        assert same(panda.base_from_link("panda_link7", angles), expected)


@pytest.mark.parametrize("name", SHIPPED)
def test_poses_are_those_of_mujoco(name: str) -> None:
    robot = load_robot(name)
    text = (FOLDER / name / f"{name}.urdf").read_text()
    text = re.sub(r"<(visual|collision|inertial)>.*?</\1>", "", text, flags=re.S)
    for link in robot.links[1:]:
        mass = (
            '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
        )
        text = re.sub(rf'<link name="{link}"\s*(/>|>\s*</link>)', f'<link name="{link}">{mass}</link>', text)
    text = re.sub(
        r"(<robot[^>]*>)",
        r'\1<mujoco><compiler fusestatic="false" boundmass="1" boundinertia="1"/></mujoco>',
        text,
    )
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    angles = postures(robot, 1)[0]
    for joint, value in zip(robot.joints, angles.tolist(), strict=True):
        data.qpos[model.jnt_qposadr[model.joint(joint.name).id]] = value
    if name == "panda":
        data.qpos[model.jnt_qposadr[model.joint("panda_finger_joint2").id]] = float(angles[-1])
    mujoco.mj_forward(model, data)
    for link, pose in zip(robot.links[1:], robot.base_from_links(angles)[1:], strict=True):
        body = data.body(link)
        assert same(pose, torch.from_numpy(np.concatenate([body.xpos, body.xquat])), 1e-9), link


def test_one_batch_is_a_loop_and_offsets_are_shifted_angles(robot: Robot) -> None:
    angles, offsets = postures(robot, 2, 3), 0.02 * torch.randn(4, len(robot.joints), dtype=torch.float64)
    together = robot.base_from_links(angles, offsets)
    assert together.shape == (4, 2, 3, len(robot.links), 7)
    one_by_one = [[[robot.base_from_links(q + o) for q in row] for row in angles] for o in offsets]
    assert same(together, torch.stack([torch.stack([torch.stack(r) for r in p]) for p in one_by_one]))
    changing = offsets[:, None, None].expand(-1, 2, 3, -1)
    assert same(robot.base_from_links(angles, changing), together)
    tip = robot.links[-1]
    assert torch.allclose(robot.position(tip, angles, offsets), together[..., -1, :3], atol=1e-13)


def test_kinematic_errors_are_those_of_a_modified_file(tmp_path: Path) -> None:
    panda = load_robot("panda", tip="panda_hand_tcp")
    angles = postures(panda, 3)
    errors = 0.01 * torch.randn(2, 7, 6, dtype=torch.float64)
    point = 0.1 * torch.randn(2, 3, dtype=torch.float64)
    position = panda.position("panda_hand_tcp", angles, point=point, errors=errors)
    for particle in range(2):
        text = (FOLDER / "panda/panda.urdf").read_text()
        for joint, error in zip(panda.joints, errors[particle].numpy(), strict=True):
            turn = Rotation.from_matrix(joint.parent_from_child[:3, :3]) * Rotation.from_rotvec(error[3:])
            shift = joint.parent_from_child[:3, 3] + error[:3]
            numbers = [" ".join(map(repr, map(float, v))) for v in (turn.as_euler("xyz"), shift)]
            head, tail = text.split(f'<joint name="{joint.name}"', 1)
            tail = re.sub(
                r"<origin [^>]*/>", f'<origin rpy="{numbers[0]}" xyz="{numbers[1]}"/>', tail, count=1
            )
            text = f'{head}<joint name="{joint.name}"{tail}'
        (tmp_path / "changed.urdf").write_text(text)
        changed = Robot(tmp_path / "changed.urdf", tip="panda_hand_tcp")
        pose = changed.base_from_link("panda_hand_tcp", angles)
        expected = torch.stack([poses.transform(p, point[particle][None])[0] for p in pose])
        assert torch.allclose(position[particle], expected, atol=1e-12)


def test_gradients_are_finite_differences(robot: Robot) -> None:
    angles, tip = postures(robot, 2), robot.links[-1]
    joints = len(robot.joints)
    given = [torch.zeros(2, n, dtype=torch.float64).requires_grad_() for n in (joints, 3)]
    errors = torch.zeros(2, joints, 6, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(
        lambda o, p, e: robot.position(tip, angles, o, p, e + 1e-3), (*given, errors), fast_mode=True
    )
    assert torch.autograd.gradcheck(lambda o: robot.base_from_link(tip, angles, o), given[:1], fast_mode=True)


def test_mimicking_joints_follow_and_held_joints_stay() -> None:
    panda = load_robot("panda")
    assert [j.name for j in panda.joints][-1] == "panda_finger_joint1"
    fingers = panda.base_from_links(
        [0.0, 0, 0, -1, 0, 1, 0, 0.03], links=["panda_leftfinger", "panda_rightfinger"]
    )
    assert float((fingers[0, :3] - fingers[1, :3]).norm()) == pytest.approx(0.06)
    held = load_robot("panda", held={"panda_finger_joint1": 0.03})
    again = held.base_from_links([0.0, 0, 0, -1, 0, 1, 0], links=["panda_leftfinger"])
    assert same(again, fingers[:1])


FOLLOWED = """<robot name="geared"><link name="base"/><link name="upper"/><link name="lower"/>
<link name="tip"/>
<joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 0 1"/>
<limit lower="-2" upper="2" effort="1" velocity="1"/></joint>
<joint name="elbow" type="revolute"><parent link="upper"/><child link="lower"/><origin xyz="0.3 0 0"/>
<axis xyz="0 0 1"/><limit lower="LOWER" upper="0.5" effort="1" velocity="1"/>
<mimic joint="shoulder" multiplier="-2" offset="0.1"/></joint>
<joint name="end" type="fixed"><parent link="lower"/><child link="tip"/><origin xyz="0.2 0 0"/></joint>
</robot>"""


def test_paths_are_within_the_limits_of_mimicking_joints(tmp_path: Path) -> None:
    """The elbow, at 0.1 - 2 q, may be between -1 and 0.5: the shoulder between -0.2 and 0.55."""
    (tmp_path / "geared.urdf").write_text(FOLLOWED.replace("LOWER", "-1"))
    geared = Robot(tmp_path / "geared.urdf", tip="tip")
    angles = torch.tensor([-0.6, -0.25, -0.15, 0.5, 0.6, 1.5], dtype=torch.float64)[:, None]
    paths = joint_paths(geared, "tip", geared.base_from_link("tip", angles)[:, None].numpy())[:, 0]
    assert np.isfinite(paths[:, 0]).tolist() == [False, False, True, True, False, False]
    assert np.abs(paths - angles.numpy())[2:4].max() < 0.01
    outside = geared.base_from_link("tip", angles[4:5])[:, None].numpy()
    assert np.isnan(joint_paths(geared, "tip", outside, near=np.array([0.6]))).all()
    (tmp_path / "geared.urdf").write_text(FOLLOWED.replace("LOWER", "-1").replace('"0.1"', '"9"'))
    with pytest.raises(InputError, match="no value of joint 'shoulder' of geared is within its limits"):
        joint_paths(Robot(tmp_path / "geared.urdf", tip="tip"), "tip", poses.identity(1)[None].numpy())


def test_a_joint_that_is_held_follows_and_limits_no_other(tmp_path: Path) -> None:
    (tmp_path / "geared.urdf").write_text(FOLLOWED.replace("LOWER", "-1"))
    geared = Robot(tmp_path / "geared.urdf", tip="tip", held={"elbow": 0.0})
    angles = torch.tensor([[-0.6], [1.5]], dtype=torch.float64)
    paths = joint_paths(geared, "tip", geared.base_from_link("tip", angles)[:, None].numpy())[:, 0]
    np.testing.assert_allclose(paths, angles.numpy(), atol=0.01)


def test_a_wrist_camera_moves_with_the_wrist(robot: Robot) -> None:
    angles = postures(robot, 4)
    wrist_from_camera = poses.as_pose([0.05, 0.0, 0.03, 0.0, 1.0, 0.0, 0.0])
    wrist = robot.base_from_link(robot.links[-1], angles)
    camera = robot.base_from_link(robot.links[-1], angles, link_from_tool=wrist_from_camera)
    assert same(poses.compose(poses.inverse(wrist), camera), wrist_from_camera.expand(4, 7))


def test_the_arm_as_one_part_is_rendered_as_its_links_are(robot: Robot) -> None:
    angles = postures(robot, 1, seed=3)[0]
    camera = Camera("c", 64, 48, 60.0, 60.0, 32.0, 24.0, looking_at([1.8, 0.4, 0.6], [0.0, 0.0, 0.5]))
    links = [
        RayCaster(part).images(camera, pose[None])[0]
        for part, pose in zip(robot.parts, robot.base_from_parts(angles), strict=True)
    ]
    whole = RayCaster(robot.as_part(angles)).images(camera, poses.identity(1))[0]
    assert np.isfinite(whole).sum() > 100
    assert np.array_equal(np.isfinite(whole), np.isfinite(np.min(links, axis=0)))
    seen = np.isfinite(whole)
    assert np.allclose(whole[seen], np.min(links, axis=0)[seen], atol=1e-5)


# ---- invalid input


URDF = """<robot name="arm"><link name="base"/>
<link name="hand"><visual><geometry>{shape}</geometry></visual></link>
<joint name="elbow" type="{kind}"><parent link="{parent}"/><child link="hand"/><axis xyz="{axis}"/>
<limit lower="-2" upper="2" effort="1" velocity="1"/></joint></robot>"""


def written(folder: Path, **parts: str) -> Path:
    known = {"shape": '<box size="1 1 1"/>', "kind": "revolute", "parent": "base", "axis": "0 0 1", **parts}
    (folder / "arm.urdf").write_text(URDF.format(**known))
    return folder / "arm.urdf"


def refusal(call: Callable[[], object]) -> str:
    """The one sentence with which a call is refused."""
    with pytest.raises(InputError) as caught:
        call()
    text = str(caught.value)
    assert text.endswith(".") and "\n" not in text and "Traceback" not in text
    return text


def test_a_missing_mesh_is_named_with_the_folders_searched(tmp_path: Path) -> None:
    file = written(tmp_path, shape='<mesh filename="package://arm_description/meshes/hand.stl"/>')
    robot = Robot(file, mesh_folders=[tmp_path / "packages"])
    assert robot.base_from_link("hand", [0.5]).shape == (7,)  # poses need no mesh
    text = refusal(lambda: robot.parts)
    for word in ("hand.stl", str(tmp_path / "packages/arm_description/meshes"), "'hand'", "mesh_folders"):
        assert word in text


@pytest.mark.parametrize("folder", ["arm_description/meshes", "meshes"])
def test_meshes_of_a_package_are_read_from_its_folder(tmp_path: Path, folder: str) -> None:
    place = tmp_path / "packages" / folder
    place.mkdir(parents=True)
    (place / "hand.stl").write_bytes((FOLDER / "panda/meshes/hand.stl").read_bytes())
    shape = '<mesh filename="package://arm_description/meshes/hand.stl" scale="0.5 0.5 0.5"/>'
    robot = Robot(written(tmp_path, shape=shape), mesh_folders=[tmp_path / "packages"])
    assert robot.parts[0].extent == pytest.approx([0.0316, 0.102, 0.046], abs=1e-3)


def test_a_mesh_in_another_format_is_used_unless_a_scale_states_its_unit(tmp_path: Path) -> None:
    (tmp_path / "hand.stl").write_bytes((FOLDER / "panda/meshes/hand.stl").read_bytes())
    robot = load_robot(written(tmp_path, shape='<mesh filename="hand.obj"/>'))
    assert robot.parts[0].extent == pytest.approx([0.0632, 0.204, 0.092], abs=2e-3)
    scaled = written(tmp_path, shape='<mesh filename="hand.obj" scale="0.001 0.001 0.001"/>')
    assert str(tmp_path / "hand.stl") in refusal(lambda: load_robot(scaled).parts)
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "hand.stl").rename(tmp_path / "elsewhere/hand.stl")
    file = written(tmp_path, shape='<mesh filename="package://arm/hand.stl"/>')
    assert len(load_robot(file, mesh_folders=tmp_path / "elsewhere").parts) == 1


@pytest.mark.parametrize(
    ("parts", "word"),
    [
        ({"axis": '0 0 1"/><origin xyz="0 nan 0'}, "'elbow'"),
        ({"shape": '<box size="1 1 1"/></geometry><origin rpy="0 nan 0"/><geometry>'}, "link 'hand'"),
        ({"axis": '0 0 1"/><mimic joint="elbow" multiplier="nan'}, "mimics"),
        (
            {"parent": 'base"/><child link="x"/></joint><joint name="elbow" type="fixed"><parent link="base'},
            "two",
        ),
        ({"kind": "floating"}, "floating"),
        ({"parent": "shoulder"}, "'shoulder'"),
        ({"axis": "0 0 0"}, "axis"),
        ({"parent": "hand"}, "one tree"),
        ({"kind": 'revolute"><oops'}, "cannot be read"),
    ],
)
def test_an_invalid_urdf_is_refused(tmp_path: Path, parts: dict[str, str], word: str) -> None:
    assert word in refusal(lambda: Robot(written(tmp_path, **parts)))


@pytest.mark.parametrize(
    ("angles", "word"),
    [
        (torch.zeros(8), "(..., 7)"),
        (torch.tensor([0.0, 20, 0, -90, 0, 90, 45]), "degrees"),
        (torch.tensor([0.0, math.nan, 0, -1, 0, 1, 0]), "panda_joint2"),
        (torch.zeros(()), "(..., 7)"),
    ],
)
def test_invalid_angles_are_refused(angles: Tensor, word: str) -> None:
    panda = load_robot("panda", tip="panda_hand")
    assert word in refusal(lambda: panda.base_from_links(angles))


def test_unknown_files_links_joints_and_shapes_are_refused(tmp_path: Path) -> None:
    (tmp_path / "solid.urdf").write_text("solid")
    panda = load_robot("panda", tip="panda_hand")
    angles = torch.tensor([0.0, 0, 0, -1, 0, 1, 0], dtype=torch.float64)
    for call in (
        lambda: Robot(tmp_path / "solid.urdf"),
        lambda: Robot(tmp_path),
        lambda: load_robot("pander"),
        lambda: load_robot("panda", tip="panda_foot"),
        lambda: load_robot("panda", held={"panda_joint9": 0.0}),
        lambda: panda.base_from_link("panda_hand", angles, link_from_tool=[0.0, 0, 0, 2, 0, 0, 0]),
        lambda: panda.base_from_link("panda_foot", angles),
        lambda: panda.position("panda_foot", angles),
        lambda: panda.base_from_links(angles, torch.zeros(3, 6).double()),
    ):
        refusal(call)
    shapeless = load_robot(written(tmp_path), geometry="collision")
    assert 'geometry="visual"' in refusal(lambda: shapeless.as_part([0.0]))


@pytest.mark.parametrize(
    ("held", "word"),
    [
        ({"panda_joint1": 90.0}, "degrees"),
        ({"panda_finger_joint1": 30.0}, "millimetres"),
        ({"panda_joint1": math.nan}, "panda_joint1"),
    ],
)
def test_held_values_are_numbers_in_the_right_unit(held: Any, word: str) -> None:
    assert word in refusal(lambda: load_robot("panda", held=held))


@pytest.mark.parametrize(
    ("joint", "offset", "word"), [(0, math.nan, "panda_joint1"), (3, 5.0, "degrees"), (7, 0.5, "millimetres")]
)
def test_offsets_are_numbers_in_the_right_unit(joint: int, offset: float, word: str) -> None:
    panda = load_robot("panda")
    offsets = torch.zeros(4, 8, dtype=torch.float64)
    offsets[:, joint] = offset
    angles = [0.0, 0, 0, -1, 0, 1, 0, 0.03]
    assert word in refusal(lambda: panda.base_from_links(angles, offsets))
    assert word in refusal(lambda: panda.position("panda_hand", angles, offsets))


def test_lists_arrays_and_single_precision_are_accepted(robot: Robot) -> None:
    angles, tip = postures(robot, 2), robot.links[-1]
    offsets = torch.full((3, 7), 2.0**-6)
    tool = torch.tensor([0.0, 0.0, 0.125, 0.0, 1.0, 0.0, 0.0])
    expected = robot.base_from_link(tip, angles, offsets.double(), tool.double())
    assert expected.dtype == torch.float64
    for given in (offsets.tolist(), offsets.numpy(), offsets):
        assert torch.equal(robot.base_from_link(tip, angles.tolist(), given, tool), expected)
        assert torch.equal(
            robot.position(tip, angles, given, tool[:3].tolist()),
            robot.position(tip, angles, offsets.double(), tool[:3].double()),
        )
