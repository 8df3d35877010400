"""The one exception that means: the user can mend this."""


class UserError(Exception):
    """A mistake in the input: one sentence that says what is wrong and how to mend it.

    The command line prints the sentence and exits with code 2. Anything else that is raised is
    a bug in SymSteer.
    """
