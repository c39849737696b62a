"""The body of a PLY file: tables of numbers and of lists, in text or binary."""

import itertools

import numpy as np

from ._columns import Contents
from ._errors import FileError, cut_short, damaged
from ._ply_header import Element, Header, parse_header
from ._polygons import fan
from ._tables import not_numbers, parse_table

_CORNERS = ("vertex_indices", "vertex_index")


def read_ply(data: bytes, name: str, *, faces: bool) -> Contents:
    """The vertices, and where `faces` is true the triangles, of the PLY file `data`.

    Every element is checked to be complete, whether it is wanted or not. Raises
    `FileError`.
    """
    header = parse_header(data, name)
    tables = {}
    wanted = {"vertex", "face"} if faces else {"vertex"}
    body = _read_binary if header.order else _read_text
    for element, table in body(data, header, name, wanted):
        if element.name in wanted and element.name not in tables:
            tables[element.name] = table
    if "vertex" not in tables:
        found = ", ".join(e.name for e in header.elements) or "no element"
        raise damaged(name, "PLY", f"no element 'vertex' (found {found})")
    scalars = {k: v for k, v in tables["vertex"].items() if not isinstance(v, tuple)}
    return Contents(scalars, _triangles(tables.get("face", {})))


def _triangles(table):
    for key in _CORNERS:
        if isinstance(table.get(key), tuple):
            sizes, corners = table[key]
            return fan(sizes, _whole(corners))
    return None


def _whole(corners):
    # An unsigned or fractional index must not wrap into a valid one.
    return np.where(np.abs(corners) < 2**31, corners, -1).astype(np.int64)


# --- text ---------------------------------------------------------------------------


def _read_text(data, header: Header, name, wanted):
    numbered = enumerate(data[header.start :].splitlines(), header.num_lines + 1)
    rows = [(number, line) for number, line in numbered if line.strip()]
    start = 0
    for element in header.elements:
        # An element without properties has empty lines, which are dropped above.
        count = element.count if element.properties else 0
        part = rows[start : start + count]
        if len(part) < count:
            raise cut_short(name, "PLY", f"rows of {element.name!r}", count, len(part))
        start += count
        if element.name in wanted:
            numbers = [number for number, _ in part]
            lines = [line for _, line in part]
            yield element, _text_table(lines, numbers, element, name)
        else:
            yield element, {}


def _text_table(lines, numbers, element: Element, name):
    if any(p.size for p in element.properties):
        return _text_lists(lines, numbers, element, name)
    table = parse_table(lines, name, numbers)
    width = len(element.properties)
    if lines and table.shape[1] < width:
        text = lines[0].decode("latin-1").strip()
        raise not_numbers(name, numbers[0], text, f"{width} numbers")
    table = table if lines else np.zeros((0, width))
    return {
        p.name: _typed(table[:, i], p.dtype, name)
        for i, p in enumerate(element.properties)
    }


def _text_lists(lines, numbers, element: Element, name):
    values = {p.name: [] for p in element.properties}
    sizes = {p.name: [] for p in element.properties}
    for line, number in zip(lines, numbers, strict=True):
        words = iter(line.split())
        try:
            for p in element.properties:
                size = 1 if p.size is None else int(next(words))
                items = [float(word) for word in itertools.islice(words, max(size, 0))]
                if size < 0 or len(items) < size:
                    raise ValueError("too few numbers")
                values[p.name] += items
                sizes[p.name].append(size)
        except (ValueError, StopIteration) as error:
            text = line.decode("latin-1").strip()
            wanted = f"a row of the element {element.name!r}"
            raise not_numbers(name, number, text, wanted) from error
    out = {}
    for p in element.properties:
        column = _typed(np.array(values[p.name], np.float64), p.dtype, name)
        out[p.name] = column if p.size is None else (np.array(sizes[p.name]), column)
    return out


def _typed(column, dtype, name):
    """Integers in their type; floats stay double: text has the digits it has."""
    if dtype.kind == "f":
        return column
    with np.errstate(invalid="ignore"):
        whole = column.astype(dtype)
    if not np.array_equal(whole, column):
        raise damaged(name, "PLY", f"a number that is no {dtype.name}")
    return whole


