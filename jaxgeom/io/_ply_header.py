"""The header of a PLY file (Turk 1994)."""

import re
from typing import NamedTuple

import numpy as np

from ._errors import FileError, damaged

_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2",
    "int": "i4", "uint": "u4", "float": "f4", "double": "f8",
    "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8",
    "int64": "i8", "uint64": "u8",
}  # fmt: skip
_ENCODINGS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_START = re.compile(rb"ply[ \t]*(\r\n|\n|\r)")


class Property(NamedTuple):
    """A column; `size` is the type of the length of a list, None for a scalar."""

    name: str
    dtype: np.dtype
    size: np.dtype | None


class Element(NamedTuple):
    """A table of `count` rows."""

    name: str
    count: int
    properties: list[Property]


class Header(NamedTuple):
    """`order` is "<" or ">" for a binary body, "" for text; `start` its first byte."""

    order: str
    elements: list[Element]
    start: int
    num_lines: int


def parse_header(data: bytes, name: str) -> Header:
    """The header of the PLY file `data`; raises `FileError` where it is broken."""
    opening = _START.match(data)
    if opening is None:
        raise damaged(name, "PLY", "the file does not start with a line 'ply'")
    newline = opening.group(1)
    closing = re.search(rb"[\r\n]end_header[ \t]*" + newline, data)
    # A header without a body may end without its last line break.
    if closing is None and data.rstrip().endswith(b"end_header"):
        closing = re.search(rb"[\r\n]end_header\s*\Z", data)
    if closing is None:
        raise damaged(name, "PLY", "the header has no line 'end_header'")
    lines = data[opening.end() : closing.start()].decode("utf-8", "replace").split("\n")
    lines = [part for line in lines for part in line.split("\r")]
    order, elements = None, []
    for line in lines:
        words = line.split()
        if not words or words[0] in ("comment", "obj_info"):
            continue
        try:
            if words[0] == "format":
                order = _ENCODINGS[words[1]]
            elif words[0] == "element":
                elements.append(_element(words))
            elif words[0] == "property":
                _add_property(elements[-1], words)
            else:
                raise ValueError("unknown keyword")
        except (KeyError, IndexError, ValueError) as error:
            raise _bad_header(name, line) from error
    if order is None:
        raise damaged(name, "PLY", "the header has no line 'format'")
    num_lines = len(data[: closing.end()].splitlines())
    return Header(order, elements, closing.end(), num_lines)


def _element(words):
    _, name, count = words
    if int(count) < 0:
        raise ValueError("negative count")
    return Element(name, int(count), [])


def _add_property(element, words):
    if words[1] == "list":
        _, _, size, kind, name = words
        size = np.dtype(_TYPES[size])
        if size.kind == "f":
            raise ValueError("the length of a list is an integer")
    else:
        _, kind, name = words
        size = None
    if any(p.name == name for p in element.properties):
        raise ValueError("repeated property")
    element.properties.append(Property(name, np.dtype(_TYPES[kind]), size))


def _bad_header(name, line) -> FileError:
    return damaged(name, "PLY", f"the header line {line.strip()[:60]!r}")
