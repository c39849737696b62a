"""`jaxgeom batch MANIFEST --out DIR`."""

import os
import sys

from ..batch import (
    Reconstructing,
    Registering,
    run_batch,
    shard_of,
    shard_of_environment,
)
from ._alignment import settings
from ._main import OK, SOME
from ._report import write_report

_CHOICES = (
    *("objective", "kernel", "max_correspondence_distance", "voxel_size"),
    "with_scale",
)


def tasks(arguments) -> dict:
    """How lines of each kind are worked on."""
    choices = {name: getattr(arguments, name) for name in _CHOICES}
    registering = Registering(lambda target: settings(arguments, target), choices)
    reconstructing = Reconstructing(
        arguments.resolution,
        arguments.point_weight,
        orientation_points=arguments.orientation_points,
    )
    return {"registering": registering, "reconstructing": reconstructing}


def tell(text: str) -> None:
    """A line about the work, on stderr."""
    print(f"jaxgeom: {text}", file=sys.stderr, flush=True)


def run(arguments) -> int:
    """Register or reconstruct the scans of the shard that are not finished."""
    given = arguments.shard
    shard = shard_of(given) if given else shard_of_environment(os.environ)
    tally = run_batch(
        arguments.manifest,
        arguments.out,
        **tasks(arguments),
        shard=shard,
        retry_failed=arguments.retry_failed,
        chunk=arguments.chunk,
        tell=tell,
    )
    print(", ".join(f"{number} {name}" for name, number in tally.items()))
    if arguments.report:
        write_report(arguments.report, parameters=vars(arguments), result=tally)
    return SOME if tally["failed"] else OK
