"""`jaxgeom view MESH -o PAGE`."""

from ..io import load_mesh
from ..render import save_html
from ._main import OK
from ._report import say


def run(arguments) -> int:
    """Write a page that shows the mesh in any browser, offline."""
    save_html(arguments.output, load_mesh(arguments.input))
    say(f"wrote {arguments.output}: open it in a browser")
    return OK
