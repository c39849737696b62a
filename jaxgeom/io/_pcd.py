"""Point Cloud Data, the format of PCL."""

import re
from typing import NamedTuple

import numpy as np

from ._columns import COLOR
from ._errors import cut_short, damaged
from ._lzf import decompress
from ._tables import not_numbers, parse_table

_DATA = re.compile(rb"(?:^|\n)DATA[ \t]+(\w+)[ \t]*\r?(?:\n|\Z)")
_KINDS = {"F": "f", "I": "i", "U": "u"}
_WIDEST = 2**20
_PACKED = ("rgb", "rgba")


class _Header(NamedTuple):
    fields: list[tuple[str, np.dtype, int]]
    count: int
    encoding: str
    start: int
    num_lines: int


def read_pcd(data: bytes, name: str) -> dict[str, np.ndarray]:
    """The columns of the PCD file `data`; raises `FileError`."""
    header = _parse_header(data, name)
    body = data[header.start :]
    readers = {
        "ascii": _read_text,
        "binary": _read_binary,
        "binary_compressed": _read_compressed,
    }
    if header.encoding not in readers:
        raise damaged(name, "PCD", f"DATA {header.encoding}")
    return _unpack_colors(readers[header.encoding](body, header, name))


def _parse_header(data, name):
    match = _DATA.search(data)
    if match is None:
        raise damaged(name, "PCD", "the header has no line 'DATA'")
    entries = {}
    for line in data[: match.start() + 1].decode("utf-8", "replace").splitlines():
        words = line.split()
        if words and not words[0].startswith("#"):
            entries[words[0].upper()] = words[1:]
    try:
        fields = _fields(entries)
        shape = [int(entries.get(key, ["1"])[0]) for key in ("WIDTH", "HEIGHT")]
        count = int(entries.get("POINTS", [shape[0] * shape[1]])[0])
        if count < 0:
            raise ValueError(f"{count} points")
    except (KeyError, IndexError, ValueError, TypeError) as error:
        raise damaged(name, "PCD", f"a broken header ({error})") from error
    num_lines = len(data[: match.end()].splitlines())
    encoding = match.group(1).decode().lower()
    return _Header(fields, count, encoding, match.end(), num_lines)


def _fields(entries):
    names = entries["FIELDS"] if "FIELDS" in entries else entries["COLUMNS"]
    counts = entries.get("COUNT", ["1"] * len(names))
    kinds = zip(entries["TYPE"], entries["SIZE"], strict=True)
    dtypes = [np.dtype(f"{_KINDS[kind]}{int(size)}") for kind, size in kinds]
    fields = list(zip(names, dtypes, (int(c) for c in counts), strict=True))
    sizes = [count for _, _, count in fields]
    if min(sizes, default=0) < 0 or sum(sizes) > _WIDEST:
        raise ValueError(f"COUNT {' '.join(counts)}")
    named = [n for n in names if n != "_"]
    if len(set(named)) < len(named):
        raise ValueError("a repeated field")
    return fields


def _read_text(body, header, name):
    numbered = enumerate(body.splitlines(), header.num_lines + 1)
    rows = [(number, line) for number, line in numbered if line.strip()]
    rows = rows[: header.count]
    if len(rows) < header.count:
        raise cut_short(name, "PCD", "points", header.count, len(rows))
    numbers = [number for number, _ in rows]
    table = parse_table([line for _, line in rows], name, numbers)
    width = sum(count for _, _, count in header.fields)
    if rows and table.shape[1] != width:
        text = rows[0][1].decode("latin-1").strip()
        raise not_numbers(name, numbers[0], text, f"{width} numbers")
    table = table if rows else np.zeros((0, width))
    columns, start = {}, 0
    for field, dtype, count in header.fields:
        block = table[:, start : start + count]
        # Text has the digits it has: only integers and packed colors have a type.
        exact = dtype.kind == "f" and field not in _PACKED
        with np.errstate(invalid="ignore", over="ignore"):
            columns[field] = block if exact else block.astype(dtype)
        start += count
    return _named(columns)


def _read_binary(body, header, name):
    row = np.dtype(
        [
            (f"f{i}", dtype.newbyteorder("<"), (count,))
            for i, (_, dtype, count) in enumerate(header.fields)
        ]
    )
    got = len(body) // row.itemsize if row.itemsize else header.count
    if got < header.count:
        raise cut_short(name, "PCD", "points", header.count, got)
    rows = np.frombuffer(body, row, header.count if row.itemsize else 0)
    return _named(
        {
            field: rows[f"f{i}"].astype(dtype)
            for i, (field, dtype, _) in enumerate(header.fields)
        }
    )


def _read_compressed(body, header, name):
    packed = int.from_bytes(body[0:4], "little")
    size = int.from_bytes(body[4:8], "little")
    if len(body) < 8 + packed:
        raise cut_short(name, "PCD", "compressed bytes", packed, max(len(body) - 8, 0))
    row = sum(dtype.itemsize * count for _, dtype, count in header.fields)
    need = header.count * row
    if size < need:
        raise cut_short(name, "PCD", "bytes", need, size)
    raw = decompress(body[8 : 8 + packed], size, name)
    columns, start = {}, 0
    for field, dtype, count in header.fields:
        block = np.frombuffer(raw, dtype.newbyteorder("<"), header.count * count, start)
        columns[field] = block.reshape(header.count, count).astype(dtype)
        start += block.nbytes
    return _named(columns)


def _named(columns):
    """Without padding fields; [n, 1] as [n]."""
    return {
        field: block[:, 0] if block.shape[1] == 1 else block
        for field, block in columns.items()
        if field != "_"
    }


def _unpack_colors(columns):
    """PCL packs 0x00RRGGBB into one number, often disguised as a float32."""
    for field in _PACKED:
        packed = columns.get(field)
        if packed is None or packed.ndim > 1 or packed.dtype.itemsize != 4:
            continue
        bits = np.ascontiguousarray(packed).view(np.uint32)
        rest = {k: v for k, v in columns.items() if k != field}
        channels = [(bits >> shift).astype(np.uint8) for shift in (16, 8, 0)]
        return rest | dict(zip(COLOR, channels, strict=True))
    return columns
