"""Programs that are wrong, each with the kind of mistake and the site where it shows: `WRONG`, by name."""

from tests.wrong_programs import dependence, numbers_and_supports, particles, randomness_and_state
from tests.wrong_programs.catalogue import WRONG

__all__ = ["WRONG", "dependence", "numbers_and_supports", "particles", "randomness_and_state"]
