"""What is done with scans: each is looked at, worked on in a chunk, and ends."""

import pathlib
import platform
import time
from collections.abc import Callable

import equinox as eqx
import jax

from .. import __version__
from ..io import FileError
from ._inputs import Refused
from ._manifest import Scan
from ._states import STATES, read_state, state_path, write_state
from ._tasks import AbstractTask, Outcome


class Waiting(eqx.Module):
    """A scan that was read and waits for its chunk."""

    scan: Scan
    work: eqx.Module
    input_hash: str = eqx.field(static=True)


class Worker:
    """Looks at scans, works on chunks of them, and counts how they ended."""

    def __init__(
        self,
        out,
        task_of: Callable[[Scan], AbstractTask],
        retry_failed: bool,
        tell: Callable[[str], None],
    ):
        self.out, self.task_of = pathlib.Path(out), task_of
        self.retry_failed, self.tell = retry_failed, tell
        self.tally = {**dict.fromkeys(STATES, 0), "skipped": 0}

    def look(self, scan: Scan):
        """The key of a scan and what waits of it; None where it has ended."""
        started, input_hash = time.perf_counter(), None
        task = self.task_of(scan)
        try:
            input_hash = task.input_hash(scan)
            if self._is_finished(scan.id, input_hash):
                return None
            key, work = task.read(scan)
        except Refused as refused:
            if not self._is_finished(scan.id, input_hash):
                told = Outcome("failed", refused.code, str(refused))
                self.end(scan, input_hash, told, time.perf_counter() - started)
            return None
        return key, Waiting(scan, work, input_hash)

    def work(self, key, waiting: list[Waiting], room: int):
        """Work on a chunk; where that breaks, each scan alone, so that one fails."""
        started = time.perf_counter()
        scans = [one.scan for one in waiting]
        works = [one.work for one in waiting]
        self.tell(f"{len(works)} scans of up to {key.size} points, {room} at once")
        try:
            found = self.task_of(scans[0]).solve(key, scans, works, room, self.out)
        except (OSError, FileError):
            # A disk that is full would fail every scan after this one.
            raise
        except Exception as error:
            if len(waiting) > 1:
                for one in waiting:
                    self.work(key, [one], room)
                return
            text = f"{type(error).__name__}: {error}"
            found = [Outcome("failed", "internal", text)]
        seconds = (time.perf_counter() - started) / len(waiting)
        for one, told in zip(waiting, found, strict=True):
            self.end(one.scan, one.input_hash, told, seconds)

    def end(self, scan: Scan, input_hash: str | None, told: Outcome, seconds: float):
        """Write the one state of a scan."""
        state = {
            "schema": 1,
            "id": scan.id,
            "status": told.status,
            "code": told.code,
            "message": told.text,
            "transform": None,
            "fitness": None,
            "rmse": None,
            "seconds": round(seconds, 4),
            "versions": _versions(),
            "input_hash": input_hash,
            **told.facts,
        }
        write_state(self.out, state)
        self.tally[told.status] += 1
        if told.status == "failed":
            self.tell(f"{scan.id}: {told.code}: {told.text}")

    def _is_finished(self, name, input_hash):
        state = read_state(state_path(self.out, name))
        if state is None or state["input_hash"] != input_hash:
            return False
        if self.retry_failed and state["status"] == "failed":
            return False
        if "mesh" in state and not (self.out / state["mesh"]).exists():
            return False
        self.tally[state["status"]] += 1
        self.tally["skipped"] += 1
        return True


def _versions():
    return {
        "jaxgeom": __version__,
        "jax": jax.__version__,
        "python": platform.python_version(),
    }
