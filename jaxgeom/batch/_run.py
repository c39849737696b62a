"""The driver: read ahead, sort into size buckets, align chunks, write states."""

import collections
import platform
import time
from collections.abc import Callable

import equinox as eqx
import jax
import numpy as np

from .. import __version__
from .._core import RESULTS, GeometryError, message, name_of
from ..pipelines import share_target
from ..shapes import PointCloud
from ..transforms import Rigid
from ._chunks import Chunks, Key, align_chunk, size_bucket
from ._inputs import Refused, digest_of, hash_of, read_points, start_of
from ._manifest import Scan, read_manifest
from ._shards import Shard
from ._states import STATES, read_state, state_path, write_state

_HELD_TARGETS = 4
# Below this share of a scan with a partner, an alignment should be looked at.
_LOW_FITNESS = 0.5


class Work(eqx.Module):
    """A scan that was read and waits for its chunk."""

    scan: Scan
    source: np.ndarray
    start: Rigid
    input_hash: str = eqx.field(static=True)


def run_batch(
    manifest,
    out,
    *,
    settings: Callable[[PointCloud], dict] = lambda target: {},
    choices: dict | None = None,
    shard: Shard | None = None,
    retry_failed: bool = False,
    chunk: int = 64,
    tell: Callable[[str], None] = lambda text: None,
) -> dict[str, int]:
    """How many scans of a manifest are ok, warning, failed; skipped ones included.

    Every scan is laid on its target by `register_many` and ends as one file
    `status/xx/ID.json` under `out`. A finished scan whose files, start and settings are
    the same is skipped, so that a run that was killed goes on. At most four chunks of
    scans are in memory.

    **Arguments:**

    - `manifest`: a file for `read_manifest`.
    - `settings`: from a target to the `voxel_size` and `pyramid` of `register`.
    - `choices`: what `settings` depends on, as JSON: part of the hash of the inputs.
    - `shard`: the share to work on; all by default.
    - `retry_failed`: whether failed scans are done again.
    - `chunk`: scans in one call; every size bucket is compiled once.
    - `tell`: gets a line for each new program and each failed scan.

    A scan that is unreadable, empty, not finite or hopeless fails alone. Raises
    `GeometryError` for a manifest that is not valid, before any work, and `OSError`
    where a state cannot be written.
    """
    shard = Shard() if shard is None else shard
    _check_names(manifest, shard)
    run = _Run(out, settings, choices or {}, retry_failed, chunk, tell)
    for scan in read_manifest(manifest):
        if shard.holds(scan.id):
            run.take(scan)
    run.end()
    return run.tally


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

    def __init__(self, out, settings, choices, retry_failed, chunk, tell):
        self.out, self.settings, self.choices = out, settings, choices
        self.retry_failed, self.tell = retry_failed, tell
        self.chunks = Chunks(chunk)
        self.targets: collections.OrderedDict = collections.OrderedDict()
        self.shared: collections.OrderedDict = collections.OrderedDict()
        self.tally = {**dict.fromkeys(STATES, 0), "skipped": 0}

    def take(self, scan):
        """Read a scan that is not finished; align the chunk that it fills."""
        started, input_hash = time.perf_counter(), None
        try:
            target, chosen = self._target(scan.target)
            source_digest = _digest(scan.source)
            begin = _given_start(scan)
            size = scan.voxel_size
            told = {**self.choices, "own_voxel_size": size, "init": begin}
            input_hash = hash_of(source_digest, target.digest, told)
            if self._is_finished(scan.id, input_hash):
                return
            source = read_points(scan.source, "source")
            start = start_of(scan.init, source.points, target.points)
        except Refused as refused:
            reason = (refused.code, str(refused))
            if not self._is_finished(scan.id, input_hash):
                seconds = time.perf_counter() - started
                self._end(scan, input_hash, "failed", *reason, None, seconds)
            return
        chosen = chosen if size is None else {**chosen, "voxel_size": size}
        key = Key(scan.target, size, size_bucket(len(source.points)))
        work = Work(scan, source.points, start, input_hash)
        for ready in self.chunks.add(key, work, (target.points, chosen)):
            self._align(*ready)

    def end(self):
        """Align what is left."""
        for ready in self.chunks.rest():
            self._align(*ready)

    def _target(self, url):
        """The target and its settings; the last few are kept."""
        if url not in self.targets:
            target = read_points(url, "target")
            self.targets[url] = target, self.settings(PointCloud(target.points))
        _keep_last(self.targets, url)
        return self.targets[url]

    def _shared(self, key, points, chosen):
        """The prepared target of a chunk, and its points; the last few are kept."""
        kind = (key.target, key.voxel_size)
        if kind not in self.shared:
            self.shared[kind] = share_target(PointCloud(points), **chosen)
        _keep_last(self.shared, kind)
        return self.shared[kind], points

    def _is_finished(self, name, input_hash):
        state = read_state(state_path(self.out, name))
        if state is None or state["input_hash"] != input_hash:
            return False
        if self.retry_failed and state["status"] == "failed":
            return False
        self.tally[state["status"]] += 1
        self.tally["skipped"] += 1
        return True

    def _align(self, key, works, target, room):
        """Align a chunk; where that breaks, each scan alone, so that one fails."""
        started = time.perf_counter()
        try:
            shared = self._shared(key, *target)
            found = align_chunk(key, works, shared, room, self.tell)
        except Exception as error:
            if len(works) > 1:
                for work in works:
                    self._align(key, [work], target, room)
                return
            found = [None]
            text = f"{type(error).__name__}: {error}"
        seconds = (time.perf_counter() - started) / len(works)
        for work, item in zip(works, found, strict=True):
            told = ("failed", "internal", text) if item is None else _verdict(item)
            self._end(work.scan, work.input_hash, *told, item, seconds)

    def _end(self, scan, input_hash, status, code, text, item, seconds):
        """Write the one state of a scan."""
        state = {
            "schema": 1,
            "id": scan.id,
            "status": status,
            "code": code,
            "message": text,
            "transform": None,
            "fitness": None,
            "rmse": None,
            "seconds": round(seconds, 4),
            "versions": _versions(),
            "input_hash": input_hash,
            **({} if item is None else _facts(item)),
        }
        write_state(self.out, state)
        self.tally[status] += 1
        if status == "failed":
            self.tell(f"{scan.id}: {code}: {text}")


