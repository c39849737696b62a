"""The one error of reading and writing."""

from .._core import GeometryError, message


class FileError(GeometryError):
    """A file cannot be read or written; the message names it and says what to do."""


def damaged(name: str, form: str, given: str) -> FileError:
    """The error for a file whose contents break off or contradict its header."""
    return FileError(
        message(
            f"{name} must be a complete {form} file",
            given,
            "Export or copy the file again.",
        )
    )


def cut_short(name: str, form: str, what: str, expected: int, got: int) -> FileError:
    """The error for a body with fewer items than the header promises."""
    return damaged(
        name, form, f"the header promises {expected} {what}, the file holds {got}"
    )
