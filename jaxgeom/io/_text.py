"""Text files of one point per line."""

import io

import numpy as np

from .._core import message
from ._columns import COLOR, NORMAL, POSITION, canonical
from ._errors import FileError, cut_short
from ._tables import is_number, not_numbers, parse_table

_COMMENTS = (b"#", b"//", b"%")
_BOM = b"\xef\xbb\xbf"


def read_text(data: bytes, name: str) -> dict[str, np.ndarray]:
    """The columns of a text file of points, one per line.

    Numbers are separated by spaces, tabs, commas or semicolons. The first line, or the
    last comment before the numbers, may name the columns. Without names they are x y z,
    then normals or colors (told apart by their values), then `column_4`, ... counted
    from 1. A first line of a single number is the count of points. Raises `FileError`.
    """
    rows, comment = _rows_of(data.removeprefix(_BOM))
    if not rows:
        raise _no_points(name)
    delimiter = _delimiter(rows[min(len(rows), 2) - 1][1])
    names, rows = _header(rows, comment, delimiter, name)
    promised, rows = _promised(rows, delimiter)
    if not rows:
        raise _no_points(name)
    if promised is not None and len(rows) < promised:
        raise cut_short(name, "text", "points", promised, len(rows))
    numbers = [number for number, _ in rows]
    lines = [line for _, line in rows]
    if delimiter == ";":
        lines = [line.replace(b",", b".") for line in lines]
    table = parse_table(lines, name, numbers, delimiter=delimiter)
    if names is None:
        return guess_columns(table, name)
    if len(names) != table.shape[1]:
        wanted = f"{len(names)} numbers, as the header names"
        raise not_numbers(name, numbers[0], lines[0].decode("latin-1"), wanted)
    return dict(zip(names, table.T, strict=True))


def guess_columns(table: np.ndarray, name: str) -> dict[str, np.ndarray]:
    """Names for the columns of a table [n, c] that has none."""
    if table.ndim != 2 or table.shape[1] < 3:
        raise FileError(
            message(
                f"{name} must hold at least the three columns x, y and z",
                f"an array of shape {tuple(table.shape)}",
                "Write one point per row.",
            )
        )
    names = list(POSITION)
    width = table.shape[1]
    # The x y z intensity r g b of laser scanners (.pts).
    if width == 7 and _like_colors(table[:, 4:7]) and not _like_colors(table[:, 3:6]):
        names += ["column_4", *COLOR]
    while width - len(names) >= 3 and len(names) < 9:
        block = table[:, len(names) : len(names) + 3]
        colors = _like_colors(block) if COLOR[0] not in names else False
        group = COLOR if colors or NORMAL[0] in names else NORMAL
        if group[0] in names:
            break
        names += group
    names += [f"column_{i + 1}" for i in range(len(names), width)]
    return dict(zip(names, table.T, strict=True))


def write_text(columns: dict[str, np.ndarray], form: str) -> bytes:
    """One point per line, with as many digits as the numbers have.

    CSV has a header line; the other formats name their columns in a comment, only where
    there are others than positions and normals.
    """
    delimiter = "," if form == "csv" else " "
    header = delimiter.join(columns)
    if form != "csv":
        plain = set(columns) <= {*POSITION, *NORMAL}
        header = "" if plain else f"# {header}"
    rows = np.empty(
        len(columns["x"]), [(f"f{i}", v.dtype) for i, v in enumerate(columns.values())]
    )
    for i, column in enumerate(columns.values()):
        rows[f"f{i}"] = column
    head = f"{header}\n" if header else ""
    return head.encode() + text_rows(rows, delimiter)


def text_rows(rows: np.ndarray, delimiter: str) -> bytes:
    """A structured array as lines of text, with as many digits as the numbers have."""
    formats = [_digits(rows.dtype[i]) for i in range(len(rows.dtype))]
    out = io.StringIO()
    np.savetxt(out, rows, fmt=formats, delimiter=delimiter)
    return out.getvalue().encode()


def _digits(dtype):
    if dtype.kind != "f":
        return "%d"
    return "%.9g" if dtype.itemsize == 4 else "%.17g"


def _rows_of(data):
    """The numbered lines with contents, and the last comment before them."""
    rows, comment = [], None
    for number, line in enumerate(data.splitlines(), 1):
        stripped = line.strip()
        if stripped.startswith(_COMMENTS):
            comment = stripped.lstrip(b"#/% \t") if not rows else comment
        elif stripped:
            rows.append((number, stripped))
    return rows, comment


def _delimiter(line):
    for mark in (b";", b","):
        if mark in line:
            return mark.decode()
    return None


def _words(line, delimiter):
    text = line.decode("utf-8", "replace").strip(" \t" + (delimiter or ""))
    words = text.split(delimiter)
    return [word.strip().strip("\"'") for word in words]


def _header(rows, comment, delimiter, name):
    number, line = rows[0]
    names = _words(line, delimiter)
    if delimiter == ";":
        plain = [word.replace(",", ".") for word in names]
    else:
        plain = names
    if all(is_number(word) for word in plain):
        width = len(plain)
        for mark in (delimiter, None, ","):
            named = _words(comment, mark) if comment else []
            if len(named) == width and _names_points(named):
                return named, rows
        return None, rows
    if not _names_points(names):
        wanted = "numbers, or a header that names x, y and z"
        raise not_numbers(name, number, line.decode("latin-1"), wanted)
    return names, rows[1:]


def _names_points(names):
    distinct = len(set(names)) == len(names)
    return distinct and set(POSITION) <= set(canonical(dict.fromkeys(names)))


def _promised(rows, delimiter):
    """The count on a first line of one number, which lines of points follow."""
    if len(rows) < 2:
        return None, rows
    first, second = (_words(line, delimiter) for _, line in rows[:2])
    if len(first) == 1 and len(second) >= 3 and first[0].isdecimal():
        return int(first[0]), rows[1:]
    return None, rows


def _like_colors(block):
    """Bytes, or fractions that are no unit vectors."""
    finite = block[np.isfinite(block).all(axis=1)]
    if not len(finite) or finite.min() < 0 or finite.max() > 255:
        return False
    if finite.max() > 1:
        return bool((finite == np.rint(finite)).all())
    square = (finite**2).sum(axis=1)
    unit = np.abs(square - 1) < 0.1
    return bool(unit.mean() < 0.5)


def _no_points(name):
    return FileError(
        message(
            f"{name} must hold at least one point",
            "no line of numbers",
            "Write one point per line: x y z.",
        )
    )
