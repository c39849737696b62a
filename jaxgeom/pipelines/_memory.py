"""How much memory a reconstruction takes, known before it starts."""

import os

from .._core import GeometryError, message

# Live grids at the peak: the solver's vectors, the hierarchy, the density. Measured
# peaks (experiments/reconstruction) lie below this.
_LIVE_GRIDS = 16


def memory_needed(resolution: int, *, bytes_per_value: int = 4) -> int:
    """An upper estimate of the bytes that a dense grid of resolution^3 nodes needs."""
    return _LIVE_GRIDS * bytes_per_value * resolution**3


def check_memory(resolution: int, bytes_per_value: int) -> None:
    """Raise `GeometryError` before allocating more than this machine has."""
    needed = memory_needed(resolution, bytes_per_value=bytes_per_value)
    present = _physical_memory()
    if present is not None and needed > present:
        largest = int((present / (_LIVE_GRIDS * bytes_per_value)) ** (1 / 3))
        raise GeometryError(
            message(
                "the grid must fit the memory of this machine",
                f"resolution {resolution} needs about {needed / 2**30:.0f} GiB, "
                f"there are {present / 2**30:.0f} GiB",
                f"Lower the resolution to at most {largest // 16 * 16}.",
            )
        )


def _physical_memory() -> int | None:
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (ValueError, OSError, AttributeError):
        return None
