"""Nuisance parameters of a contact: one value for each particle."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor

from bcppl.arrays import Array
from bcppl.errors import InputError
from bcppl.poses import as_pose

# The free motion does not depend on these: with them alone, all particles share it.
CONTACT_ONLY = frozenset({"friction", "time_constant", "damping_ratio", "grip_from_peg"})
_POSITIVE = ("time_constant", "damping_ratio")
_SHAPES: Mapping[str, tuple[tuple[int, ...], ...]] = {
    "stiffness": ((), (6,)),
    "damping": ((), (6,)),
    "grasp_compliance": ((6,),),
    "grip_from_peg": ((7,),),
}


@dataclass(frozen=True, eq=False)
class Nuisances:
    """Physical parameters that differ from particle to particle; None for the value that physics has.

        friction = pyro.sample("friction", LogNormal(log(0.3), 0.3))
        nuisances = Nuisances(friction=friction)
        begin = partial(ProbeRollout.start, physics, sensing, hole, probe, nuisances)
        rollout = carried("probe", begin)

    Frames. The grip is the frame that the robot takes for the peg's: its origin is the wrench sensor, its
    axes are those of a nominally grasped peg. Commands, joint measurements and the sensor's wrench refer to
    the grip, wherever the peg is in the hand: `world_from_peg`, wrenches and contact locations are all of
    the grip. `grip_from_peg` moves the peg's surface in it, and only the surface: the tool's mass stays.

    Attributes:
        friction: (N,) Coulomb's coefficient between peg and part.
        time_constant: (N,) of a contact, seconds.
        damping_ratio: (N,) of a contact.
        stiffness: (N,) or (N, 6) factors of the probe's, for all axes or along and about each of the
            command's.
        damping: (N,) or (N, 6) likewise. The command's twist is multiplied alike, as in the controller.
        grasp_compliance: (N, 6) of the grasp, m/N along and rad/(N m) about the grip's axes, at the sensor; 0
            is rigid. See `bcppl.contact.grasp_compliance`.
        grip_from_peg: (N, 7) pose of the peg's surface in the grip's frame; identity for a nominal grasp.
    """

    friction: Tensor | None = None
    time_constant: Tensor | None = None
    damping_ratio: Tensor | None = None
    stiffness: Tensor | None = None
    damping: Tensor | None = None
    grasp_compliance: Tensor | None = None
    grip_from_peg: Tensor | None = None

    def __post_init__(self) -> None:
        for name, value in self.given.items():
            if not isinstance(value, Tensor):
                object.__setattr__(self, name, torch.as_tensor(np.asarray(value, dtype=np.float64)))

    @property
    def given(self) -> Mapping[str, Tensor]:
        """The parameters that are not None, by name."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: value for name, value in values.items() if value is not None}

    @property
    def tensors(self) -> tuple[Tensor, ...]:
        """The parameters that are not None, in the order of the attributes: inputs of a rollout."""
        return tuple(self.given.values())

    def __getitem__(self, index: Tensor | slice) -> Nuisances:
        """Those of some particles, in the order of an index tensor, a mask or a slice."""
        return Nuisances(**{name: value[index] for name, value in self.given.items()})

    def rows(self, particles: int) -> dict[str, Array]:
        """The parameters that are not None as arrays (N, ...); factors on the controller are (N, 6).

        Raises:
            InputError: a shape does not fit, or a value is not finite or physically impossible.
        """
        checked = {}
        for name, value in self.given.items():
            row = value.detach().cpu().numpy().astype(np.float64)
            shapes = [(particles, *tail) for tail in _SHAPES.get(name, ((),))]
            if row.shape not in shapes:
                raise InputError(
                    f"nuisance parameter {name} has shape {row.shape}; give {' or '.join(map(str, shapes))}."
                )
            if name == "grip_from_peg":
                row = as_pose(row, "the nuisance parameter grip_from_peg").numpy()
            elif not np.isfinite(row).all() or (row < 0.0).any() or (name in _POSITIVE and (row == 0).any()):
                raise InputError(
                    f"the nuisance parameter {name} has a value that is negative or not finite"
                    f"{' or 0' if name in _POSITIVE else ''}; give it a prior over possible values, such as "
                    "LogNormal."
                )
            if name in ("stiffness", "damping") and row.ndim == 1:
                row = np.repeat(row[:, None], 6, axis=1)
            checked[name] = row
        return checked
