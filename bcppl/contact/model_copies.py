"""Copies of one MuJoCo model, one for each particle, that differ in what is unknown about a touch."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import NamedTuple

import mujoco
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

Array = npt.NDArray[np.float64]


class _Copy(NamedTuple):
    """A model and views of what is set in it: looking them up takes longer than setting them."""

    model: mujoco.MjModel
    friction: Array
    solref: Array
    bias: Array
    places: Array
    turns: Array
    boxes: Array


class ModelCopies:
    """Copies of a model from `bcppl.contact.peg_model`, made when first needed and set anew for each use.

    Args:
        model: what they are copies of, its controller set by `peg_model.hold`.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self.model = model
        peg = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, "peg")
        self._geoms = np.flatnonzero(np.asarray(model.geom_bodyid) == peg)
        first, count = int(model.body_bvhadr[peg]), int(model.body_bvhnum[peg])
        self._boxes = slice(first, first + count)
        self._inertial = np.array(model.body_ipos[peg]), _rotation(np.array(model.body_iquat[peg]))
        # One pool for each set of unknowns: what one program sets, another would not set back.
        self._pools: dict[frozenset[str], list[_Copy]] = {}

    def of(self, rows: Mapping[str, Array]) -> mujoco.MjModel | list[mujoco.MjModel]:
        """The models of N particles, valid until the next call; the one model where nothing is unknown.

        Args:
            rows: what is unknown, from `grasp.in_series`.
        """
        if not rows:
            return self.model
        particles = len(next(iter(rows.values())))
        pool = self._pools.setdefault(frozenset(rows), [])
        while len(pool) < particles:
            pool.append(self._copied())
        chosen = pool[:particles]
        if "stiffness" in rows:
            stiffness = self.model.actuator_biasprm[:, 1] * rows["stiffness"]
        if "damping" in rows:
            damping = self.model.actuator_biasprm[:, 2] * rows["damping"]
        if "grip_from_peg" in rows:
            places, turns, boxes = self._moved(rows["grip_from_peg"])
        for k, each in enumerate(chosen):
            if "friction" in rows:
                each.friction[:, 0] = rows["friction"][k]
            if "time_constant" in rows:
                each.solref[:, 0] = rows["time_constant"][k]
            if "damping_ratio" in rows:
                each.solref[:, 1] = rows["damping_ratio"][k]
            if "stiffness" in rows:
                each.bias[:, 1] = stiffness[k]
            if "damping" in rows:
                each.bias[:, 2] = damping[k]
            if "grip_from_peg" in rows:
                each.places[self._geoms], each.turns[self._geoms] = places[k], turns[k]
                each.boxes[self._boxes] = boxes[k]
        return [each.model for each in chosen]

    def _copied(self) -> _Copy:
        model = copy.copy(self.model)
        # A geom that the compiler found at a frame's place is put there whatever its own place says.
        model.geom_sameframe[self._geoms] = 0
        return _Copy(
            model,
            model.geom_friction,
            model.geom_solref,
            model.actuator_biasprm,
            model.geom_pos,
            model.geom_quat,
            model.bvh_aabb,
        )

    def _moved(self, grip_from_peg: Array) -> tuple[Array, Array, Array]:
        """Places (N, G, 3), quaternions (N, G, 4) and tree of boxes (N, B, 6) of geoms moved with the peg."""
        shift, turn = grip_from_peg[:, None, :3], _rotation(grip_from_peg[:, 3:])
        matrix = turn.as_matrix()
        places = shift + np.einsum("nij,gj->ngi", matrix, self.model.geom_pos[self._geoms])
        own = _rotation(np.array(self.model.geom_quat[self._geoms]))
        turns = np.stack([(turn * g).as_quat()[:, [3, 0, 1, 2]] for g in own], axis=1)
        # The tree is in the axes of the body's inertia, which stays where it is.
        origin, axes = self._inertial[0], self._inertial[1].as_matrix()
        tree = np.asarray(self.model.bvh_aabb[self._boxes])
        centers = shift + np.einsum("nij,bj->nbi", matrix, origin + tree[:, :3] @ axes.T)
        within = np.abs(np.einsum("ji,njk,kl->nil", axes, matrix, axes))
        boxes = [(centers - origin) @ axes, np.einsum("nij,bj->nbi", within, tree[:, 3:])]
        return places, turns, np.concatenate(boxes, axis=2)


def _rotation(quaternion: Array) -> Rotation:
    return Rotation.from_quat(quaternion[..., [1, 2, 3, 0]])
