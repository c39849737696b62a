"""Point clouds with a mask for ragged batches."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._core import GeometryError, bucket, check_shape, message


class PointCloud(eqx.Module):
    """Points with optional normals and attributes; `mask` is True for real points.

    **Arguments:**

    - `points`: [n, 3], any unit of length.
    - `normals`: [n, 3], outward; need not have unit length. None where unknown.
    - `mask`: [n], True for a real point. All True by default.
    - `attributes`: named arrays [n, ...] carried along, such as `colors` in [0, 1].

    Raises `GeometryError` for arrays whose shapes do not agree.
    """

    points: Float[Array, "n 3"]
    normals: Float[Array, "n 3"] | None
    mask: Bool[Array, " n"]
    attributes: dict[str, Array]

    def __init__(self, points, normals=None, mask=None, attributes=None):
        self.points = _as_float(points)
        self.normals = None if normals is None else _as_float(normals)
        self.attributes = {k: _as_array(v) for k, v in (attributes or {}).items()}
        check_shape("points", self.points, (None, 3))
        n = self.points.shape[0]
        self.mask = np.ones(n, bool) if mask is None else _as_array(mask)
        check_shape("mask", self.mask, (n,))
        if self.normals is not None:
            check_shape("normals", self.normals, (n, 3))
        for name, value in self.attributes.items():
            check_shape(f"attribute {name!r}", value, (n, *value.shape[1:]))

    @property
    def num_points(self):
        """The number of real points."""
        return self.mask.sum()

    def with_normals(self, normals: Float[Array, "n 3"] | None) -> "PointCloud":
        """The cloud with other normals."""
        return PointCloud(self.points, normals, self.mask, self.attributes)

    def washed(self) -> "PointCloud":
        """The cloud with zeros in the padding: finite, and without gradient there."""
        wash = lambda x: jnp.where(_expand(self.mask, x.ndim), x, _zero(x))
        normals = None if self.normals is None else wash(self.normals)
        attributes = {k: wash(v) for k, v in self.attributes.items()}
        return PointCloud(wash(self.points), normals, self.mask, attributes)

    def trim(self) -> "PointCloud":
        """The real points alone (host only: the size depends on the mask)."""
        keep = np.asarray(self.mask)
        return jax.tree.map(lambda x: np.asarray(x)[keep], self)


def stack(clouds: Sequence[PointCloud], *, capacity: int | None = None) -> PointCloud:
    """One batched cloud [b, capacity, ...] from clouds of different sizes (host).

    Shorter clouds are padded with zeros and masked. The capacity defaults to the
    longest size rounded up to a bucket, so that similar batches share one program.
    Raises `GeometryError` for an empty list, clouds that differ in what they carry,
    or a capacity below the longest cloud.
    """
    if not clouds:
        raise GeometryError(
            message("stack needs at least one cloud", "none", "Pass a list of clouds.")
        )
    _check_same_fields(clouds)
    longest = max(cloud.points.shape[0] for cloud in clouds)
    capacity = bucket(longest) if capacity is None else capacity
    if capacity < longest:
        raise GeometryError(
            message(
                "capacity must hold the longest cloud",
                f"capacity {capacity} for {longest} points",
                "Raise capacity, or leave it out.",
            )
        )
    padded = [jax.tree.map(lambda x: _pad_to(x, capacity), cloud) for cloud in clouds]
    return jax.tree.map(lambda *rows: np.stack(rows), *padded)


def _check_same_fields(clouds):
    carried = [(c.normals is not None, tuple(sorted(c.attributes))) for c in clouds]
    if len(set(carried)) > 1:
        raise GeometryError(
            message(
                "stacked clouds must all carry the same normals and attributes",
                f"(has normals, attributes) = {sorted(set(carried))}",
                "Estimate what is missing, or drop what only some have.",
            )
        )


def _pad_to(x, capacity):
    x = np.asarray(x)
    return np.pad(x, [(0, capacity - x.shape[0])] + [(0, 0)] * (x.ndim - 1))


def _as_array(x):
    return x if hasattr(x, "shape") and hasattr(x, "dtype") else np.asarray(x)


def _as_float(x):
    x = _as_array(x)
    floating = jnp.issubdtype(x.dtype, jnp.floating)
    # Integers above 2^24 (millimetres on a map) do not fit a float32.
    return (
        x if floating else x.astype(np.float64 if isinstance(x, np.ndarray) else float)
    )


def _on_host(x):
    return isinstance(x, np.ndarray)


def _zero(x):
    return jnp.zeros((), x.dtype)


def _expand(mask, ndim):
    return mask.reshape(mask.shape + (1,) * (ndim - 1))
