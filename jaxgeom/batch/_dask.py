"""The same batch on the workers of Dask distributed, an optional extra."""

import contextlib
import functools
import itertools
import logging
import os
import pickle
import subprocess
import sys
from collections import Counter

import jax

from .._core import GeometryError, message
from ._chunks import Chunks
from ._inputs import Refused
from ._progress import Progress
from ._states import STATES
from ._tasks import Outcome
from ._worker import Worker

# Calls that wait at the workers, for each of them: none is idle, and few are held.
_AHEAD = 3


def run_on_workers(client, scans, worker, chunk: int, progress: Progress) -> dict:
    """The tally of scans that the workers of a client looked at and worked on.

    Scans are looked at by slabs of `chunk`; those of one kind make a chunk, and each
    slab and chunk is a call. `worker`: the arguments of `Worker`, without `tell`.
    """
    return _Driver(client, worker, chunk, progress).run(scans)


class _Driver:
    """What was sent to the workers, and what is known of what came back.

    A worker that dies takes all calls that it held along, and the scheduler gives up
    those that were there several times: which of their scans kills is not known then.
    They are tried once more at the end, one scan at a time with nothing beside it.
    """

    def __init__(self, client, worker, chunk, progress):
        self.distributed = _distributed()
        self.client, self.worker, self.progress = client, worker, progress
        self.task_of, self.chunk = worker[1], chunk
        self.chunks, self.tally = Chunks(chunk), Counter()
        self.packed = _packed(worker)
        self.sent, self.suspects = {}, []
        self.running = self.distributed.as_completed()

    def run(self, scans):
        for slab in iter(lambda: list(itertools.islice(scans, self.chunk)), []):
            self._send(_look, slab)
            while len(self.sent) > _AHEAD * len(self.client.nthreads()):
                self._receive()
        while self.sent or self.chunks.waiting or self.suspects:
            if not any(call is _look for call, *_ in self.sent.values()):
                for ready in self.chunks.rest():
                    self._send_chunk(*ready)
            alone = not self.sent
            if alone:
                self._send(*self.suspects.pop())
            self._receive(alone)
        return {name: self.tally[name] for name in (*STATES, "skipped")}

    def _send(self, call, scans, *more):
        arguments = (self.packed, scans, *more)
        future = self.client.submit(call, *arguments, pure=False)
        self.sent[future.key] = (call, scans, *more)
        self.running.add(future)

    def _send_chunk(self, key, scans, room):
        self._send(_work, scans, key, room)

    def _receive(self, alone: bool = False):
        """Take in one answer."""
        future = next(self.running)
        call, scans, *more = self.sent.pop(future.key)
        try:
            keys, tally, lines = future.result()
        except self.distributed.KilledWorker:
            keys, tally, lines = [], {}, []
            if alone:
                tally = _end_killed(self.worker, scans[0])
            else:
                self.suspects += [(call, [scan], *more) for scan in scans]
        self.tally.update(tally)
        for line in lines:
            self.progress.tell(line)
        for scan, key in keys:
            most = self.task_of(scan).most(key, self.chunk)
            for ready in self.chunks.add(key, scan, most):
                self._send_chunk(*ready)
        if call is _work:
            self.progress.reach(self.tally)


def _look(packed, scans):
    """The key of each scan that has not ended; then the tally and lines to tell."""
    lines = []
    worker = Worker(*_unpacked(packed), lines.append)
    found = [(scan, worker.look(scan)) for scan in scans]
    keys = [(scan, ready[0]) for scan, ready in found if ready is not None]
    return keys, worker.tally, lines


def _work(packed, scans, key, room):
    """Work on a chunk, read again here; what a look gives, without keys."""
    lines = []
    worker = Worker(*_unpacked(packed), lines.append)
    found = [worker.look(scan) for scan in scans]
    # Another driver, or an earlier try of this call, may have ended some of them.
    waiting = [ready[1] for ready in found if ready is not None]
    worker.tally["skipped"] = 0
    if waiting:
        worker.work(key, waiting, room)
    return [], worker.tally, lines


def _packed(worker) -> bytes:
    import cloudpickle

    return cloudpickle.dumps(worker)


@functools.lru_cache(1)
def _unpacked(packed: bytes):
    """A worker's arguments, whose tasks keep what they prepared from call to call."""
    return pickle.loads(packed)


def _end_killed(worker, scan):
    """The tally of a scan that ended with its worker, several times."""
    driver = Worker(*worker, lambda text: None)
    input_hash = None
    with contextlib.suppress(Refused):
        input_hash = driver.task_of(scan).input_hash(scan)
    text = "every worker that tried it died, most likely for want of memory"
    driver.end(scan, input_hash, Outcome("failed", "worker_died", text), 0.0)
    return driver.tally


@contextlib.contextmanager
def local_client():
    """A `distributed.Client` with one new process for each device of this machine.

    A CPU counts as one device for each core. Processes are spawned: a script that
    calls this needs the guard `if __name__ == "__main__"`. They end with the block.
    Raises `GeometryError` where Dask distributed is not installed.
    """
    distributed = _distributed()
    # Nothing outside this machine can reach them.
    here = {"host": "127.0.0.1"}
    quiet = {"silence_logs": logging.ERROR}
    worker = {**here, **quiet, "nthreads": 1}
    options = [{**worker, "env": each} for each in _environments()]
    cluster = distributed.SpecCluster(
        workers={
            i: {"cls": distributed.Nanny, "options": each}
            for i, each in enumerate(options)
        },
        scheduler={
            "cls": distributed.Scheduler,
            "options": {**here, "dashboard": False},
        },
        **quiet,
    )
    with cluster, distributed.Client(cluster) as client:
        yield client
        # One that is just starting, in the place of one that died, ends with noise.
        with contextlib.suppress(TimeoutError):
            client.wait_for_workers(len(options), timeout=10)


@contextlib.contextmanager
def client_at(address: str):
    """A `distributed.Client` of the scheduler at an address such as tcp://host:8786.

    Raises `GeometryError` where Dask distributed is not installed, `OSError` where no
    scheduler answers.
    """
    with _distributed().Client(address) as client:
        yield client


def _environments():
    """What distinguishes the processes: a device each, and the compilation cache."""
    cache = jax.config.jax_compilation_cache_dir
    shared = {"JAX_COMPILATION_CACHE_DIR": cache} if cache else {}
    # This process must not take the memory of a device that it does not use.
    ask = "import jax; print(jax.default_backend(), jax.local_device_count())"
    told = subprocess.check_output([sys.executable, "-c", ask], text=True)
    platform, count = told.split()[-2:]
    if platform == "cpu":
        own = getattr(os, "sched_getaffinity", None)
        cores = len(own(0)) if own else os.cpu_count()
        # The processes are the division: each has one device and one core.
        return [{**shared, "PJRT_NPROC": "1", "JAX_NUM_CPU_DEVICES": "1"}] * cores
    every = ",".join(map(str, range(int(count))))
    seen = os.environ.get("CUDA_VISIBLE_DEVICES") or every
    return [{**shared, "CUDA_VISIBLE_DEVICES": name} for name in seen.split(",")]


def _distributed():
    try:
        import distributed
    except ImportError:
        must = "workers of Dask need the package distributed"
        what = 'Run: pip install "jaxgeom[scale]".'
        raise GeometryError(message(must, "it is not installed", what)) from None
    return distributed
