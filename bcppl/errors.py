"""What bcppl raises when what it was given is wrong."""


class InputError(ValueError):
    """Bad input: one sentence that says what is wrong, where, and what to do about it.

    The command line prints the sentence alone and exits with code 2.
    """


class InferenceError(RuntimeError):
    """Inference cannot go on: a log-probability is not a number, or no particle has any weight left.

    The message names the site and the particles, and says what to try.
    """
