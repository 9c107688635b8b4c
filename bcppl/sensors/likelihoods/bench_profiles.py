"""What is known of a bench before any touch: priors of the errors that all touches share.

Standard deviations. A peg in parallel jaws sits 0.2 to 1 mm and 0.2 to 1 degree off; joints and grip yield by
10 to 50 um/N; wrench and pose are 5 to 40 ms apart (arXiv 2602.16127: 35 to 40 ms); the pose of a flange
repeats to hundredths of a millimetre and is wrong by tenths to millimetres.

- ur5e: repeats to 0.03 mm (Universal Robots, UR5e technical details, ISO 9283); 0.3 mm over a bench once its
  kinematics are calibrated (its factory calibration, or MUKCa, arXiv 2503.12584, which leaves 0.2 mm).
- panda: repeats to 0.1 mm (Franka Emika, Panda datasheet); torque sensors and light links yield more.
- industrial: repeats to 0.02 mm; stiff, with jaws that hold the peg in a pocket.
- perfect: the peg is where it is measured.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from bcppl.arguments import number_within
from bcppl.distributions.episodes import (
    ArmCompliance,
    Delay,
    Grasp,
    Hypothesis,
    KinematicError,
    LinearError,
    PartSlides,
    Size,
)
from bcppl.distributions.episodes.prior import NOISES
from bcppl.errors import InputError
from bcppl.untrusted import strict_json

Point = tuple[float, float, float]

# Factors of the shared errors, after their probabilities: some benches are half as good.
SCALES = ((0.65, 1.0), (0.35, 2.2))


@dataclass(frozen=True)
class BenchProfile:
    """Priors of a bench: metres, radians, seconds, N; 0 for what it does not have.

    Attributes:
        grasp: along and about the peg's axes, and about its own.
        compliance: of arm and grip along and about the peg's axes, mean, m/N and rad/(N m).
        kinematics: over the workspace, and the distance over which it changes.
        delay: by which the wrench is later than the pose, at most; evenly from 0.
        size: of part and peg together.
        repeats: of the flange's pose from one contact to another, however near.
        slips, slides: probabilities that the peg slips in the hand or the part on the table, at each episode
            of contact, of which a probe has ten to twenty. A part that is not clamped slides more often than
            not in one.
    """

    grasp: tuple[float, float, float] = (0.0005, math.radians(0.5), math.radians(1.0))
    compliance: tuple[float, float] = (1.5e-5, 3e-4)
    kinematics: tuple[float, float] = (0.0003, 0.1)
    delay: float = 0.045
    size: float = 0.00005
    repeats: float = 0.00003
    slips: float = 0.02
    slides: float = 0.05

    def errors(self, part: Point, peg: Point, *, is_round: bool = False) -> tuple[LinearError, ...]:
        """The errors, smooth ones about a guess (3,) of where the part is and where the peg will be held.

        A peg that is round about its axis has no turn about it in the hand.
        """
        shift, turn, yaw = self.grasp
        return (
            Grasp(shift, turn, 0.0 if is_round else yaw, slips=self.slips),
            ArmCompliance(*self.compliance),
            KinematicError(*self.kinematics, center=peg),
            PartSlides(probability=self.slides, center=part),
            *([Delay(self.delay)] if self.delay else []),
            Size(self.size),
        )

    @staticmethod
    def hypotheses(compliance: float) -> tuple[Hypothesis, ...]:
        """How good the bench is, given the median compliance (m/N) of part and peg where they touch.

        What differs from it is among the compliance of arm and grip. Contacts or shared errors may be wider
        than stated, not both.
        """
        return tuple(
            Hypothesis(math.log(common * share), compliance, noise, scale)
            for common, noise in NOISES
            for share, scale in SCALES
            if noise == 1.0 or scale == 1.0
        )


PROFILES: Mapping[str, BenchProfile | None] = {
    "perfect": None,
    "ur5e": BenchProfile(),
    "panda": BenchProfile(compliance=(2.5e-5, 6e-4), kinematics=(0.0005, 0.1), repeats=0.0001),
    "industrial": BenchProfile(
        grasp=(0.0002, math.radians(0.2), math.radians(0.3)),
        compliance=(5e-6, 1e-4),
        kinematics=(0.0001, 0.1),
        delay=0.01,
        repeats=0.00002,
    ),
}


FORMAT = "bcppl bench profile"


def profile_named(name: str) -> BenchProfile | None:
    """The profile of that name, or in a file that ends in .json; None for a perfect bench.

    A file has the format "bcppl bench profile" and fields of `BenchProfile`; those that it lacks are of ur5e.

    Raises:
        InputError: there is none, or the file has a field that no profile has, or one that is no number.
    """
    if name.endswith(".json"):
        return _read(Path(name))
    if name not in PROFILES:
        raise InputError(
            f"there is no profile {name!r} of a bench; choose {', '.join(PROFILES)}, or give a file (.json)."
        )
    return PROFILES[name]


def profile_tree(name: str) -> dict[str, Any]:
    """A profile as its file has it.

    Raises:
        InputError: as of `profile_named`, or the bench is perfect.
    """
    profile = profile_named(name)
    if profile is None:
        raise InputError(f"profile {name!r} has no errors to write down; give another.")
    return {"format": FORMAT, **asdict(profile)}


def _read(path: Path) -> BenchProfile:
    remedy = "write it by `bcppl calibrate arm`, or give the name of a profile"
    tree = strict_json.read(path, remedy)
    if not isinstance(tree, dict) or tree.pop("format", None) != FORMAT:
        raise InputError(f"{path} is no profile of a bench (its format is not {FORMAT!r}); {remedy}.")
    usual = asdict(BenchProfile())
    for name, value in tree.items():
        if name not in usual:
            raise InputError(f"{path} has {name!r}; fields of a profile are {', '.join(usual)}.")
        count = len(usual[name]) if isinstance(usual[name], tuple) else 0
        numbers = value if count else [value]
        if not isinstance(numbers, list) or len(numbers) != max(count, 1):
            raise InputError(
                f"{path} has {name} {str(value)[:40]}; give {count or 'one'} number{'s' * bool(count)}."
            )
        checked = [number_within(f"{path} has {name} {{}}", number, least=0.0) for number in numbers]
        usual[name] = tuple(checked) if count else checked[0]
    return BenchProfile(**usual)
