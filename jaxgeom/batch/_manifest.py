"""The list of the work: one scan a line, as CSV or as JSON lines."""

import csv
import json
import math
import pathlib
import re
from collections.abc import Iterator

import equinox as eqx

from .._core import GeometryError, message
from ..io import FileError

_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._-]{0,199}")
_KEYS = {"id", "source", "target", "init", "parameters"}
_ALIGNED, _RECONSTRUCTED = {"voxel_size"}, {"resolution", "trim"}


class Scan(eqx.Module):
    """One line of a manifest: lay `source` on `target`, or reconstruct it if that is
    None.

    `init` is None, "mean", the place of a text file with a 4 x 4 matrix, or 4 rows of
    4 numbers; `voxel_size` (with a target), `resolution` and `trim` (without) are None
    for those of the run.
    """

    id: str = eqx.field(static=True)
    source: str = eqx.field(static=True)
    target: str | None = eqx.field(static=True, default=None)
    init: str | tuple | None = eqx.field(static=True, default=None)
    voxel_size: float | None = eqx.field(static=True, default=None)
    resolution: int | None = eqx.field(static=True, default=None)
    trim: float | None = eqx.field(static=True, default=None)


def read_manifest(path) -> Iterator[Scan]:
    """The scans of a manifest, line by line: never more than one is held.

    **Arguments:**

    - `path`: a `.jsonl` file of objects, or a CSV file with a header. Columns: `id`
      (letters, digits, dot, dash, underscore: it names the status file), `source`,
      `target` (without one the scan is reconstructed), and if wanted `init` beside a
      target, and `parameters`: an object with `voxel_size`, or without a target
      `resolution` and `trim`.

    Raises `GeometryError` naming the line that is not as it must be, and `FileError`
    for a file that is not text.
    """
    path = pathlib.Path(path)
    lines = _json_lines if path.suffix in {".jsonl", ".ndjson"} else _csv_lines
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            for number, row in lines(path, file):
                yield _scan(row, f"{path}, line {number}")
    except (UnicodeDecodeError, csv.Error) as error:
        raise FileError(
            message(f"{path} must be UTF-8 text", str(error), "Export it again.")
        ) from None


def _json_lines(path, file):
    for number, line in enumerate(file, 1):
        if line.strip():
            yield number, _json(line, f"{path}, line {number}")


def _csv_lines(path, file):
    reader = csv.DictReader(file)
    for row in reader:
        place = f"{path}, line {reader.line_num}"
        if None in row:
            raise _bad(place, f"more columns than the header: {row[None]}")
        row = {key: value for key, value in row.items() if value}
        if "parameters" in row:
            row["parameters"] = _json(row["parameters"], place)
        yield reader.line_num, row


def _json(text, place):
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        raise _bad(place, f"no JSON ({error})") from None


def _scan(row, place) -> Scan:
    if not isinstance(row, dict) or not set(row) <= _KEYS:
        raise _bad(place, repr(row)[:200])
    for key in ("id", "source"):
        if not isinstance(row.get(key), str):
            raise _bad(place, f"{key} {row.get(key)!r}")
    if not isinstance(row.get("target"), str | None):
        raise _bad(place, f"target {row['target']!r}")
    if row.get("target") is None and "init" in row:
        raise _bad(place, "init without a target")
    if not _NAME.fullmatch(row["id"]):
        raise _bad(place, f"id {row['id']!r}")
    own = _own(row, place)
    init = row.get("init")
    if isinstance(init, list):
        init = tuple(tuple(r) if isinstance(r, list) else r for r in init)
    elif init is not None and not isinstance(init, str):
        raise _bad(place, f"init {init!r}")
    return Scan(row["id"], row["source"], row.get("target"), init, **own)


def _own(row, place) -> dict:
    """The parameters of one line, checked."""
    own = row.get("parameters") or {}
    names = _RECONSTRUCTED if row.get("target") is None else _ALIGNED
    if not isinstance(own, dict) or not set(own) <= names:
        raise _bad(place, f"parameters {own!r}")
    own = {name: value for name, value in own.items() if value is not None}
    for name, value in own.items():
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if not number or not 0 < value < math.inf:
            raise _bad(place, f"{name} {value!r}")
        whole = int(value) == value and value >= 8
        if name == "resolution" and not whole:
            raise _bad(place, f"resolution {value!r}, which must be at least 8")
    kind = lambda name: int if name == "resolution" else float
    return {name: kind(name)(value) for name, value in own.items()}


def _bad(place, given):
    must = (
        "a line must hold id (letters, digits, '.', '-', '_') and source, and may hold "
        "target, with it init and parameters {voxel_size}, without it parameters "
        "{resolution, trim}"
    )
    return GeometryError(message(f"{place}: {must}", given, "Correct the manifest."))
