"""`jaxgeom batch MANIFEST --out DIR`."""

import contextlib
import os
import sys

from ..batch import (
    Reconstructing,
    Registering,
    client_at,
    local_client,
    run_batch,
    shard_of,
    shard_of_environment,
)
from ..normals import LocalPlanes
from ._alignment import settings
from ._main import OK, SOME
from ._report import write_report
from ._surface import method_of

_ALIGNMENT = (
    *("objective", "kernel", "max_correspondence_distance", "voxel_size"),
    "with_scale",
)
_SURFACES = ("resolution", "point_weight", "orientation_points", "trim")


def tasks(arguments) -> dict:
    """How lines of each kind are worked on."""
    chosen = lambda names: {name: getattr(arguments, name) for name in names}
    aligned = lambda target: settings(arguments, target)
    surfaces = {
        "resolution": arguments.resolution,
        "method": method_of(arguments.point_weight),
        "orientation": LocalPlanes(capacity=arguments.orientation_points),
        "trim": arguments.trim,
    }
    return {
        "registering": Registering(aligned, chosen(_ALIGNMENT)),
        "reconstructing": Reconstructing(surfaces, chosen(_SURFACES)),
    }


def tell(text: str) -> None:
    """A line about the work, on stderr."""
    print(f"jaxgeom: {text}", file=sys.stderr, flush=True)


def run(arguments) -> int:
    """Register or reconstruct the scans of the shard that are not finished."""
    given = arguments.shard
    shard = shard_of(given) if given else shard_of_environment(os.environ)
    with _client(arguments.dask) as client:
        tally = run_batch(
            arguments.manifest,
            arguments.out,
            **tasks(arguments),
            shard=shard,
            retry_failed=arguments.retry_failed,
            chunk=arguments.chunk,
            client=client,
            tell=tell,
        )
    print(", ".join(f"{number} {name}" for name, number in tally.items()))
    if arguments.report:
        write_report(arguments.report, parameters=vars(arguments), result=tally)
    return SOME if tally["failed"] else OK


def _client(asked: str | None):
    """The workers that were asked for; None is this process."""
    if asked is None:
        return contextlib.nullcontext()
    return local_client() if asked == "local" else client_at(asked)
