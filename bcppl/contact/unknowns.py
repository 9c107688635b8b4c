"""What a program may leave open about a touch, pose of the part aside: one value for each particle."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from bcppl.errors import InputError

Array = npt.NDArray[np.float64]

# What the motion far from the part does not hang on: with these alone all particles share one free approach.
FELT_IN_CONTACT_ONLY = frozenset({"friction", "time_constant", "damping_ratio", "grip_from_peg"})
_POSITIVE = ("time_constant", "damping_ratio")


@dataclass(frozen=True, eq=False)
class Unknowns:
    """Physical parameters of a touch that differ from particle to particle; None is what physics has for all.

        friction = pyro.sample("friction", LogNormal(log(0.3), 0.3))
        unknowns = Unknowns(friction=friction)
        begin = partial(ContactTrack.start, physics, sensing, hole, probe, unknowns)
        track = carried("probe", begin)

    Frames. The grip is the frame that the robot believes the peg's to be: its origin is the wrench sensor,
    its axes are those of a peg that is held as planned. What is commanded, measured by the robot's joints and
    felt by the sensor stays the grip's, whatever the peg does in the hand: `world_from_peg`, the wrench and
    contact locations are all of the grip. `grip_from_peg` moves the peg's surface against it, and only the
    surface: the tool's mass stays where it is.

    Attributes:
        friction: (N,) Coulomb's coefficient between peg and part.
        time_constant: (N,) of a contact that settles, seconds.
        damping_ratio: (N,) of a contact that settles.
        stiffness: (N,) or (N, 6) times the probe's, for all axes or along and about each of the command's.
        damping: (N,) or (N, 6) likewise. The command's twist is multiplied alike, as the controller does it.
        grasp_compliance: (N, 6) how far the peg gives in the hand, m/N along and rad/(N m) about the grip's
            axes, at the sensor; 0 is rigid. See `bcppl.contact.grasp`.
        grip_from_peg: (N, 7) pose of the peg's surface in the grip's frame; identity for a peg held as
            planned.
    """

    friction: Tensor | None = None
    time_constant: Tensor | None = None
    damping_ratio: Tensor | None = None
    stiffness: Tensor | None = None
    damping: Tensor | None = None
    grasp_compliance: Tensor | None = None
    grip_from_peg: Tensor | None = None

    def __post_init__(self) -> None:
        """Take arrays and lists as tensors.

        Raises:
            InputError: a value is not made of numbers.
        """
        for name, value in self.given.items():
            if not isinstance(value, Tensor):
                try:
                    tensor = torch.as_tensor(np.asarray(value, dtype=np.float64))
                except (TypeError, ValueError):
                    raise InputError(
                        f"the unknown {name} of a touch is {type(value).__name__} and not made of numbers; "
                        "give a tensor with one row for each particle."
                    ) from None
                object.__setattr__(self, name, tensor)

    @property
    def given(self) -> Mapping[str, Tensor]:
        """What is not None, by name."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: value for name, value in values.items() if value is not None}

    @property
    def tensors(self) -> tuple[Tensor, ...]:
        """What is not None, in the order of the attributes: what a track hangs on beside the pose."""
        return tuple(self.given.values())

    def __getitem__(self, index: Tensor | slice) -> Unknowns:
        """Those of some particles, in the order of an index tensor, a mask or a slice."""
        return Unknowns(**{name: value[index] for name, value in self.given.items()})

    def where(self, mask: Tensor, other: Unknowns) -> Unknowns:
        """These where a mask (N,) is true, the other's elsewhere.

        Raises:
            InputError: the other leaves something else open.
        """
        mine, theirs = self.given, other.given
        if mine.keys() != theirs.keys():
            raise InputError(
                f"particles with unknown {', '.join(mine) or 'nothing'} cannot be merged with particles with "
                f"unknown {', '.join(theirs) or 'nothing'}; both must come from one program."
            )
        return Unknowns(
            **{
                name: torch.where(mask.reshape(-1, *[1] * (value.ndim - 1)), value, theirs[name])
                for name, value in mine.items()
            }
        )

    def rows(self, particles: int) -> dict[str, Array]:
        """What is not None as arrays (N, ...), checked; factors on the controller are spread over six axes.

        Raises:
            InputError: a shape does not fit, or a value is not finite or physically impossible.
        """
        checked = {}
        for name, value in self.given.items():
            row = value.detach().cpu().numpy().astype(np.float64)
            tails = {"grip_from_peg": [(7,)], "grasp_compliance": [(6,)]}.get(
                name, [(), (6,)] if name in ("stiffness", "damping") else [()]
            )
            if row.shape not in [(particles, *tail) for tail in tails]:
                wanted = " or ".join(str((particles, *tail)) for tail in tails)
                raise InputError(
                    f"the unknown {name} of a touch has shape {row.shape}; for {particles} particles give "
                    f"{wanted}."
                )
            least = -np.inf if name == "grip_from_peg" else 0.0
            if not np.isfinite(row).all() or (row < least).any() or (name in _POSITIVE and (row == 0).any()):
                raise InputError(
                    f"the unknown {name} of a touch has a value that is negative or not finite"
                    f"{' or 0' if name in _POSITIVE else ''}; give it a prior over possible values, such as "
                    "LogNormal."
                )
            if name == "grip_from_peg":
                length = np.linalg.norm(row[:, 3:], axis=1, keepdims=True)
                if (abs(length - 1.0) > 1e-3).any():
                    raise InputError(
                        "the unknown grip_from_peg of a touch has a quaternion that is not of unit length; "
                        "give poses x y z qw qx qy qz."
                    )
                row[:, 3:] /= length
            if name in ("stiffness", "damping") and row.ndim == 1:
                row = np.repeat(row[:, None], 6, axis=1)
            checked[name] = row
        return checked
