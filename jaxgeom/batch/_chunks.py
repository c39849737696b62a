"""Scans of one kind wait together; a full chunk is worked on in one call."""

_HELD_CHUNKS = 4


class Chunks:
    """Waiting scans by key; never more than four chunks of them in all."""

    def __init__(self, chunk: int):
        self.chunk = chunk
        self.waiting: dict = {}
        self.rooms: dict = {}

    def add(self, key, work, most: int):
        """Put a scan with its kind; yields the chunk that must be worked on now.

        Scans of a kind are a chunk when they are `most`.
        """
        self.waiting.setdefault(key, (most, []))[1].append(work)
        if len(self.waiting[key][1]) == most:
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
        most, works = self.waiting.pop(key)
        few = min(most, 1 << (len(works) - 1).bit_length())
        # A size that was compiled already is used again, though some of it is padding.
        kind = (type(key), key.size)
        room = max(few, self.rooms.get(kind, 0))
        self.rooms[kind] = room
        return key, works, room
