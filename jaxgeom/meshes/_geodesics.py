"""Distances along the surface: by unfolding triangles, and by the heat method."""

from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from .._core import (
    RESULTS,
    check_shape,
    components,
    failure_where,
    first_failure,
    safe_divide,
    safe_normalize,
)
from ..linear import conjugate_gradients
from ..shapes import TriangleMesh
from ._edge_list import VertexNeighbors, vertex_neighbors
from ._heat import HeatSystem, solve_heat
from ._intrinsic import FlatFaces, flat_triangles
from ._topology import proper_faces
from ._unfold import unfold

# The most that heat flows along an edge: the cotangent of about 6 degrees.
_STRONGEST = 10.0


class Geodesics(eqx.Module):
    """Distances along a surface from the nearest source.

    `distances` [v] are infinite for vertices that no source is connected to and for
    padding. `steps`: those of the solver, all together; `residual`: that of the linear
    system, |b - L d| / |b|, 0 where there is none.
    """

    distances: Float[Array, " v"]
    steps: Int[Array, ""]
    residual: Float[Array, ""]
    result: RESULTS


class AbstractGeodesics(eqx.Module):
    """A way to measure along a surface."""

    @abstractmethod
    def measure(self, mesh: TriangleMesh, source: Bool[Array, " v"]) -> Geodesics:
        """The distances from the vertices where `source` is true."""

    @abstractmethod
    def prepared(self, mesh: TriangleMesh) -> "AbstractGeodesics":
        """The same way, with what has to be measured on the host."""


class Unfolding(AbstractGeodesics):
    """Straight lines through unfolded triangles, the least of all offers.

    Like Dijkstra's algorithm, with a source that every triangle unfolds into its plane,
    and for all vertices at once. About 0.2 % from the shortest way over the faces, and
    exact where one unfolding holds the whole of it. At most `max_steps`, of which about
    one and a half are needed for each ring of vertices around the source.

    Source: M. Novotni, R. Klein, Computing geodesic distances on triangular meshes,
    2002; P. Trettner et al., Geodesic distance computation via virtual source
    propagation, 2021.
    """

    max_steps: int = eqx.field(static=True, default=4000)

    def prepared(self, mesh):
        return self

    def measure(self, mesh, source):
        v = source.shape[0]
        faces = jnp.where(proper_faces(mesh)[:, None], mesh.faces, v)
        lengths = flat_triangles(mesh).lengths
        distances, steps = unfold(faces, lengths, source, self.max_steps)
        late = failure_where(steps >= self.max_steps, RESULTS.not_converged)
        return Geodesics(distances, steps, jnp.zeros((), lengths.dtype), late)


class Heat(AbstractGeodesics):
    """The heat method: smooth distances, of first order in the edge length h.

    1. Heat for a short time: (M + t L) u = 1 at the sources, t = smoothness h^2 with
       the mean edge length h, solved for log u.
    2. Its direction in every face: X = -grad u / |grad u|.
    3. The function whose gradient is nearest to it: L d = div X, d = 0 at the sources.

    A larger `smoothness` rounds off where fronts meet. Next to the sources the error is
    10 to 20 % of the (small) distance, and triangulations far from Delaunay cost
    accuracy everywhere (their negative weights are left out of step 1). `neighbors` is
    the table of `vertex_neighbors`, measured on the host if left out; under jit and for
    many calls pass it. `rtol` and `max_steps` belong
    to both solvers.

    Source: K. Crane, C. Weischedel, M. Wardetzky, Geodesics in heat, 2013.
    """

    neighbors: VertexNeighbors | None = None
    smoothness: Float[Array, ""] | float = 1.0
    rtol: float = eqx.field(static=True, default=1e-4)
    max_steps: int = eqx.field(static=True, default=4000)

    def prepared(self, mesh):
        if self.neighbors is not None:
            return self
        table = vertex_neighbors(mesh)
        return Heat(table, self.smoothness, self.rtol, self.max_steps)

    def measure(self, mesh, source):
        table = self.neighbors
        flat = flat_triangles(mesh)
        weights = _edge_weights(flat, table)
        system, unit = _heat_system(mesh, flat, table, weights, source, self.smoothness)
        heat = solve_heat(system, tolerance=self.rtol, max_steps=self.max_steps)
        slope = _divergence(mesh, flat, heat.value)
        reached = jnp.isfinite(heat.value)
        start = lax.stop_gradient(jnp.where(reached, unit * heat.value, 0))
        labels = _vertex_components(table, source.shape[0])
        found = _integrate(
            (table, weights, labels), slope, start, self.rtol, self.max_steps
        )
        return Geodesics(
            _from_sources(labels, found.value, source, heat.value),
            heat.steps + found.steps,
            found.residual,
            first_failure(table.result, heat.result, found.result),
        )


