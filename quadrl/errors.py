"""The root of the errors that are the user's to mend."""


class QuadrlError(Exception):
    """Something the user can mend; the message says what was wrong, what is allowed, what to do.

    The command line prints it as one line and exits with code 2.
    """
