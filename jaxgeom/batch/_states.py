"""One file for the state of one scan: written whole or not at all."""

import json
import os
import pathlib
import uuid
import zlib

STATES = ("ok", "warning", "failed")
_FIELDS = {
    *("schema", "id", "status", "code", "message", "transform", "fitness", "rmse"),
    *("seconds", "versions", "input_hash"),
}


def place_of(kind: str, name: str, ending: str) -> pathlib.Path:
    """Where a file of a scan lies in the folder: 256 folders keep each one small."""
    return pathlib.Path(kind, f"{zlib.crc32(name.encode()) % 256:02x}", name + ending)


def state_path(out, name: str) -> pathlib.Path:
    """Where the state of a scan lies."""
    return pathlib.Path(out) / place_of("status", name, ".json")


def write_state(out, state: dict) -> None:
    """Write the state of one scan under a name of its own, then rename it.

    Of two processes that end the same scan, the later one stays. Raises `OSError`.
    """
    path = state_path(out, state["id"])
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.parent / f".{uuid.uuid4().hex}.tmp"
    try:
        partial.write_text(json.dumps(state) + "\n")
        os.replace(partial, path)
    except OSError:
        partial.unlink(missing_ok=True)
        raise


def read_state(path) -> dict | None:
    """The state in a file; None where there is none, or no whole one."""
    try:
        state = json.loads(pathlib.Path(path).read_text())
    except (FileNotFoundError, ValueError):
        return None
    whole = isinstance(state, dict) and set(state) >= _FIELDS
    whole = whole and state["status"] in STATES
    return state if whole else None


def states(out):
    """The states of all scans in a folder, one after the other, sorted by folder."""
    for path in sorted(pathlib.Path(out).glob("status/??/*.json")):
        state = None if path.name.startswith(".") else read_state(path)
        if state is not None:
            yield state
