"""Lines with a target: the motion that lays the scan on it."""

import dataclasses
import functools
from collections.abc import Callable

import equinox as eqx
import jax
import numpy as np

from .._core import RESULTS, bucket
from ..pipelines import register_many, share_target
from ..shapes import PointCloud
from ..transforms import Rigid
from ._inputs import digest_of, hash_of, read_points, start_of
from ._tasks import AbstractTask, Outcome, padded_batch, size_bucket, verdict

_HELD_TARGETS = 4
# A scan may need more voxels than the target; one that needs still more is done again.
_MARGIN = 1.5
# Below this share of a scan with a partner, an alignment should be looked at.
_LOW_FITNESS = 0.5


class _Key(eqx.Module):
    target: str = eqx.field(static=True)
    voxel_size: float | None = eqx.field(static=True)
    size: int = eqx.field(static=True)


class _Work(eqx.Module):
    source: np.ndarray
    start: Rigid


class Registering(AbstractTask):
    """Lay every scan on its target by `register_many`.

    **Arguments:**

    - `settings`: from a target to the `voxel_size` and `pyramid` of `register`.
    - `choices`: what `settings` depends on, as JSON: part of the hash of the inputs.
    """

    def __init__(
        self,
        settings: Callable[[PointCloud], dict] = lambda target: {},
        choices: dict | None = None,
    ):
        self.settings, self.choices = settings, choices or {}
        held = functools.lru_cache(_HELD_TARGETS)
        self._target = held(lambda url: read_points(url, "target"))
        self._shared = held(self._share)

    def __reduce__(self):
        # A copy in another process prepares targets of its own.
        return Registering, (self.settings, self.choices)

    def input_hash(self, scan):
        target = self._target(scan.target)
        given = _given_start(scan)
        told = {**self.choices, "own_voxel_size": scan.voxel_size, "init": given}
        return hash_of(digest_of(scan.source, "source_unreadable"), target.digest, told)

    def read(self, scan):
        target = self._target(scan.target)
        source = read_points(scan.source, "source").points
        start = start_of(scan.init, source, target.points)
        key = _Key(scan.target, scan.voxel_size, size_bucket(len(source)))
        return key, _Work(source, start)

    def most(self, key, chunk):
        return chunk

    def program(self, key):
        shared = self._shared(key.target, key.voxel_size)
        shapes = [level.target.prepared.target.points.shape for level in shared.levels]
        return (key.size, self._rooms(key), *shapes)

    def _rooms(self, key):
        """The capacity of every level: by the target and the bucket alone, so that
        neither programs nor results depend on which scans share a chunk."""
        shared = self._shared(key.target, key.voxel_size)
        return tuple(
            None if n is None else min(key.size, bucket(int(_MARGIN * n)))
            for n in shared.rooms([self._target(key.target).points])
        )

    def solve(self, key, scans, works, room, out):
        shared, rooms = self._shared(key.target, key.voxel_size), self._rooms(key)
        full = tuple(key.size if share else None for share in shared.pyramid.voxels)
        align = lambda works, rooms: _aligned(works, shared, key.size, room, rooms)
        found = align(works, rooms)
        again = [i for i, x in enumerate(found) if _is_full(x)]
        if again and rooms != full:
            more = align([works[i] for i in again], full)
            for i, item in zip(again, more, strict=True):
                found[i] = item
        return [_outcome(item) for item in found]

    def _share(self, url, voxel_size):
        target = PointCloud(self._target(url).points)
        chosen = dict(self.settings(target))
        if voxel_size is not None:
            chosen["voxel_size"] = voxel_size
        return share_target(target, **chosen)


def _given_start(scan):
    """What the start depends on: its file's bytes, or the text of the manifest."""
    if not isinstance(scan.init, str) or scan.init == "mean":
        return scan.init
    return digest_of(scan.init, "bad_init")


def _aligned(works, shared, size, room, rooms):
    """One compiled call for `room` scans, those that are missing empty."""
    sources = padded_batch([PointCloud(work.source) for work in works], room, size)
    starts = [work.start for work in works]
    starts += starts[:1] * (room - len(works))
    batched = jax.tree.map(lambda *rows: np.stack(rows), *starts)
    found = register_many(sources, shared, init=batched, rooms=rooms)
    found = jax.tree.map(np.asarray, found)
    return [jax.tree.map(lambda x, i=i: x[i], found) for i in range(len(works))]


def _is_full(item):
    return bool(item.result == RESULTS.capacity_exceeded)


def _outcome(item) -> Outcome:
    matrix = np.asarray(item.target_from_source.matrix(), np.float64)
    # JSON holds no numbers that are not finite.
    finite = lambda x: float(x) if np.isfinite(x) else None
    facts = {
        "transform": matrix.tolist() if np.isfinite(matrix).all() else None,
        "fitness": finite(item.fitness),
        "rmse": finite(item.rmse),
    }
    told = verdict(item.result)
    if told.status != "failed" and float(item.fitness) < _LOW_FITNESS:
        text = f"only {100 * float(item.fitness):.0f} % of the source has a partner"
        told = Outcome("warning", "low_fitness", text)
    return dataclasses.replace(told, facts=facts)
