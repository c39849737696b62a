"""`jaxgeom batch-status DIR`."""

from ..batch import count
from ._files import check_folder
from ._main import OK, SOME
from ._report import say


def run(arguments) -> int:
    """Print how many scans ended in each state, and why."""
    check_folder(arguments.out)
    found = count(arguments.out)
    for name, number in found.items():
        say(f"{number:8d} {name}")
    return SOME if found["failed"] else OK
