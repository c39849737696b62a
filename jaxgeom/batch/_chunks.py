"""Scans of one size bucket wait together; a full chunk is aligned in one call."""

import equinox as eqx
import jax
import numpy as np

from .._core import RESULTS, bucket
from ..pipelines import register_many
from ..registration import Registration
from ..shapes import PointCloud, stack
from ..transforms import Rigid

_SMALLEST = 256
_HELD_CHUNKS = 4
# A scan may need more voxels than the target; one that needs still more is done again.
_MARGIN = 1.5


class Key(eqx.Module):
    """What scans must share to be aligned in one call."""

    target: str = eqx.field(static=True)
    voxel_size: float | None = eqx.field(static=True)
    size: int = eqx.field(static=True)


def size_bucket(n: int) -> int:
    """The size that scans of `n` points are padded to: powers of two from 256.

    Steps are coarser than those of `bucket`, since a batch compiles for each of them.
    """
    return max(_SMALLEST, 1 << (n - 1).bit_length())


class Chunks:
    """Waiting scans by key; never more than four chunks of them in all."""

    def __init__(self, chunk: int):
        self.chunk = chunk
        self.waiting: dict = {}
        self.rooms: dict = {}

    def add(self, key, work, target):
        """Put a scan with its kind; yields the chunk that must be aligned now."""
        self.waiting.setdefault(key, (target, []))[1].append(work)
        if len(self.waiting[key][1]) == self.chunk:
            yield self._take(key)
        elif self._held() >= _HELD_CHUNKS * self.chunk:
            yield self._take(max(self.waiting, key=lambda k: len(self.waiting[k][1])))

    def rest(self):
        """All that waits, chunk by chunk."""
        while self.waiting:
            yield self._take(next(iter(self.waiting)))

    def _held(self):
        return sum(len(works) for _, works in self.waiting.values())

    def _take(self, key):
        target, works = self.waiting.pop(key)
        few = min(self.chunk, 1 << (len(works) - 1).bit_length())
        # A size that was compiled already is used again, though some of it is padding.
        room = max(few, self.rooms.get(key.size, 0))
        self.rooms[key.size] = room
        return key, works, target, room


def align_chunk(key, works, target, room, tell) -> list[Registration]:
    """The alignment of each scan of a chunk to a shared target, on the host.

    Sizes depend on the target and the bucket alone, so that neither programs nor
    results depend on which scans share a chunk.
    """
    shared, points = target
    full = tuple(key.size if share else None for share in shared.pyramid.voxels)
    rooms = tuple(
        None if n is None else min(key.size, bucket(int(_MARGIN * n)))
        for n in shared.rooms([points])
    )
    tell(f"{len(works)} scans of up to {key.size} points, {room} at once")
    align = lambda works, rooms: _aligned(works, shared, key.size, room, rooms)
    found = align(works, rooms)
    again = [
        i for i, x in enumerate(found) if bool(x.result == RESULTS.capacity_exceeded)
    ]
    if again and rooms != full:
        more = align([works[i] for i in again], full)
        for i, item in zip(again, more, strict=True):
            found[i] = item
    return found


def _aligned(works, shared, size, room, rooms):
    """One compiled call for `room` scans, those that are missing empty."""
    missing = room - len(works)
    clouds = [PointCloud(work.source) for work in works]
    sources = stack(clouds + [PointCloud(np.zeros((1, 3)))] * missing, capacity=size)
    mask = np.asarray(sources.mask) & (np.arange(room) < len(works))[:, None]
    sources = eqx.tree_at(lambda c: c.mask, sources, mask)
    starts = [work.start for work in works]
    starts += [Rigid(np.eye(3), np.zeros(3))] * missing
    batched = jax.tree.map(lambda *rows: np.stack(rows), *starts)
    found = register_many(sources, shared, init=batched, rooms=rooms)
    found = jax.tree.map(np.asarray, found)
    return [jax.tree.map(lambda x, i=i: x[i], found) for i in range(len(works))]