def geodesic_distance(
    mesh: TriangleMesh,
    sources: Int[Array, " s"],
    method: AbstractGeodesics | None = None,
) -> Geodesics:
    """The distance along the surface of every vertex from the nearest of `sources`.

    `sources` [s] holds indices of vertices; v is padding, so that sets of several sizes
    can be batched. `method` is `Unfolding()` (the default: accurate, nothing to
    prepare) or `Heat()` (smooth, after Crane). Differentiable in the vertices, by the
    implicit function theorem for a fixed course of the lines.

    Statuses: `not_converged`; `degenerate_input` where no source lies on the surface;
    `capacity_exceeded` of a table of neighbors.
    """
    check_shape("sources", sources, (None,))
    method = Unfolding() if method is None else method
    v = mesh.vertices.shape[0]
    on_surface = jnp.zeros(v, bool).at[mesh.faces].set(True, mode="drop")
    sources = jnp.asarray(sources)
    source = jnp.zeros(v, bool)
    source = source.at[jnp.where(sources < 0, v, sources)].set(True, mode="drop")
    source &= on_surface & mesh.vertex_mask
    out = _measure(method.prepared(mesh), mesh, source)
    lost = failure_where(~jnp.any(source), RESULTS.degenerate_input)
    result = first_failure(lost, out.result)
    return Geodesics(out.distances, out.steps, out.residual, result)


# Outside jit, loops would compile what they close over as constants (slowly).
@jax.jit
def _measure(method, mesh, source):
    return method.measure(mesh, source)


def _edge_weights(flat: FlatFaces, table: VertexNeighbors):
    """(cot + cot) / 2 of the angles opposite to each edge, in the table [k, v]."""
    of_faces = table.edge_list.of_faces
    e = table.edge_list.mask.shape[0]
    # The edge from corner d to d + 1 is opposite to corner d + 2.
    opposite = jnp.roll(flat.cotangents, -2, axis=1)
    total = jnp.zeros(e, flat.areas.dtype).at[of_faces].add(opposite / 2, mode="drop")
    return total.at[table.edges].get(mode="fill", fill_value=0)


def _heat_system(mesh, flat, table, weights, source, smoothness):
    """The heat system in units of the mean edge, and the length of one unit of log."""
    v = source.shape[0]
    number = jnp.maximum(3 * jnp.sum(flat.areas > 0), 1)
    mean = jnp.sum(flat.lengths) / number
    time = smoothness * mean**2
    third = jnp.broadcast_to(flat.areas[:, None] / 3, flat.lengths.shape)
    mass = jnp.zeros(v, flat.areas.dtype).at[mesh.faces].add(third, mode="drop")
    mass = safe_divide(mass, time)
    # Of a triangulation that is not Delaunay some weights are negative, and heat would
    # not be positive; across the slivers next to short edges they are huge, and the
    # iteration would not end. Which way heat flows is hardly changed.
    weights = jnp.clip(weights, 0, _STRONGEST)
    system = HeatSystem(weights, mass, table.vertices, source)
    return system, jnp.sqrt(jnp.where(time > 0, time, 1))


def _divergence(mesh, flat, log):
    """The integrated divergence of the unit field against the gradient of heat."""
    faces = jnp.where(mesh.face_mask[:, None], mesh.faces, log.shape[0])
    at = log.at[faces].get(mode="fill", fill_value=jnp.inf)
    low = jnp.min(at, axis=1, keepdims=True)
    heated = jnp.isfinite(low)
    finite = jnp.isfinite(at) & heated
    gap = jnp.where(finite, at, 0) - jnp.where(heated, low, 0)
    # Constants do not matter: relative to the warmest corner no digit is lost.
    heat = jnp.where(finite, jnp.expm1(-jnp.where(finite, gap, 0)), -1)
    heat = jnp.where(heated, heat, 0)
    across = safe_normalize(jnp.einsum("fd,fdx->fx", heat, flat.sides))
    flux = jnp.einsum("fdx,fx->fd", flat.sides, across) / 2
    return jnp.zeros_like(log).at[faces].add(-flux, mode="drop")


def _vertex_components(table, v):
    ends = table.edge_list.vertices
    return components(v, ends[:, 0], ends[:, 1])


def _integrate(surface, slope, start, rtol, max_steps):
    """The solution of L d = slope, from the multiple of `start` that is best."""
    table, weights, labels = surface
    total = jnp.sum(weights, axis=0)

    def laplacian(x):
        near = x.at[table.vertices].get(mode="fill", fill_value=0)
        return total * x - jnp.sum(weights * near, axis=0)

    number = jnp.zeros_like(slope).at[labels].add(1)[labels]

    def centered(x):
        # Constants on a component are invisible to L: rounding must not feed them.
        return x - jnp.zeros_like(x).at[labels].add(x)[labels] / number

    diagonal = lax.stop_gradient(jnp.where(total > 0, total, 1))
    rise = lax.stop_gradient(laplacian(start))
    scale = safe_divide(jnp.vdot(start, slope), jnp.vdot(start, rise))
    start = lax.stop_gradient(scale) * start
    solution = conjugate_gradients(
        laplacian,
        centered(slope - laplacian(start)),
        rtol=rtol,
        max_steps=max_steps,
        preconditioner=lambda r: centered(centered(r) / diagonal),
    )
    return eqx.tree_at(lambda s: s.value, solution, start + solution.value)


def _from_sources(labels, height, source, log):
    """The height above the lowest source of the same component."""
    v = height.shape[0]
    high = jnp.where(source & jnp.isfinite(log), height, jnp.inf)
    lowest = jnp.full(v, jnp.inf, height.dtype).at[labels].min(high)[labels]
    reached = jnp.isfinite(lowest) & jnp.isfinite(log)
    return jnp.where(reached, height - jnp.where(reached, lowest, 0), jnp.inf)
