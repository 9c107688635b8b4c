"""What a bench's configuration is made of: units, strict fields, poses.

A word such as `mm` states a unit, and `factor` what it is in SI.
"""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

Length = Literal["m", "cm", "mm", "um"]
Angle = Literal["rad", "deg"]
Time = Literal["s", "ms", "us", "ns"]
Force = Literal["N", "mN", "kN", "lbf"]
Torque = Literal["Nm", "Ncm", "Nmm", "lbfin"]
Rotation = Literal["xyzw", "wxyz", "vector", "matrix"]

_SI = {
    **{"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6},
    **{"rad": 1.0, "deg": 0.017453292519943295},
    **{"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
    **{"N": 1.0, "mN": 1e-3, "kN": 1e3, "lbf": 4.4482216152605},
    **{"Nm": 1.0, "Ncm": 1e-2, "Nmm": 1e-3, "lbfin": 0.1129848290276167},
}

Three = Annotated[list[float], Field(min_length=3, max_length=3)]
Four = Annotated[list[float], Field(min_length=4, max_length=4)]
Above = Annotated[float, Field(gt=0.0)]
AtLeast = Annotated[float, Field(ge=0.0)]
Name = str | int  # of a column, or its number where a file has no names


def factor(unit: str) -> float:
    """What one of a unit is in SI: metres, radians, seconds, newtons, newton metres."""
    return _SI[unit]


class Fields(BaseModel):
    """Fields that are checked strictly; one that is not known is an error."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True, allow_inf_nan=False)


class PoseFields(Fields):
    """A pose: a translation and one way to write its rotation, or a matrix; without a rotation, no turn."""

    xyz: Three = [0.0, 0.0, 0.0]
    length: Length = "m"
    xyzw: Four | None = None
    wxyz: Four | None = None
    vector: Three | None = None
    angle: Angle = "rad"
    matrix: list[float] | None = None

    @model_validator(mode="after")
    def _one_rotation(self) -> Self:
        given = [name for name in ("xyzw", "wxyz", "vector", "matrix") if getattr(self, name) is not None]
        if len(given) > 1:
            raise ValueError(f"has its rotation as {' and as '.join(given)}; give one of them")
        if self.matrix is not None and len(self.matrix) not in (12, 16):
            raise ValueError(f"has a matrix of {len(self.matrix)} numbers; give 12 or 16, row by row")
        if self.matrix is not None and any(self.xyz):
            raise ValueError("has both a matrix and xyz; give the matrix alone")
        return self
