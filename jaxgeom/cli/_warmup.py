"""`jaxgeom warmup MANIFEST`."""

from ..batch import warm_up
from ._batch import tasks, tell
from ._main import OK
from ._report import say


def run(arguments) -> int:
    """Compile the programs of a batch into the cache."""
    programs = warm_up(
        arguments.manifest, **tasks(arguments), chunk=arguments.chunk, tell=tell
    )
    say(f"{programs} programs are in the cache")
    return OK
