"""The command line: `jaxgeom demo | reconstruct | info | render | view`."""

from ._main import main as main
