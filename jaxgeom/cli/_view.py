"""`jaxgeom view FILE -o PAGE`."""

from ..render import save_html
from ._files import load_shape
from ._main import OK
from ._report import say


def run(arguments) -> int:
    """Write a page that shows a mesh or a cloud in any browser, offline."""
    save_html(arguments.output, load_shape(arguments.input))
    say(f"wrote {arguments.output}: open it in a browser")
    return OK
