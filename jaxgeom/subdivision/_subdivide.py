"""Finer meshes, and the linear operator that made them."""

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Int

from .._core import GeometryError, message
from ..shapes import PolygonMesh, TriangleMesh
from ._creases import Creases, creases_of, with_creases
from ._net import Net, check_room, faces_of, net_of
from ._operator import Refinement, Rows, identity_band, on_device
from ._schemes import AbstractScheme, Loop

AnyMesh = TriangleMesh | PolygonMesh
LOOP = Loop()


class SubdivisionPlan(eqx.Module):
    """All of a subdivision that does not depend on positions.

    - `operator`: from the vertices of the coarse mesh to those of the fine one, whose
      first vertices are the coarse ones.
    - `faces`: int32 [f, 3] or [f, k] of the fine mesh, in a tuple by k.
    - `creases`: what is still sharp after the last level.
    - `triangles`: the fine mesh is a `TriangleMesh`, not a `PolygonMesh`.
    """

    operator: Refinement
    faces: tuple[Int[Array, "f k"], ...]
    creases: Creases
    triangles: bool = eqx.field(static=True)

    def __call__(self, mesh: AnyMesh) -> AnyMesh:
        """The fine mesh of a coarse one of the planned connectivity.

        Vertices and attributes are refined alike, without padding; normals are left
        out. Survives jit, vmap over the vertices, and gradients.
        """
        finer = lambda x: self.operator @ x[: self.operator.shape[1]]
        vertices = finer(mesh.vertices)
        attributes = {k: finer(x) for k, x in mesh.attributes.items()}
        if self.triangles:
            return TriangleMesh(vertices, self.faces[0], attributes=attributes)
        return PolygonMesh(vertices, self.faces, attributes)


class Subdivided(eqx.Module):
    """A fine `mesh`, the `operator` from coarse to fine, and the `creases` left over.

    `mesh.vertices` = operator @ coarse vertices. With `creases` the mesh can be
    subdivided further: n levels at once and one after another give the same faces in
    the same order, but new vertices may be numbered differently.
    """

    mesh: AnyMesh
    operator: Refinement
    creases: Creases


def plan_subdivision(
    mesh: AnyMesh,
    levels: int = 1,
    *,
    scheme: AbstractScheme = LOOP,
    creases: Creases | None = None,
) -> SubdivisionPlan:
    """The operator and the faces of `levels` levels of subdivision (host).

    Looks at the faces alone, which must be known (not traced): plan once, apply to as
    many shapes of the same connectivity as you like. A vertex in more than one fan of
    faces is one vertex with all of their edges.

    Raises `GeometryError` for what `subdivide` raises it.
    """
    if levels < 0:
        must = "levels must be at least 0"
        raise GeometryError(message(must, f"{levels}", "Pass a whole number."))
    net = with_creases(net_of(exact(mesh)), creases)
    check_room(net, levels)
    factors, net = refine(net, levels, scheme)
    parts = on_device((Refinement(factors), faces_of(net)))
    stays = isinstance(mesh, TriangleMesh) and bool(np.all(net.sizes == 3))
    return SubdivisionPlan(*parts, creases_of(net), stays)


def subdivide(
    mesh: AnyMesh,
    levels: int = 1,
    *,
    scheme: AbstractScheme = LOOP,
    creases: Creases | None = None,
) -> Subdivided:
    """The mesh after `levels` levels of subdivision, with the operator that made it.

    x_fine = S x_coarse for positions and every attribute; normals are left out. The
    plan is made on the host from the faces, which must be known; positions and
    attributes may be traced: jit, vmap and gradients pass through. Padding is cut off.

    **Arguments:**

    - `mesh`: triangles for `Loop` and `Midpoint`, any polygons for the others. A
      `TriangleMesh` stays one as long as its faces are triangles.
    - `levels`: each one multiplies the faces by four.
    - `scheme`: `Loop()`, `CatmullClark()`, `Midpoint()`, `Bilinear()`.
    - `creases`: sharp edges and vertices; the border is always sharp.

    Raises `GeometryError` for a mesh without faces, indices out of range, a face that
    names a vertex twice, an edge of more than two faces, faces the scheme cannot take,
    creases that are not edges of the mesh, and more than 2^31 corners.

    >>> from jaxgeom.meshes import icosphere
    >>> subdivide(icosphere(1), 2).mesh.faces.shape
    (1280, 3)
    """
    plan = plan_subdivision(mesh, levels, scheme=scheme, creases=creases)
    return Subdivided(plan(mesh), plan.operator, plan.creases)


def refine(net: Net, levels: int, scheme: AbstractScheme):
    """The factors of several levels (host arrays) and the last net."""
    factors = ()
    for _ in range(levels):
        step, net = scheme.step(net)
        factors += step
    still = Rows((identity_band(0, net.num_vertices),), net.num_vertices)
    return factors or (still,), net


def exact(mesh: AnyMesh) -> AnyMesh:
    """The mesh without padding (host); its faces must not be traced."""
    if any(isinstance(x, jax.core.Tracer) for x in jax.tree.leaves(_faces(mesh))):
        must = "the faces must be known when a subdivision is planned"
        fix = "Plan outside of jit, vmap and grad, or close over the faces."
        raise GeometryError(message(must, "traced faces", fix))
    return mesh.trim() if isinstance(mesh, TriangleMesh) else mesh


def _faces(mesh):
    if isinstance(mesh, TriangleMesh):
        return mesh.faces, mesh.num_vertices, mesh.num_faces
    return mesh.faces
