"""The one exception that means: the input is at fault, not the program."""


class UserError(Exception):
    """Bad input; ``str(error)`` is one line that names the file or option and the reason.

    The command line prints it after ``gamba: `` and exits with code 2; no traceback is shown.
    """
