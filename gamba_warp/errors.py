"""Exception and warning for faults of the input rather than the program, and their texts."""

from typing import Any, TextIO

MOST_LETTERS = 600  # of a message; the longest of the program, a model's fields, takes 450


class UserError(Exception):
    """Bad input; ``str(error)`` is one line that names the file or option and the reason.

    The command line prints it after ``gamba: `` without a traceback and exits with code 2. Messages
    may quote untrusted names and texts. So unprintable characters (line ends, terminal escapes,
    surrogates) are escaped, and an over-long message loses its middle.
    """

    def __init__(self, message: object = "") -> None:
        super().__init__(one_line(str(message)))


class FileWarning(UserWarning):
    """Warning about a file that is only partly used, in one line as a ``UserError``'s."""

    def __init__(self, message: object = "") -> None:
        super().__init__(one_line(str(message)))


def first_line(error: BaseException | str) -> str:
    """Return the first line of an error or a text; the error's type if it is empty."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0]


def one_line(text: str, most: int = MOST_LETTERS) -> str:
    """Return the text as one printable line of at most ``most`` characters (over 20)."""
    line = text.strip()
    if len(line) > 2 * most:  # before the escapes, which may take long
        line = f"{line[:most]}{line[-most:]}"
    line = escaped(line)
    if len(line) > most:
        head = 2 * most // 3
        line = f"{line[:head]} ... {line[head + 5 - most :]}"
    return line


def escaped(text: str) -> str:
    """Return the text in one line: ``printable``, with escapes for line ends and tabs.

    A name that holds a line end then starts no line of the output.
    """
    return printable(text).replace("\n", "\\n").replace("\t", "\\t")


def printable(text: str) -> str:
    """Return the text with escapes for characters that a terminal obeys, such as ESC and U+202E.

    Line ends and tabs stay.
    """
    if text.isascii() and text.isprintable():  # the most frequent case
        return text
    return "".join(
        c if c.isprintable() or c in "\n\t" else c.encode("unicode_escape").decode() for c in text
    )


class PrintableStream:
    """Text stream that escapes what is written by ``printable``; file names may hold anything.

    Attributes:
        terminal: the stream below, for progress bars, which move its cursor.
    """

    def __init__(self, terminal: TextIO) -> None:
        self.terminal = terminal

    def write(self, text: str) -> int:
        """Write the escaped text; return the number of characters of the text."""
        self.terminal.write(printable(text))
        return len(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.terminal, name)
