"""Every program of a batch compiled ahead of it."""

import tempfile
import time
from collections.abc import Callable

from ._chunks import Chunks
from ._inputs import Refused
from ._manifest import read_manifest
from ._reconstructing import Reconstructing
from ._registering import Registering
from ._run import tasks


def warm_up(
    manifest,
    *,
    registering: Registering | None = None,
    reconstructing: Reconstructing | None = None,
    chunk: int = 64,
    tell: Callable[[str], None] = lambda text: None,
) -> int:
    """Compile what `run_batch` will need, and how many programs that were.

    One chunk of each size is worked on and thrown away. With a persistent compilation
    cache, such as the command line has, later runs of the manifest, on any number of
    machines that share the cache, only load them. Meshes that need more room than those
    of the first chunk of their size still compile. **Arguments:** those of `run_batch`.
    """
    task_of = tasks(registering, reconstructing)
    chunks, seen = Chunks(chunk), set()

    def ready():
        for scan in read_manifest(manifest):
            try:
                key, work = task_of(scan).read(scan)
            except Refused:
                continue
            yield from chunks.add(key, (scan, work), task_of(scan).most(key, chunk))
        yield from chunks.rest()

    for key, waiting, room in ready():
        task = task_of(waiting[0][0])
        program = (task.program(key), room)
        if program in seen:
            continue
        seen.add(program)
        started = time.perf_counter()
        with tempfile.TemporaryDirectory() as out:
            task.solve(key, *map(list, zip(*waiting, strict=True)), room, out)
        seconds = time.perf_counter() - started
        tell(f"scans of up to {key.size} points, {room} at once: {seconds:.1f} s")
    return len(seen)
