"""The exception for mistakes that the user can correct."""


class UserError(Exception):
    """A mistake in the input: one sentence that says what is wrong and how to correct it.

    The command line prints the sentence and exits with code 2. Any other exception is a bug in
    SymSteer.
    """
