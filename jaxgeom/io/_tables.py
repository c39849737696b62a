"""Lines of numbers as arrays."""

import re

import numpy as np

from .._core import message
from ._errors import FileError

_SHOWN = 40


def parse_table(
    lines: list[bytes], name: str, numbers, *, delimiter: str | None = None
) -> np.ndarray:
    """The numbers in `lines` as float64 [n, c].

    `numbers[i]` is the number of line i in the file, for the message of the
    `FileError` that a word, or a line of another length than the first, raises.
    """
    if not lines:
        return np.zeros((0, 0))
    text = [line.decode("latin-1").rstrip(" \t" + (delimiter or "")) for line in lines]
    try:
        return np.loadtxt(
            text, np.float64, comments=None, delimiter=delimiter, quotechar='"', ndmin=2
        )
    except ValueError as error:
        raise _bad_line(text, name, numbers, delimiter) from error


def _bad_line(text, name, numbers, delimiter):
    width = len(text[0].split(delimiter))
    for line, number in zip(text, numbers, strict=False):
        words = line.split(delimiter)
        if len(words) != width:
            return not_numbers(
                name, number, line, f"{width} numbers, as the lines before it"
            )
        if not all(is_number(word) for word in words):
            return not_numbers(name, number, line, f"{width} numbers")
    return not_numbers(name, numbers[0], text[0], "numbers")


def not_numbers(name: str, number: int, line: str, wanted: str) -> FileError:
    """The error for the line `number` that does not hold what is `wanted`."""
    shown = line if len(line) <= _SHOWN else line[:_SHOWN] + "..."
    return FileError(
        message(
            f"line {number} of {name} must hold {wanted}",
            repr(shown),
            "Correct or remove this line.",
        )
    )


_NUMBER = re.compile(
    r'\s*"?[+-]?(\d+\.?\d*([eE][+-]?\d+)?|\.\d+([eE][+-]?\d+)?|nan|inf(inity)?)"?\s*',
    re.I,
)


def is_number(word: str) -> bool:
    """True where the word is one number."""
    return _NUMBER.fullmatch(word) is not None
