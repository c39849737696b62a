"""The driver: read ahead, sort into kinds, work on chunks, write states."""

from collections.abc import Callable

from .._core import GeometryError, message
from ._chunks import Chunks
from ._dask import run_on_workers
from ._manifest import Scan, read_manifest
from ._progress import Progress
from ._reconstructing import Reconstructing
from ._registering import Registering
from ._shards import Shard
from ._tasks import AbstractTask
from ._worker import Worker


def run_batch(
    manifest,
    out,
    *,
    registering: Registering | None = None,
    reconstructing: Reconstructing | None = None,
    shard: Shard | None = None,
    retry_failed: bool = False,
    chunk: int = 64,
    client=None,
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
    - `client`: a `distributed.Client`, such as `local_client` gives: its workers, which
      must see the same files, do the work. By default it is done here.
    - `tell`: gets a line for each chunk and each failed scan.

    A scan that is unreadable, empty, not finite or hopeless fails alone, and so does
    one that kills the workers of a client. Raises `GeometryError` for a manifest that
    is not valid, before any work, and `OSError` where a state cannot be written.
    """
    shard = Shard() if shard is None else shard
    total = _checked_total(manifest, shard)
    task_of = tasks(registering, reconstructing)
    scans = (scan for scan in read_manifest(manifest) if shard.holds(scan.id))
    if client is not None:
        worker = (out, task_of, retry_failed)
        return run_on_workers(client, scans, worker, chunk, Progress(total, tell))
    worker, chunks = Worker(out, task_of, retry_failed, tell), Chunks(chunk)
    progress = Progress(total, tell)

    def work(ready):
        worker.work(*ready)
        progress.reach(worker.tally)

    for scan in scans:
        found = worker.look(scan)
        if found is not None:
            key, waiting = found
            for ready in chunks.add(key, waiting, task_of(scan).most(key, chunk)):
                work(ready)
    for ready in chunks.rest():
        work(ready)
    return worker.tally


def tasks(registering, reconstructing) -> Callable[[Scan], AbstractTask]:
    """From a scan to what is done with it."""
    registering = Registering() if registering is None else registering
    reconstructing = Reconstructing() if reconstructing is None else reconstructing
    return lambda scan: reconstructing if scan.target is None else registering


def _checked_total(manifest, shard):
    """The number of lines. Raises for one that is not valid, and for two of one id."""
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
    return len(seen)
