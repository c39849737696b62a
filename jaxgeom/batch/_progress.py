"""How far a batch is."""

import time
from collections.abc import Callable

from ._states import STATES


class Progress:
    """Tells how many scans of `total` have ended, the rate, and the time left."""

    def __init__(self, total: int, tell: Callable[[str], None]):
        self.total, self.tell = total, tell
        self.first = None

    def reach(self, tally: dict[str, int]):
        """Tell of a tally, whose skipped scans took no time."""
        now, ended = time.perf_counter(), sum(tally[name] for name in STATES)
        worked = ended - tally["skipped"]
        line = f"{ended} of {self.total} scans"
        if self.first is None:
            # What comes before the first chunk ends is compiling, mostly.
            self.first = now, worked
        elif worked > self.first[1]:
            rate = (worked - self.first[1]) / (now - self.first[0])
            left = (self.total - ended) / rate
            line += f", {rate:.1f} a second, {left:.0f} s left"
        self.tell(line)
