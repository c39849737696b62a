"""All states of a folder: how many there are of each, and one table."""

import csv
import os
import pathlib
from collections import Counter

from ._states import STATES, states

_COLUMNS = ("id", "status", "code", "message", "fitness", "rmse", "seconds")
_MESH = ("mesh", "vertices", "faces", "watertight")
_MATRIX = tuple(f"t{i}{j}" for i in range(4) for j in range(4))


def count(out) -> dict[str, int]:
    """How many scans ended in each state, and of the failed in each code."""
    found = Counter()
    for state in states(out):
        found[state["status"]] += 1
        if state["status"] != "ok":
            found[f"{state['status']}: {state['code']}"] += 1
    return {**{name: found[name] for name in STATES}, **found}


def collect(out, table) -> int:
    """Write one CSV row per scan, the 4 x 4 matrix in t00 ... t33; how many rows.

    Columns of a mesh are empty where there is none.
    """
    table = pathlib.Path(table)
    partial = table.with_name(table.name + ".tmp")
    rows = 0
    with open(partial, "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow((*_COLUMNS, *_MATRIX, *_MESH))
        for state in states(out):
            matrix = state["transform"] or [[""] * 4] * 4
            flat = [x for row in matrix for x in row]
            mesh = (state.get(name) for name in _MESH)
            writer.writerow([*(state[name] for name in _COLUMNS), *flat, *mesh])
            rows += 1
    os.replace(partial, table)
    return rows
