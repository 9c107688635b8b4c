"""Robot descriptions from URDF files: links, joints, limits and meshes.

The format is that of ROS, wiki.ros.org/urdf/XML; the parser is the one that comes with pytorch-kinematics.
"""

from __future__ import annotations

import contextlib
import io
import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from pytorch_kinematics import chain, frame, transforms
from pytorch_kinematics.urdf_parser_py import urdf
from scipy.spatial.transform import Rotation

from bcppl.arrays import Array
from bcppl.errors import InputError, reason_of
from bcppl.geometry.mesh_file import read_mesh
from bcppl.geometry.parts import Part
from bcppl.untrusted.plain_xml import refuse_entities

MOVING = ("revolute", "continuous", "prismatic")
LARGEST = 4 << 20  # bytes of a URDF file: links in memory take tens of times as many
MESHES = (".stl", ".obj", ".dae", ".ply")


@dataclass(frozen=True, eq=False)
class Joint:
    """One joint of a robot.

    Attributes:
        name: as in the URDF file.
        kind: "revolute", "continuous", "prismatic" or "fixed".
        parent, child: names of the links it joins.
        parent_from_child: (4, 4) transformation at joint value zero.
        axis: (3,) of unit length, in the child's frame.
        lower, upper: joint limits in radians (metres where prismatic); infinite where there are none.
        mimics: the joint that it mimics, with multiplier and offset; None for an independent joint.
    """

    name: str
    kind: str
    parent: str
    child: str
    parent_from_child: Array
    axis: Array
    lower: float = -math.inf
    upper: float = math.inf
    mimics: tuple[str, float, float] | None = None


@dataclass(frozen=True, eq=False)
class Shape:
    """A mesh, box, cylinder or sphere, as parsed, and its transformation (4, 4) in its link's frame."""

    link: str
    link_from_shape: Array
    geometry: Any


@dataclass(frozen=True, eq=False)
class Description:
    """The content of a URDF file; links and joints are ordered from the base, each after its parent."""

    name: str
    file: Path
    links: tuple[str, ...]
    joints: tuple[Joint, ...]
    visual: tuple[Shape, ...]
    collision: tuple[Shape, ...]


def read(file: str | Path) -> Description:
    """The description in a URDF file.

    Raises:
        InputError: the file is missing or no URDF, its links do not form one tree, or a joint is of a kind
            that is not supported.
    """
    file = Path(file)
    if not file.is_file():
        raise InputError(f"{file} is missing; give a robot's URDF file.")
    ignored = io.StringIO()
    try:
        # The parser prints unknown elements (transmissions, xacro) to standard error.
        with contextlib.redirect_stderr(ignored), contextlib.redirect_stdout(ignored):
            if file.stat().st_size > LARGEST:
                raise ValueError(f"it is larger than {LARGEST >> 20} MB")
            text = file.read_bytes()
            refuse_entities(text)
            robot = urdf.URDF.from_xml_string(text)
        for kind, named in (("joint", robot.joints), ("link", robot.links)):
            for name, count in Counter(each.name for each in named).items():
                if count > 1:
                    raise InputError(f"{file} has two {kind}s of the name {name!r}; rename one.")
        links = {link.name: link for link in robot.links}
        joints = {j.child: _joint(j) for j in robot.joints}
        ordered = _ordered(file, list(links), joints, len(robot.joints))
        named = [(name, links[name]) for name in ordered]
        return Description(
            name=robot.name or file.stem,
            file=file,
            links=tuple(ordered),
            joints=tuple(joints[name] for name in ordered if name in joints),
            visual=tuple(_shape(n, s) for n, link in named for s in link.visuals if s.geometry is not None),
            collision=tuple(
                _shape(n, s) for n, link in named for s in link.collisions if s.geometry is not None
            ),
        )
    except InputError as error:
        raise (error if str(file) in str(error) else InputError(f"{file}: {error}")) from error
    except Exception as error:  # the parser raises ParseError, XMLSyntaxError, AssertionError, ValueError
        reason = reason_of(error)
        raise InputError(
            f"{file} cannot be read as a URDF ({reason}); "
            "give the robot's URDF file, expanded where it is a xacro."
        ) from error


