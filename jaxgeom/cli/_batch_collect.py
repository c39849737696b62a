"""`jaxgeom batch-collect DIR -o TABLE.csv`."""

from ..batch import collect
from ._files import check_folder
from ._main import OK
from ._report import say


def run(arguments) -> int:
    """Write one row per scan."""
    check_folder(arguments.out)
    rows = collect(arguments.out, arguments.output)
    say(f"{rows} scans in {arguments.output}")
    return OK
