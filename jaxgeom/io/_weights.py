"""Checkpoints: the arrays of any pytree, in a plain NPZ file."""

import io as _io
import pathlib
import zipfile

import equinox as eqx
import jax
import numpy as np
from jaxtyping import PyTree

from .._core import message
from ._errors import FileError

_FORMAT = "jaxgeom weights 1"


def save_weights(path: str | pathlib.Path, model: PyTree) -> None:
    """Write the arrays of a model (a network, a `Family`, any field) to an NPZ file.

    Each array is stored under its place in the model, such as
    `.network.layers[0].weight`; `numpy.load` reads it, too. Raises `FileError` where
    the file cannot be written.
    """
    buffer = _io.BytesIO()
    np.savez(buffer, **{"format": np.asarray(_FORMAT), **_named(model)})
    try:
        pathlib.Path(path).write_bytes(buffer.getvalue())
    except OSError as error:
        must = f"{path} must be a file that can be written"
        fix = "Check the folder and its permissions."
        raise FileError(message(must, str(error), fix)) from error


def load_weights(path: str | pathlib.Path, like: PyTree) -> PyTree:
    """The model `like` with its arrays read from a file of `save_weights`.

    Static parts (widths, activations) come from `like`: build it as when the file was
    written, with any key. Raises `FileError` for a file that cannot be read, is no such
    checkpoint, or whose arrays have other places, shapes or types than those of `like`.
    """
    stored = _read(path)
    wanted = _named(like)
    told = lambda arrays: {k: (v.shape, v.dtype.name) for k, v in arrays.items()}
    if told(stored) != told(wanted):
        differ = sorted(set(told(stored).items()) ^ set(told(wanted).items()))
        raise FileError(
            message(
                f"{path} must hold the arrays of the model given as `like`",
                f"{len(stored)} arrays for {len(wanted)}, differing in {differ[0][0]} "
                f"{differ[0][1]}",
                "Build `like` with the sizes and the precision of the saved model.",
            )
        )
    arrays, rest = eqx.partition(like, eqx.is_array)
    names = [jax.tree_util.keystr(p) for p, _ in _leaves(arrays)]
    leaves = [jax.numpy.asarray(stored[name]) for name in names]
    return eqx.combine(jax.tree.unflatten(jax.tree.structure(arrays), leaves), rest)


def _leaves(tree):
    return jax.tree_util.tree_leaves_with_path(tree)


def _named(model):
    arrays = eqx.filter(model, eqx.is_array)
    return {jax.tree_util.keystr(p): np.asarray(x) for p, x in _leaves(arrays)}


def _read(path):
    try:
        with np.load(pathlib.Path(path), allow_pickle=False) as file:
            stored = {name: file[name] for name in file.files}
        known = str(stored.pop("format", "")) == _FORMAT
    except (OSError, ValueError, EOFError, AttributeError, zipfile.BadZipFile) as error:
        must = f"{path} must be a checkpoint of `save_weights`"
        fix = "Check the path, or save the model again."
        raise FileError(
            message(must, f"{error or type(error).__name__}", fix)
        ) from None
    if not known:
        must = f"{path} must be a checkpoint of `save_weights`"
        given = f"an NPZ file with {', '.join(sorted(stored)[:4]) or 'no arrays'}"
        raise FileError(message(must, given, "Save the model with `save_weights`."))
    return stored
