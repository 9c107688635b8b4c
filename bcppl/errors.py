"""The exceptions that bcppl raises."""


class InputError(ValueError):
    """Bad input: one sentence that states what is wrong, where, and what to do about it.

    The command line prints the sentence alone and exits with code 2.
    """


class OtherKindError(InputError, AttributeError):
    """One kind of object is given where another is wanted, and lacks what that has."""


class InferenceError(RuntimeError):
    """Inference cannot go on. The message names the site and the particles, and what to try."""


class NoWeightError(InferenceError):
    """Every particle's weight is zero: no particle explains what was measured."""


class NotANumberError(InferenceError):
    """A log-probability is NaN or +inf: a mistake in a program, a distribution or a simulator."""


def reason_of(error: BaseException | str) -> str:
    """The message of an exception in one line without a full stop, or its name where it has none."""
    return " ".join(str(error).split()).rstrip(".") or type(error).__name__
