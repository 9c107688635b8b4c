"""Copies of one MuJoCo model, one for each particle, that differ in nuisance parameters."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import NamedTuple

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from bcppl.arrays import Array

# The column of a model's array that holds a parameter.
_COLUMNS = {
    "friction": ("friction", 0),
    "time_constant": ("solref", 0),
    "damping_ratio": ("solref", 1),
    "stiffness": ("bias", 1),
    "damping": ("bias", 2),
}


class _Copy(NamedTuple):
    """A model and views of its arrays: looking them up takes longer than setting them."""

    model: mujoco.MjModel
    friction: Array
    solref: Array
    bias: Array
    places: Array
    turns: Array
    boxes: Array


class ParticleModels:
    """Copies of a model from `bcppl.contact.mujoco_model`, made on first use and set on each use.

    Args:
        model: the original, its controller set by `mujoco_model.set_controller`.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self.model = model
        peg = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, "peg")
        self._geoms = np.flatnonzero(np.asarray(model.geom_bodyid) == peg)
        first, count = int(model.body_bvhadr[peg]), int(model.body_bvhnum[peg])
        self._boxes = slice(first, first + count)
        self._inertial = np.array(model.body_ipos[peg]), _rotation(np.array(model.body_iquat[peg]))
        # One pool for each set of parameters: a program would not reset those that only another one sets.
        self._pools: dict[frozenset[str], list[_Copy]] = {}

    def given(self, nuisances: Mapping[str, Array]) -> mujoco.MjModel | list[mujoco.MjModel]:
        """The models of N particles, valid until the next call; the one model without nuisance parameters."""
        if not nuisances:
            return self.model
        particles = len(next(iter(nuisances.values())))
        pool = self._pools.setdefault(frozenset(nuisances), [])
        while len(pool) < particles:
            pool.append(self._copied())
        values = dict(nuisances)
        for column, name in ((1, "stiffness"), (2, "damping")):
            if name in values:
                values[name] = self.model.actuator_biasprm[:, column] * values[name]
        moved = self._moved(values.pop("grip_from_peg")) if "grip_from_peg" in values else None
        settings = [(*_COLUMNS[name], value) for name, value in values.items() if name in _COLUMNS]
        for k, each in enumerate(pool[:particles]):
            for array, column, value in settings:
                getattr(each, array)[:, column] = value[k]
            if moved is not None:
                places, turns, boxes = moved
                each.places[self._geoms], each.turns[self._geoms] = places[k], turns[k]
                each.boxes[self._boxes] = boxes[k]
        return [each.model for each in pool[:particles]]

    def _copied(self) -> _Copy:
        model = copy.copy(self.model)
        # MuJoCo ignores the place of a geom that coincided with a frame when the model was compiled.
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
        """Places (N, G, 3), quaternions (N, G, 4) and box trees (N, B, 6) of the peg's geoms in the grip."""
        shift, turn = grip_from_peg[:, None, :3], _rotation(grip_from_peg[:, 3:])
        matrix = turn.as_matrix()
        places = shift + np.einsum("nij,gj->ngi", matrix, self.model.geom_pos[self._geoms])
        own = _rotation(np.array(self.model.geom_quat[self._geoms]))
        turns = np.stack([(turn * g).as_quat()[:, [3, 0, 1, 2]] for g in own], axis=1)
        # The tree is in the axes of the body's inertia, which do not move.
        origin, axes = self._inertial[0], self._inertial[1].as_matrix()
        tree = np.asarray(self.model.bvh_aabb[self._boxes])
        centers = shift + np.einsum("nij,bj->nbi", matrix, origin + tree[:, :3] @ axes.T)
        within = np.abs(np.einsum("ji,njk,kl->nil", axes, matrix, axes))
        boxes = [(centers - origin) @ axes, np.einsum("nij,bj->nbi", within, tree[:, 3:])]
        return places, turns, np.concatenate(boxes, axis=2)


def _rotation(quaternion: Array) -> Rotation:
    return Rotation.from_quat(quaternion[..., [1, 2, 3, 0]])
