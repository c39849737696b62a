"""The driver: read ahead, sort into kinds, work on chunks, write states."""

import pathlib
import platform
import time
from collections.abc import Callable

import equinox as eqx
import jax

from .. import __version__
from .._core import GeometryError, message
from ..io import FileError
from ._chunks import Chunks
from ._inputs import Refused
from ._manifest import Scan, read_manifest
from ._reconstructing import Reconstructing
from ._registering import Registering
from ._shards import Shard
from ._states import STATES, read_state, state_path, write_state
from ._tasks import AbstractTask, Outcome


class Waiting(eqx.Module):
    """A scan that was read and waits for its chunk."""

    scan: Scan
    work: eqx.Module
    input_hash: str = eqx.field(static=True)


def run_batch(
    manifest,
    out,
    *,
    registering: Registering | None = None,
    reconstructing: Reconstructing | None = None,
    shard: Shard | None = None,
    retry_failed: bool = False,
    chunk: int = 64,
    tell: Callable[[str], None] = lambda text: None,
) -> dict[str, int]:
    """How many scans of a manifest are ok, warning, failed; skipped ones included.

    A scan with a target is laid on it, one without is reconstructed. Every scan ends as
    one file `status/xx/ID.json` under `out`. A finished scan whose files, start and
    settings are the same is skipped, so that a run that was killed goes on. At most
    four chunks of scans are in memory.

    **Arguments:**

    - `manifest`: a file for `read_manifest`.
    - `registering`, `reconstructing`: how, for the lines of each kind.
    - `shard`: the share to work on; all by default.
    - `retry_failed`: whether failed scans are done again.
    - `chunk`: scans in one call; every size bucket is compiled once.
    - `tell`: gets a line for each chunk and each failed scan.

    A scan that is unreadable, empty, not finite or hopeless fails alone. Raises
    `GeometryError` for a manifest that is not valid, before any work, and `OSError`
    where a state cannot be written.
    """
    shard = Shard() if shard is None else shard
    _check_names(manifest, shard)
    kinds = tasks(registering, reconstructing)
    run = _Run(out, kinds, retry_failed, chunk, tell)
    for scan in read_manifest(manifest):
        if shard.holds(scan.id):
            run.take(scan)
    run.end()
    return run.tally


def tasks(registering, reconstructing) -> Callable[[Scan], AbstractTask]:
    """From a scan to what is done with it."""
    registering = Registering() if registering is None else registering
    reconstructing = Reconstructing() if reconstructing is None else reconstructing
    return lambda scan: reconstructing if scan.target is None else registering


def _check_names(manifest, shard):
    """Raise for a line that is not valid, and for two of one id."""
    seen = set()
    for scan in read_manifest(manifest):
        if shard.holds(scan.id):
            if scan.id in seen:
                raise GeometryError(
                    message(
                        f"{manifest}: every id must be there once",
                        f"{scan.id!r} twice",
                        "Give each scan an id of its own.",
                    )
                )
            seen.add(scan.id)


class _Run:
    """The state of a driver: what it holds, and what it has ended."""

    def __init__(self, out, task_of, retry_failed, chunk, tell):
        self.out, self.task_of, self.chunk = pathlib.Path(out), task_of, chunk
        self.retry_failed, self.tell = retry_failed, tell
        self.chunks = Chunks(chunk)
        self.tally = {**dict.fromkeys(STATES, 0), "skipped": 0}

    def take(self, scan):
        """Read a scan that is not finished; work on the chunk that it fills."""
        started, input_hash = time.perf_counter(), None
        task = self.task_of(scan)
        try:
            input_hash = task.input_hash(scan)
            if self._is_finished(scan.id, input_hash):
                return
            key, work = task.read(scan)
        except Refused as refused:
            if not self._is_finished(scan.id, input_hash):
                told = Outcome("failed", refused.code, str(refused))
                seconds = time.perf_counter() - started
                self._end(scan, input_hash, told, seconds)
            return
        most = task.most(key, self.chunk)
        for ready in self.chunks.add(key, Waiting(scan, work, input_hash), most):
            self._solve(*ready)

    def end(self):
        """Work on what is left."""
        for ready in self.chunks.rest():
            self._solve(*ready)

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

    def _solve(self, key, waiting, room):
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
                    self._solve(key, [one], room)
                return
            text = f"{type(error).__name__}: {error}"
            found = [Outcome("failed", "internal", text)]
        seconds = (time.perf_counter() - started) / len(waiting)
        for one, told in zip(waiting, found, strict=True):
            self._end(one.scan, one.input_hash, told, seconds)

    def _end(self, scan, input_hash, told, seconds):
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


def _versions():
    return {
        "jaxgeom": __version__,
        "jax": jax.__version__,
        "python": platform.python_version(),
    }