# --- binary -------------------------------------------------------------------------


def _read_binary(data, header: Header, name, wanted):
    start = header.start
    for element in header.elements:
        table, start = _binary_table(data, start, element, header.order, name)
        yield element, table


def _binary_table(data, start, element: Element, order, name):
    lengths = _first_lengths(data, start, element, order)
    row = _row_dtype(element, lengths, order, room=len(data) - start)
    if row is not None:
        got = (len(data) - start) // row.itemsize if row.itemsize else element.count
        if got >= element.count:
            # A type without bytes (no properties) has no rows to view.
            count = element.count if row.itemsize else 0
            rows = np.frombuffer(data, row, count, start)
            if _same_lengths(rows, element, lengths):
                end = start + count * row.itemsize
                return _split_rows(rows, element), end
        elif not lengths:
            raise cut_short(
                name, "PLY", f"rows of {element.name!r}", element.count, got
            )
    return _walk(data, start, element, order, name)


def _first_lengths(data, start, element, order):
    """The list lengths of the first row, or None where the data end within it."""
    lengths = {}
    if not element.count:
        return {p.name: 0 for p in element.properties if p.size}
    for p in element.properties:
        size = 1
        if p.size:
            raw = data[start : start + p.size.itemsize]
            if len(raw) < p.size.itemsize:
                return None
            size = int(np.frombuffer(raw, p.size.newbyteorder(order))[0])
            if size < 0:
                return None
            lengths[p.name] = size
            start += p.size.itemsize
        start += size * p.dtype.itemsize
    return lengths


def _row_dtype(element, lengths, order, room):
    """The type of one row if all rows were as long as the first, or None."""
    if lengths is None:
        return None
    items = sum(
        p.dtype.itemsize * lengths.get(p.name, 1) + (p.size.itemsize if p.size else 0)
        for p in element.properties
    )
    # Lists longer than the file are left to the walk, which reports them.
    if lengths and items > max(room, 0):
        return None
    fields = []
    for i, p in enumerate(element.properties):
        kind = p.dtype.newbyteorder(order)
        if p.size:
            fields.append((f"n{i}", p.size.newbyteorder(order)))
            fields.append((f"v{i}", kind, (lengths[p.name],)))
        else:
            fields.append((f"v{i}", kind))
    return np.dtype(fields)


def _same_lengths(rows, element, lengths):
    return all(
        (rows[f"n{i}"] == lengths[p.name]).all()
        for i, p in enumerate(element.properties)
        if p.size
    )


def _split_rows(rows, element):
    out = {}
    for i, p in enumerate(element.properties):
        column = rows[f"v{i}"].astype(p.dtype)
        sizes = rows[f"n{i}"].astype(np.int64) if p.size else None
        out[p.name] = column if sizes is None else (sizes, column.reshape(-1))
    return out


def _walk(data, start, element: Element, order, name):
    """Rows whose lists differ in length: each starts where the last one ended."""
    pieces = {p.name: [] for p in element.properties}
    sizes = {p.name: [] for p in element.properties}
    little = "little" if order == "<" else "big"
    for done in range(element.count):
        for p in element.properties:
            size = 1
            if p.size:
                end = start + p.size.itemsize
                signed = p.size.kind == "i"
                size = int.from_bytes(data[start:end], little, signed=signed)
                start = end
            end = start + size * p.dtype.itemsize
            if size < 0 or end > len(data):
                raise _row_cut(name, element, done)
            pieces[p.name].append(data[start:end])
            sizes[p.name].append(size)
            start = end
    out = {}
    for p in element.properties:
        raw = np.frombuffer(b"".join(pieces[p.name]), p.dtype.newbyteorder(order))
        column = raw.astype(p.dtype)
        out[p.name] = (np.array(sizes[p.name]), column) if p.size else column
    return out, start


def _row_cut(name, element, done) -> FileError:
    return cut_short(name, "PLY", f"rows of {element.name!r}", element.count, done)
