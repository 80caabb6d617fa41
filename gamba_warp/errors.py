"""The exception, and the warning, that mean: the input is at fault, not the program."""

MOST_LETTERS = 600  # of a message; our longest own, the list of a model's fields, takes 450


class UserError(Exception):
    """Bad input; ``str(error)`` is one line that names the file or option and the reason.

    The command line prints it after ``gamba: `` and exits with code 2; no traceback is shown.
    Names and texts of strangers stand in messages, so whatever they hold it is one line: letters
    that do not print (ends of lines, escapes of terminals, halves of letters) are shown as escapes,
    and of an over-long message the middle is left out.
    """

    def __init__(self, message: object = "") -> None:
        super().__init__(one_line(str(message)))


class FileWarning(UserWarning):
    """One line about a file that is read, but not in all that it says."""


def first_line(error: BaseException | str) -> str:
    """What an error, or a text, says first; the type where it says nothing."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0]


def one_line(text: str, most: int = MOST_LETTERS) -> str:
    """The text as one line that any terminal can show, of at most ``most`` letters (over 20)."""
    line = " ".join(part.strip() for part in text.strip().splitlines())
    if len(line) > 2 * most:  # before the escapes, which may take long
        line = f"{line[:most]}{line[-most:]}"
    if not line.isprintable():
        line = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in line)
    if len(line) > most:
        head = 2 * most // 3
        line = f"{line[:head]} ... {line[head + 5 - most :]}"
    return line
