"""The files of a scan: fetched, hashed and checked; every refusal has a code."""

import contextlib
import hashlib
import json
import pathlib
import tempfile
import urllib.parse
import urllib.request

import equinox as eqx
import numpy as np

from .._core import GeometryError, message
from ..io import FileError, load_cloud
from ..transforms import Rigid

_FEWEST = 6


class Refused(Exception):
    """A scan cannot be worked on: a code for programs and a text for people."""

    def __init__(self, code: str, text: str):
        Exception.__init__(self, text)
        self.code = code


class Points(eqx.Module):
    """The finite points of a file, in double precision, and the hash of its bytes."""

    points: np.ndarray
    digest: str = eqx.field(static=True)


def read_points(url: str, what: str) -> Points:
    """The points of a plain path, a file:// URL, or any URL that fsspec knows."""
    with readable(url, f"{what}_unreadable") as path:
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
        cloud = load_cloud(path)
    points = np.asarray(cloud.points, np.float64)
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) < _FEWEST:
        given = f"{len(points)} of {len(cloud.points)} in {url}"
        must = f"a {what} must have at least {_FEWEST} finite points"
        text = message(must, given, "Check the file.")
        raise Refused(f"{what}_too_few_points", text)
    if not np.ptp(points, axis=0).any():
        must = f"the points of a {what} must not all coincide"
        text = message(must, f"{len(points)} equal points", "Check the file.")
        raise Refused(f"{what}_degenerate", text)
    return Points(points, digest)


@contextlib.contextmanager
def readable(url: str, code: str):
    """The path of a file while it is read; errors refuse the scan with the code."""
    try:
        with local_file(url) as path:
            yield path
    except (ValueError, OSError) as error:
        raise Refused(code, str(error)) from None


def digest_of(url: str, code: str) -> str:
    """The hash of the bytes of a file; what cannot be read is refused with the code."""
    with readable(url, code) as path:
        return hashlib.sha256(path.read_bytes()).hexdigest()


@contextlib.contextmanager
def local_file(url: str):
    """The path of a file while it is needed: its own, or that of a copy."""
    scheme, _, rest = url.partition("://")
    if not rest:
        yield pathlib.Path(url)
    elif scheme == "file":
        path = urllib.parse.urlparse(url).path
        yield pathlib.Path(urllib.request.url2pathname(path))
    else:
        with tempfile.TemporaryDirectory() as folder:
            path = pathlib.Path(folder) / rest.rsplit("/", 1)[-1]
            path.write_bytes(_remote(url))
            yield path


def _remote(url):
    try:
        import fsspec
    except ImportError:
        text = message(
            "a place that is no file needs the package fsspec",
            url,
            "Install jaxgeom[scale].",
        )
        raise FileError(text) from None
    try:
        with fsspec.open(url, "rb") as file:
            return file.read()
    except (OSError, ValueError, ImportError) as error:
        must = f"{url} must be readable"
        text = message(must, str(error), "Check the URL and its package.")
        raise FileError(text) from None


def start_of(init, source, target) -> Rigid:
    """The rigid motion to start from, in double precision."""
    if init is None:
        return Rigid(np.eye(3), np.zeros(3))
    if init == "mean":
        return Rigid(np.eye(3), target.mean(axis=0) - source.mean(axis=0))
    try:
        if isinstance(init, str):
            with local_file(init) as path:
                matrix = np.loadtxt(path, ndmin=2)
        else:
            matrix = np.asarray(init, np.float64)
    except (ValueError, TypeError, OSError, GeometryError) as error:
        raise Refused("bad_init", str(error)) from None
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise _bad_init(f"shape {matrix.shape}")
    turn = matrix[:3, :3]
    # Matrices are written with few digits: a thousandth is a rotation as meant.
    off = np.abs(turn @ turn.T - np.eye(3)).max()
    if off > 1e-3 or np.linalg.det(turn) < 0:
        raise _bad_init(f"a linear part that is no rotation (off by {off:.2g})")
    return Rigid(turn, matrix[:3, 3])


def _bad_init(given):
    must = "init must hold a rigid motion as a 4 x 4 matrix"
    text = message(must, given, "Write four rows of four numbers.")
    return Refused("bad_init", text)


def hash_of(source: str, target: str, settings) -> str:
    """The hash of all that the result of a scan depends on."""
    text = json.dumps([source, target, settings], sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()
