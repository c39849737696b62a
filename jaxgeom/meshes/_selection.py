"""Parts of meshes: chosen faces, components, trimming by an attribute."""

from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._core import check_shape, prefix_sum
from ..shapes import TriangleMesh
from ._geometry import face_areas
from ._topology import face_components


def keep_faces(mesh: TriangleMesh, keep: Bool[Array, " f"]) -> TriangleMesh:
    """The faces where `keep` [f], and the vertices they use, packed to the front.

    The capacities stay; the counts tell what is left (on the host, `trim()` cuts the
    arrays). Normals and attributes follow. Order is preserved.
    """
    check_shape("keep", keep, (mesh.faces.shape[0],))
    v = mesh.vertices.shape[0]
    keep = jnp.asarray(keep) & mesh.face_mask
    faces = jnp.where(keep[:, None], mesh.faces, v)
    used = jnp.zeros(v, bool).at[faces].set(True, mode="drop")
    new_index = prefix_sum(used.astype(jnp.int32))
    faces = new_index.at[faces].get(mode="fill", fill_value=v)
    pack = lambda x, kept: _pack(jnp.asarray(x), kept)
    normals = None if mesh.normals is None else pack(mesh.normals, used)
    attributes = {name: pack(x, used) for name, x in mesh.attributes.items()}
    return TriangleMesh(
        pack(mesh.vertices, used),
        _pack(faces, keep, fill=v),
        normals,
        attributes,
        num_vertices=jnp.sum(used, dtype=jnp.int32),
        num_faces=jnp.sum(keep, dtype=jnp.int32),
    )


class AbstractComponentSize(eqx.Module):
    """What counts as the size of a component."""

    @abstractmethod
    def of_faces(self, mesh: TriangleMesh) -> Float[Array, " f"]:
        """What each face adds to the size of its component."""


class FaceCount(AbstractComponentSize):
    """The number of faces."""

    def of_faces(self, mesh):
        return mesh.face_mask.astype(mesh.vertices.dtype)


class SurfaceArea(AbstractComponentSize):
    """The area of the surface."""

    def of_faces(self, mesh):
        return face_areas(mesh)


def large_components(
    mesh: TriangleMesh,
    *,
    min_fraction: float = 0.01,
    size: AbstractComponentSize | None = None,
) -> Bool[Array, " f"]:
    """True for the faces of components of at least `min_fraction` of the largest one.

    `size` is `FaceCount()` (the default) or `SurfaceArea()`. With `min_fraction` = 1
    only the largest component remains (all of them in a tie).
    """
    size = FaceCount() if size is None else size
    labels = face_components(mesh).labels
    # Which components remain is a discrete choice: it has no gradient.
    sizes = jax.lax.stop_gradient(size.of_faces(mesh))
    total = jnp.zeros(labels.shape[0], sizes.dtype).at[labels].add(sizes, mode="drop")
    large = total >= min_fraction * jnp.max(total, initial=0)
    return large.at[labels].get(mode="fill", fill_value=False)


def drop_small_components(
    mesh: TriangleMesh,
    *,
    min_fraction: float = 0.01,
    size: AbstractComponentSize | None = None,
) -> TriangleMesh:
    """The mesh without components smaller than `min_fraction` of the largest one.

    Capacities stay, counts shrink: `keep_faces` of `large_components`, which see. On
    the host, `.trim()` gives arrays of exact size.
    """
    large = large_components(mesh, min_fraction=min_fraction, size=size)
    return keep_faces(mesh, large)


def split(mesh: TriangleMesh) -> list[TriangleMesh]:
    """The connected components as meshes of exact size, most faces first (host)."""
    labels = np.asarray(face_components(mesh).labels)
    names, numbers = np.unique(labels[: int(mesh.num_faces)], return_counts=True)
    order = np.argsort(-numbers, kind="stable")
    return [keep_faces(mesh, labels == names[i]).trim() for i in order]


class AbstractVertexRule(eqx.Module):
    """Which faces to remove, given which of their vertices are low."""

    @abstractmethod
    def removes(self, low: Bool[Array, "f 3"]) -> Bool[Array, " f"]:
        """True for the faces to remove."""


class AnyVertex(AbstractVertexRule):
    """A face goes if any of its vertices is low."""

    def removes(self, low):
        return jnp.any(low, axis=1)


class AllVertices(AbstractVertexRule):
    """A face goes only if all its vertices are low."""

    def removes(self, low):
        return jnp.all(low, axis=1)


def trim_by_attribute(
    mesh: TriangleMesh,
    values: Float[Array, " v"],
    threshold: Float[Array, ""] | float,
    *,
    rule: AbstractVertexRule | None = None,
) -> TriangleMesh:
    """The mesh without the faces whose vertices lie below `threshold` in `values` [v].

    `rule` is `AnyVertex()` (the default) or `AllVertices()`. A value that is not a
    number is below every threshold. The result is compacted as by `keep_faces`, and
    the attributes follow.
    """
    v = mesh.vertices.shape[0]
    check_shape("values", values, (v,))
    rule = AnyVertex() if rule is None else rule
    low = ~(jnp.asarray(values) >= threshold)
    low = low.at[jnp.asarray(mesh.faces)].get(mode="fill", fill_value=True)
    return keep_faces(mesh, ~rule.removes(low))


def _pack(x, keep, fill=0):
    """The rows of x where `keep`, in front; `fill` behind."""
    n = x.shape[0]
    target = jnp.where(keep, prefix_sum(keep.astype(jnp.int32)), n)
    rows = (
        jnp.full(n, n, jnp.int32)
        .at[target]
        .set(jnp.arange(n, dtype=jnp.int32), mode="drop")
    )
    return x.at[rows].get(mode="fill", fill_value=fill)