def _ordered(file: Path, links: Sequence[str], joints: Mapping[str, Joint], count: int) -> list[str]:
    """The links, each after its parent, the base first."""
    roots = [name for name in links if name not in joints]
    if unknown := ({j.parent for j in joints.values()} | set(joints)) - set(links):
        raise InputError(
            f"{file} has a joint to the link {min(unknown)!r}, which it does not define; add the link."
        )
    children: dict[str, list[str]] = {}
    for child, joint in joints.items():
        children.setdefault(joint.parent, []).append(child)
    ordered = roots[:1]
    for name in ordered:
        ordered += children.get(name, [])
    if len(roots) != 1 or len(ordered) != len(links) or count != len(joints):
        raise InputError(
            f"{file} does not describe one tree of links (base links: {', '.join(roots) or 'none'}); "
            "give each link but the base exactly one joint to its parent."
        )
    return ordered


def _joint(parsed: Any) -> Joint:
    if parsed.type not in (*MOVING, "fixed"):
        raise InputError(
            f"joint {parsed.name!r} is {parsed.type}; make it revolute, continuous, prismatic or fixed."
        )
    axis = np.array([1.0, 0.0, 0.0] if parsed.axis is None else parsed.axis, dtype=np.float64)
    length = float(np.linalg.norm(axis))
    if parsed.type == "fixed":
        axis, length = np.array([0.0, 0.0, 1.0]), 1.0
    if not 0.0 < length < math.inf:
        raise InputError(f"joint {parsed.name!r} has the axis {axis.tolist()}; give it a direction.")
    bounded = parsed.type in ("revolute", "prismatic") and parsed.limit is not None
    mimics = None
    if parsed.mimic is not None:
        multiplier, offset = parsed.mimic.multiplier, parsed.mimic.offset
        mimics = (
            str(parsed.mimic.joint),
            1.0 if multiplier is None else float(multiplier),
            0.0 if offset is None else float(offset),
        )
    lower = float(parsed.limit.lower) if bounded else -math.inf
    upper = float(parsed.limit.upper) if bounded else math.inf
    if not lower <= upper or any(math.isnan(number) for number in (mimics or ())[1:]):
        raise InputError(
            f"joint {parsed.name!r} has limits {lower:g} to {upper:g} and mimics {mimics}; correct these."
        )
    return Joint(
        name=parsed.name,
        kind=parsed.type,
        parent=parsed.parent,
        child=parsed.child,
        parent_from_child=_transformation(f"joint {parsed.name!r}", parsed.origin),
        axis=axis / length,
        lower=lower,
        upper=upper,
        mimics=mimics,
    )


def _transformation(whose: str, origin: Any) -> Array:
    matrix = np.eye(4)
    if origin is not None:
        matrix[:3, 3] = [0.0, 0.0, 0.0] if origin.xyz is None else origin.xyz
        # Roll, pitch and yaw are about the parent's fixed axes.
        angles = [0.0, 0.0, 0.0] if origin.rpy is None else origin.rpy
        if not (np.isfinite(matrix[:3, 3]).all() and np.isfinite(angles).all()):
            raise InputError(
                f"the origin of {whose} has xyz {matrix[:3, 3].tolist()} and rpy {list(angles)}; "
                "give finite numbers, metres and radians."
            )
        matrix[:3, :3] = Rotation.from_euler("xyz", angles).as_matrix()
    return matrix


def _shape(link: str, parsed: Any) -> Shape:
    return Shape(link, _transformation(f"a shape of link {link!r}", parsed.origin), parsed.geometry)


