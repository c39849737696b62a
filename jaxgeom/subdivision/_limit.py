"""Where the vertices go after infinitely many levels, and the tangents there."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._core import GeometryError, message, safe_normalize
from ._creases import Creases, with_creases
from ._limit_rows import neighborhoods, position_band, tangent_bands
from ._masks import AbstractMasks, CatmullClarkMasks, LoopMasks
from ._net import Net, check_room, grouped, net_of
from ._operator import Refinement, Rows, on_device
from ._rings import Sectors, sectors_of
from ._schemes import AbstractScheme, CatmullClark, Loop
from ._subdivide import LOOP, AnyMesh, exact


class Limit(eqx.Module):
    """The limit of a subdivision at the vertices of its control mesh, as operators.

    - `position` [v, v]: `limit.position @ x` are points of the limit surface, and the
      limits of any attribute.
    - `first`, `second` [s, v]: two tangents for each sector, whose cross product points
      outside. A vertex has one sector, or as many as infinitely sharp edges leave it.
    - `vertices` [s]: the vertex of each sector; `corners`: the sector of each corner of
      each face, arrays [f, k] like the faces.
    """

    position: Refinement
    first: Refinement
    second: Refinement
    vertices: Int[Array, " s"]
    corners: tuple[Int[Array, "f k"], ...]

    def sector_normals(self, vertices: Float[Array, "v 3"]) -> Float[Array, "s 3"]:
        """The unit normal of each sector; zero where its tangents are parallel."""
        return safe_normalize(jnp.cross(self.first @ vertices, self.second @ vertices))

    def normals(self, vertices: Float[Array, "v 3"]) -> Float[Array, "v 3"]:
        """The unit normal of the limit surface at each vertex.

        On a crease the unit mean of the normals of its sectors.
        """
        each = self.sector_normals(vertices)
        return safe_normalize(jnp.zeros_like(vertices).at[self.vertices].add(each))


def limit(
    mesh: AnyMesh, *, scheme: AbstractScheme = LOOP, creases: Creases | None = None
) -> Limit:
    """The limit positions and tangents of a control mesh, as operators (host).

    With A the matrix of one level on the neighborhood of a vertex, its limit is the
    left eigenvector of A for the eigenvalue 1, and its tangents those of the largest
    eigenvalues below. Known in closed form for smooth vertices, borders and creases; at
    the end of a crease (one sharp edge) computed for each number of edges.

    Where faces are not quadrilaterals (Catmull-Clark) or creases are semi-sharp the
    mesh is refined until they are gone, ceil(sharpness) levels: four times the faces
    for each, but only rows of the vertices of `mesh` are kept. A crease meant to stay
    should have a sharpness of `numpy.inf`.

    Tangents are those of the published rules, which have no tangent plane everywhere:
    with more than 3 (Loop: 5) faces between the two sharp edges of a border or crease,
    and at fixed vertices with more than 2 (Loop: 3) faces between sharp edges, or with
    less than two of these (cones), the normal is that of the plane through the first
    tangents, not the limit of the normals of the faces (Biermann, Levin, Zorin 2000).

    Raises `GeometryError` as `subdivide` does, for inconsistent orientation, and for
    schemes other than `Loop` and `CatmullClark`.

    Source: M. Halstead, M. Kass, T. DeRose, 1993 (Catmull-Clark); H. Hoppe et al.,
    1994 (Loop). The tangents across borders and creases are those of the unmodified
    rules; Biermann et al. give those of their modified ones.

    >>> from jaxgeom.meshes import icosphere
    >>> limits = limit(icosphere(1))
    >>> limits.normals(icosphere(1).vertices).shape
    (42, 3)
    """
    masks = _masks_of(scheme)
    net = with_creases(net_of(exact(mesh)), creases)
    factors, corner = (), np.arange(net.corners.size)
    fine, v = net, net.num_vertices
    check_room(net, _levels_until_settled(net))
    while not _is_simple(fine, masks):
        step, finer = scheme.step(fine)
        factors, corner = factors + step, masks.tip(corner)
        fine = finer
    around = sectors_of(fine)
    _check_fans(fine, around)
    near = neighborhoods(fine, around)
    count = int(np.searchsorted(around.vertex, v))
    first, second = tangent_bands(fine, around, near, masks, count)
    position = position_band(fine, near, masks, v)
    chain = lambda band: Refinement((*factors, Rows((band,), fine.num_vertices)))
    corners = grouped(around.sector[corner], net.sizes)
    vertices = around.vertex[:count]
    parts = (chain(position), chain(first), chain(second), vertices, corners)
    return Limit(*on_device(parts))


def _levels_until_settled(net: Net) -> int:
    """How long the most sharp edge or vertex lasts."""
    values = np.concatenate([net.sharpness, net.pins])
    return int(np.ceil(np.max(values, where=np.isfinite(values), initial=0)))


def _is_simple(net: Net, masks: AbstractMasks) -> bool:
    """Nothing semi-sharp, and faces the masks hold for."""
    values = np.concatenate([net.sharpness, net.pins])
    return masks.takes(net.sizes) and not np.any((values > 0) & np.isfinite(values))


def _check_fans(net: Net, around: Sectors):
    """A vertex all around which faces lie has one fan, unless it is fixed."""
    fans = np.bincount(around.vertex[around.closed], minlength=net.num_vertices)
    crowded = np.flatnonzero((fans > 1) & np.isfinite(net.pins))
    if crowded.size:
        must = "the faces around a vertex must be one fan for it to have a limit"
        given = f"{crowded.size} vertices with several, first {crowded[0]}"
        fix = "Give each fan its own vertex, or fix the vertex with Creases."
        raise GeometryError(message(must, given, fix))


def _masks_of(scheme) -> AbstractMasks:
    if isinstance(scheme, Loop):
        return LoopMasks(scheme.weights)
    if isinstance(scheme, CatmullClark):
        return CatmullClarkMasks()
    must = "limits are known for Loop and CatmullClark"
    fix = "Midpoint and Bilinear do not move vertices."
    raise GeometryError(message(must, f"{type(scheme).__name__}", fix))
