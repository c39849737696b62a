"""A field in a script: `SCENE.py:NAME`, and the box it is looked at in."""

import pathlib
import runpy
import traceback

import jax
import numpy as np

from .._core import GeometryError, message
from ..fields import AbstractField, claims
from ..io import FileError


def is_scene(text: str) -> bool:
    """Whether an argument names a field of a script, not a file."""
    return ".py:" in text


def load_scene(text: str):
    """The field that a script defines under a name; any callable point -> number.

    The script is run. Raises `FileError` where it is missing or fails, `GeometryError`
    where the name is not there or is no field.
    """
    path, _, name = text.rpartition(":")
    if not path or not name:
        raise GeometryError(
            message(
                "a scene is named SCRIPT.py:NAME", f"{text!r}", "Such as scene.py:body."
            )
        )
    names = _run(pathlib.Path(path))
    if name not in names:
        given = (
            ", ".join(sorted(k for k in names if not k.startswith("_"))) or "nothing"
        )
        raise GeometryError(
            message(
                f"{path} must define {name}",
                f"it defines {given}",
                "Name one of these.",
            )
        )
    return _checked(names[name], text)


def box_of(field, bounds, text: str):
    """The corners of the box to look at: those given, or around the field's own."""
    if bounds is not None:
        given = np.asarray(bounds, float).reshape(3, 2).T
        return given[0], given[1]
    own = claims(field).bounds if isinstance(field, AbstractField) else None
    if own is None or not bool(own.is_finite()):
        raise GeometryError(
            message(
                f"{text} must have a finite bounding box",
                "none is known",
                "Pass --bounds xmin,xmax,ymin,ymax,zmin,zmax.",
            )
        )
    return np.asarray(own.low, float), np.asarray(own.high, float)


def _run(path) -> dict:
    if not path.is_file():
        raise FileError(
            message(
                f"{path} must be a Python script", "no such file", "Check the path."
            )
        )
    try:
        return runpy.run_path(str(path))
    except Exception as error:
        last = traceback.extract_tb(error.__traceback__)[-1]
        where = f"line {last.lineno} of {pathlib.Path(last.filename).name}"
        raise FileError(
            message(
                f"{path} must run without errors",
                f"{type(error).__name__}: {error} ({where})",
                "Correct the script.",
            )
        ) from error


def _checked(field, text):
    """The field, if it maps a point to one real number."""
    point = jax.ShapeDtypeStruct((3,), np.float32)
    try:
        out = jax.eval_shape(field, point)
        good = out.shape == () and np.issubdtype(out.dtype, np.floating)
        given = f"{out.dtype} of shape {out.shape}"
    except Exception as error:
        good, given = False, f"{type(error).__name__}: {error}".splitlines()[0]
    if not good:
        raise GeometryError(
            message(
                f"{text} must map a point [3] to one number",
                given,
                "Use jax.numpy in it, and return a scalar.",
            )
        )
    return field
