"""How much memory a reconstruction takes, known before it starts."""

import os

from .._core import GeometryError, message

# Live grids at the peak: the solver's vectors, the hierarchy, the density. Measured
# peaks (experiments/reconstruction) lie below this.
_LIVE_GRIDS = 16
# Of a batch, every scan keeps its field, the coarser grid of its density and its mesh,
# once more where several devices are gathered: 2.2 and 3.4 were measured for 100 scans
# at 96^3 on one device and on two.
_KEPT_GRIDS = 4


def memory_needed(
    resolution: int, *, bytes_per_value: int = 4, scans: int = 0, at_once: int = 1
) -> int:
    """An upper estimate of the bytes that dense grids of resolution^3 nodes need.

    `scans` counts those of a batch whose fields are all kept, `at_once` those that are
    solved at one time, one on each device.
    """
    grids = _LIVE_GRIDS * at_once + _KEPT_GRIDS * scans
    return grids * bytes_per_value * resolution**3


def check_memory(
    resolution: int, bytes_per_value: int, scans: int = 0, at_once: int = 1
) -> None:
    """Raise `GeometryError` before allocating more than this machine has."""
    sizes = {"bytes_per_value": bytes_per_value, "scans": scans, "at_once": at_once}
    needed = memory_needed(resolution, **sizes)
    present = _physical_memory()
    if present is not None and needed > present:
        largest = int((present / memory_needed(1, **sizes)) ** (1 / 3))
        fewer = " or pass fewer scans at once." if scans else "."
        raise GeometryError(
            message(
                "the grid must fit the memory of this machine",
                f"resolution {resolution} needs about {needed / 2**30:.0f} GiB, "
                f"there are {present / 2**30:.0f} GiB",
                f"Lower the resolution to at most {largest // 16 * 16}{fewer}",
            )
        )


def _physical_memory() -> int | None:
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (ValueError, OSError, AttributeError):
        return None