def chain_of(description: Description) -> Any:
    """The kinematic chain of pytorch-kinematics in float64; its own reader rounds to single precision."""
    frames = {link: frame.Frame(link, link=frame.Link(link)) for link in description.links}
    frames[description.links[0]].joint = frame.Joint()
    for joint in description.joints:
        child = frames[joint.child]
        child.joint = frame.Joint(
            joint.name,
            offset=transforms.Transform3d(
                matrix=torch.from_numpy(joint.parent_from_child), dtype=torch.float64
            ),
            joint_type="revolute" if joint.kind == "continuous" else joint.kind,
            axis=torch.from_numpy(joint.axis),
            dtype=torch.float64,
        )
        frames[joint.parent].children.append(child)
    return chain.Chain(frames[description.links[0]], dtype=torch.float64)


def part_of(description: Description, link: str, shapes: Sequence[Shape], folders: Sequence[Path]) -> Part:
    """The shapes of one link as one part, in the link's frame.

    Raises:
        InputError: a mesh is missing, unreadable, or not in metres.
    """
    meshes = [_mesh(description, s, folders).apply_transform(s.link_from_shape) for s in shapes]
    whole: Any = trimesh.util.concatenate(meshes)
    part = Part(
        name=link,
        vertices=np.asarray(whole.vertices, dtype=np.float64),
        faces=np.asarray(whole.faces, dtype=np.int64),
        source=f"link of {description.name}; licence as of {description.file.name}",
    )
    try:
        part.check(closed=False)
    except InputError as error:
        raise InputError(f"{description.file}: {error}") from error
    return part


def _mesh(description: Description, shape: Shape, folders: Sequence[Path]) -> Any:
    geometry = shape.geometry
    if isinstance(geometry, urdf.Box):
        return trimesh.creation.box(geometry.size)
    if isinstance(geometry, urdf.Cylinder):
        return trimesh.creation.cylinder(geometry.radius, geometry.length)
    if isinstance(geometry, urdf.Sphere):
        return trimesh.creation.icosphere(3, geometry.radius)
    if not isinstance(geometry, urdf.Mesh):
        raise InputError(
            f"link {shape.link!r} of {description.file} has a shape that is no mesh, box, cylinder or sphere."
        )
    tried = list(_candidates(description, geometry.filename, folders))
    file = next((path for path in tried if path.is_file()), None)
    others = [] if file is not None else list(dict.fromkeys(_other_formats(tried)))
    # A scale states the unit of the named file, and another format may be in another unit.
    if len(others) == 1 and (geometry.scale is None or np.allclose(geometry.scale, 1.0)):
        file = others[0]
    if file is None:
        searched = ", ".join(dict.fromkeys(str(path.parent) for path in tried))
        advice = "put it there, or name its folder with mesh_folders"
        if others:
            advice = (
                f"there is {', '.join(map(str, others))}: name that in the URDF file, with the scale that "
                "converts it to metres"
            )
        raise InputError(
            f"link {shape.link!r} of {description.file} needs the mesh {geometry.filename}, "
            f"which is in none of {searched}; {advice}."
        )
    mesh = read_mesh(file, process=True)  # which also places the nodes of a scene (DAE) and converts its unit
    mesh = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    if geometry.scale is not None:
        mesh.apply_scale(geometry.scale)
    return mesh


def _other_formats(tried: Sequence[Path]) -> Iterator[Path]:
    """Mesh files that differ from the ones tried only in the extension."""
    for path in tried:
        if path.parent.is_dir():
            files = sorted(file for file in path.parent.iterdir() if file.is_file())
            yield from (f for f in files if f.stem == path.stem and f.suffix.lower() in MESHES)


def _candidates(description: Description, name: str, folders: Sequence[Path]) -> Iterator[Path]:
    """Paths at which a mesh may be, the likeliest first."""
    here = description.file.parent
    if name.startswith("package://"):
        inside = Path(name.removeprefix("package://"))
        for folder in (*folders, here):
            yield folder / inside
            yield folder / Path(*(inside.parts[1:] or inside.parts))
        return
    plain = Path(name.removeprefix("file://"))
    yield here / plain
    if not plain.is_absolute():
        yield from (folder / plain for folder in folders)
