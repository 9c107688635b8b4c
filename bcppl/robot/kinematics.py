"""Forward kinematics of a robot arm, for all particles and stamps in one batch.

Poses are computed by pytorch-kinematics (Zhong et al., PyTorch Kinematics, 2024, zenodo 7700587), in float64
and with gradients. Joint angles are radians, metres where a joint is prismatic; frames are named after the
links, and the base is the root link of the URDF file.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from bcppl import poses
from bcppl.arrays import Array
from bcppl.cached import cached_property
from bcppl.errors import InputError
from bcppl.geometry.parts import Part
from bcppl.robot.description import MOVING, Joint, chain_of, part_of, read
from bcppl.robot.joint_values import check_angles, check_offsets, held_values

Angles = Tensor | Array | Sequence[float]


class Robot:
    """A robot arm described by a URDF file.

    Attributes:
        name: of the robot.
        joints: the J independent joints, from the base outwards. Joints that mimic another are not among
            them, nor are fixed ones: those outside the chain from the base to `tip`, and those in `held`.
        links: names of all links, the base first.
        held: values of the joints that were given one, by name.
    """

    def __init__(
        self,
        file: str | Path,
        tip: str | None = None,
        held: Mapping[str, float] | None = None,
        geometry: Literal["visual", "collision"] = "visual",
        mesh_folders: str | Path | Sequence[str | Path] = (),
    ) -> None:
        """Read a URDF file; its meshes are read on first use.

        Args:
            file: the URDF file. Shipped ones: `bcppl.models.robots`.
            tip: a link; joints outside the chain from the base to it are fixed.
            held: values (radians, metres) of fixed joints; by default the value within the limits that is
                closest to zero.
            geometry: which of the links' shapes are drawn.
            mesh_folders: folders of meshes beside the URDF file's own; `package://NAME/...` is searched in
                each, with NAME and without.

        Raises:
            InputError: the file is missing or no URDF, a link or joint is unknown, or a joint is held at no
                number or far outside its limits.
        """
        self._description = read(file)
        self._geometry = geometry
        # A single path would be iterated by letters.
        folders = [mesh_folders] if isinstance(mesh_folders, str | Path) else mesh_folders
        self._mesh_folders = [Path(folder) for folder in folders]
        self.name = self._description.name
        self.links = self._description.links
        moving = {j.name: j for j in self._description.joints if j.kind in MOVING}
        self.held = held = held_values(self.name, moving, {} if held is None else held)
        for joint in moving.values():
            if joint.mimics is not None and joint.mimics[0] not in moving:
                raise InputError(
                    f"joint {joint.name!r} of {self.name} mimics {joint.mimics[0]!r}, which does not move."
                )
        chain = {j.name for j in (self._description.joints if tip is None else self._chain_to(tip))}
        self.joints: tuple[Joint, ...] = tuple(
            j for j in moving.values() if j.name in chain and j.mimics is None and j.name not in held
        )
        self._chain = chain_of(self._description)
        self._coupling, self._constant = self._couplings(moving, held)

    # ---- poses

    def base_from_links(
        self, angles: Angles, offsets: Angles | None = None, links: Sequence[str] = ()
    ) -> Tensor:
        """Poses of links.

        Args:
            angles: (..., J) measured joint angles.
            offsets: (N, J) joint offsets per particle, added to all of `angles` in one batch; (N, ..., J)
                where they vary over the stamps.
            links: names of K links; by default all, `self.links`.

        Returns:
            (..., K, 7), or (N, ..., K, 7) with offsets: `base_from_link` of each link, differentiable in
            angles and offsets.

        Raises:
            InputError: the angles or offsets have another number of joints, are not finite or so large that
                they are in degrees or millimetres, or a link is unknown.
        """
        frames = [self._chain.frame_to_idx[self._known(link)] for link in (links or self.links)]
        values = self._values(angles, offsets)
        all_values = values @ self._coupling.T + self._constant
        matrices = self._chain.forward_kinematics_tensor(all_values.reshape(-1, all_values.shape[-1]))[frames]
        pose = poses.from_rotation_matrix(matrices[..., :3, 3], matrices[..., :3, :3])
        return pose.movedim(0, -2).reshape(*values.shape[:-1], len(frames), 7)

    def base_from_link(
        self, link: str, angles: Angles, offsets: Angles | None = None, link_from_tool: Angles | None = None
    ) -> Tensor:
        """Poses of one link, or of a tool mounted on it, such as a peg or a camera.

        Args:
            link: its name.
            angles: as in `base_from_links`.
            offsets: as in `base_from_links`.
            link_from_tool: (7,) the tool's pose in the link's frame, or (N, 1, ..., 7) that broadcasts;
                by default the identity.

        Returns:
            (..., 7), or (N, ..., 7) with offsets.

        Raises:
            InputError: as `base_from_links`, or the tool's pose is not valid.
        """
        pose = self.base_from_links(angles, offsets, [link])[..., 0, :]
        if link_from_tool is None:
            return pose
        return poses.compose(pose, poses.as_pose(link_from_tool, f"the tool's pose on {link}"))

    def position(
        self,
        link: str,
        angles: Angles,
        offsets: Angles | None = None,
        point: Angles | None = None,
        errors: Angles | None = None,
    ) -> Tensor:
        """Positions of a point of a link in the base's frame, with kinematic errors of the arm.

        The point is transformed from joint to joint towards the base, at a tenth of the cost of link poses.

        Args:
            link: its name.
            angles: as in `base_from_links`.
            offsets: as in `base_from_links`.
            point: (3,) or (N, 3) in the link's frame, metres; by default its origin.
            errors: (N, J, 6) tangents from the joints' origins in the URDF file to the true ones: metres
                along the parent link's axes, then a rotation vector in the child link's frame at joint value
                zero.

        Returns:
            (..., 3), or (N, ..., 3) where an argument other than the angles is per particle; metres,
            differentiable in all arguments.

        Raises:
            InputError: as `base_from_links`.
        """
        number = {joint.name: k for k, joint in enumerate(self.joints)}
        position = _float64([0.0, 0.0, 0.0] if point is None else point)
        errors = None if errors is None else _float64(errors)
        values = self._values(angles, offsets)
        others = [x for x in (errors, position if position.ndim == 2 else None) if x is not None]
        if others and offsets is None:
            values = values.expand(len(others[0]), *values.shape)
        shape = values.shape[:-1]
        # One axis of particles and one of stamps: each joint is one batched matrix product.
        flat = (values @ self._coupling.T + self._constant).reshape(
            1 if offsets is None and not others else shape[0], -1, len(self._constant)
        )
        position = position.reshape(-1, 1, 3)
        names = self._chain.get_joint_parameter_names()
        for joint in reversed(self._chain_to(link)):
            if joint.kind in MOVING:
                position = _moved(joint, flat[..., names.index(joint.name)], position)
            parent_from_child = _pose(joint.parent_from_child)[None]
            if errors is not None and joint.name in number:
                parent_from_child = poses.retract(parent_from_child, errors[:, number[joint.name]])
            rotation = poses.rotation_matrix(parent_from_child)
            position = position @ rotation.transpose(-1, -2) + parent_from_child[:, None, :3]
        return position.expand(*flat.shape[:2], 3).reshape(*shape, 3)

    # ---- meshes

    @cached_property
    def parts(self) -> tuple[Part, ...]:
        """The links with a shape, each as a part in its link's frame, named after the link.

        Raises:
            InputError: a mesh is missing or unreadable.
        """
        shapes = getattr(self._description, self._geometry)
        return tuple(
            part_of(self._description, link, [s for s in shapes if s.link == link], self._mesh_folders)
            for link in self.links
            if any(s.link == link for s in shapes)
        )

    def base_from_parts(self, angles: Angles) -> Tensor:
        """Poses (..., K, 7) of `parts`, for a renderer of several parts.

        Raises:
            InputError: as `base_from_links`, or a mesh is missing.
        """
        return self.base_from_links(angles, links=[part.name for part in self.parts])

    def as_part(self, angles: Angles) -> Part:
        """The whole arm at angles (J,) as one rigid part in the base's frame.

        One part renders faster than eight, as long as the arm is stationary.

        Raises:
            InputError: as `base_from_links`, a mesh is missing, or no link has a shape.
        """
        if not self.parts:
            other = "collision" if self._geometry == "visual" else "visual"
            raise InputError(
                f'no link of {self.name} has a {self._geometry} shape to draw; give geometry="{other}".'
            )
        base_from_parts = self.base_from_parts(self._values(angles, None).reshape(len(self.joints)))
        vertices = [
            poses.transform(pose, torch.from_numpy(part.vertices)).numpy()
            for pose, part in zip(base_from_parts, self.parts, strict=True)
        ]
        starts = np.cumsum([0, *map(len, vertices)])
        faces = [part.faces + start for part, start in zip(self.parts, starts, strict=False)]
        return Part(self.name, np.concatenate(vertices), np.concatenate(faces), source=self.parts[0].source)

    def joint_to(self, link: str) -> Joint:
        """The joint that leads to a link, which may be a fixed one.

        Raises:
            InputError: the link is unknown, or is the base.
        """
        chain = self._chain_to(link)
        if not chain:
            raise InputError(f"{link!r} is the base of {self.name}, on which no joint leads; give another.")
        return chain[-1]

    # ---- checks and layout

    def _known(self, link: str) -> str:
        if link not in self.links:
            raise InputError(f"{self.name} has no link {link!r}; its links are {', '.join(self.links)}.")
        return link

    def _chain_to(self, link: str) -> list[Joint]:
        """The joints from the base to a link, the fixed ones included."""
        link = self._known(link)
        joint_of = {joint.child: joint for joint in self._description.joints}
        chain: list[Joint] = []
        while link in joint_of:
            chain.insert(0, joint_of[link])
            link = joint_of[link].parent
        return chain

    def _couplings(self, moving: Mapping[str, Joint], held: Mapping[str, float]) -> tuple[Tensor, Tensor]:
        """Matrix (F, J) and vector (F,) of the affine map from the J angles to all F joint values."""
        names = self._chain.get_joint_parameter_names()
        given = {joint.name: k for k, joint in enumerate(self.joints)}
        matrix = torch.zeros(len(names), len(self.joints), dtype=torch.float64)
        vector = torch.zeros(len(names), dtype=torch.float64)
        for row, name in enumerate(names):
            joint, factor, constant, seen = moving[name], 1.0, 0.0, {name}
            while joint.mimics is not None and joint.name not in held:
                mimicked, multiplier, offset = joint.mimics
                if mimicked in seen:
                    raise InputError(
                        f"joint {name!r} of {self.name} mimics itself; make one joint independent."
                    )
                seen.add(mimicked)
                joint, factor, constant = moving[mimicked], factor * multiplier, constant + factor * offset
            if joint.name in given:
                matrix[row, given[joint.name]] = factor
                vector[row] = constant
            else:
                value = held.get(joint.name, min(max(0.0, joint.lower), joint.upper))
                vector[row] = factor * value + constant
        return matrix, vector

    def _values(self, angles: Angles, offsets: Angles | None) -> Tensor:
        """Angles with offsets, (..., J) or (N, ..., J), checked."""
        count = len(self.joints)
        values = _float64(angles)
        if values.ndim == 0 or values.shape[-1] != count:
            raise self._shape_error("angles", values, f"(..., {count})")
        check_angles(self.name, self.joints, values)
        if offsets is None:
            return values
        offsets = _float64(offsets)
        if offsets.shape[1:] not in (values.shape, values.shape[-1:]):
            raise self._shape_error("offsets", offsets, f"(N, {count}) or (N, *angles.shape)")
        check_offsets(self.name, self.joints, offsets)
        if offsets.ndim == 2 and values.ndim > 1:
            offsets = offsets.reshape(len(offsets), *[1] * (values.ndim - 1), count)
        return values + offsets

    def _shape_error(self, kind: str, values: Tensor, shape: str) -> InputError:
        names = ", ".join(joint.name for joint in self.joints)
        return InputError(
            f"joint {kind} of {self.name} have shape {tuple(values.shape)}; "
            f"give {shape}, in the order {names}, or name a tip."
        )


def _float64(given: Angles) -> Tensor:
    return torch.as_tensor(given, dtype=torch.float64)


def _pose(matrix: Array) -> Tensor:
    """The pose (7,) of a transformation (4, 4)."""
    return poses.from_rotation_matrix(torch.from_numpy(matrix[:3, 3]), torch.from_numpy(matrix[:3, :3]))


def _moved(joint: Joint, value: Tensor, point: Tensor) -> Tensor:
    """Points (..., 3) transformed by a joint at values (...), by Rodrigues' formula."""
    axis = torch.from_numpy(joint.axis)
    if joint.kind == "prismatic":
        return point + value[..., None] * axis
    cosine, sine = torch.cos(value)[..., None], torch.sin(value)[..., None]
    across = torch.linalg.cross(axis.expand(point.shape), point)
    return point * cosine + across * sine + axis * (point @ axis)[..., None] * (1.0 - cosine)