def _keep_last(held, key):
    """Drop what was used least recently, except for `key` and a few more."""
    held.move_to_end(key)
    while len(held) > _HELD_TARGETS:
        held.popitem(last=False)


def _digest(url):
    try:
        return digest_of(url)
    except (ValueError, OSError) as error:
        raise Refused("source_unreadable", str(error)) from None


def _given_start(scan):
    """What the start depends on: its file's bytes, or the text of the manifest."""
    if not isinstance(scan.init, str) or scan.init == "mean":
        return scan.init
    try:
        return digest_of(scan.init)
    except (ValueError, OSError) as error:
        raise Refused("bad_init", str(error)) from None


def _verdict(item):
    """The status, code and text of an alignment.

    One that came near but did not settle is a warning: its transform can be used.
    """
    code = name_of(item.result)
    # A result of numbers, as arrays on the host leave it, does not tell its text.
    text = RESULTS[getattr(RESULTS, code)]
    if code not in {"successful", "not_converged"}:
        return "failed", code, text
    if float(item.fitness) < _LOW_FITNESS:
        text = f"only {100 * float(item.fitness):.0f} % of the source has a partner"
        return "warning", "low_fitness", text
    return ("warning", code, text) if code == "not_converged" else ("ok", code, "")


def _facts(item):
    """Plain numbers; what is not finite becomes null, which JSON can hold."""
    matrix = np.asarray(item.target_from_source.matrix(), np.float64)
    finite = lambda x: float(x) if np.isfinite(x) else None
    return {
        "transform": matrix.tolist() if np.isfinite(matrix).all() else None,
        "fitness": finite(item.fitness),
        "rmse": finite(item.rmse),
    }


def _versions():
    return {
        "jaxgeom": __version__,
        "jax": jax.__version__,
        "python": platform.python_version(),
    }
