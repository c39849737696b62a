"""A control mesh whose limit surface passes through measured points."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._core import RESULTS, GeometryError, bucket, message, safe_normalize
from ..linear import iterate
from ..neighbors import closest_on_mesh
from ..shapes import PointCloud, PolygonMesh, TriangleMesh
from ._creases import Creases, with_creases
from ._limit import limit
from ._net import net_of
from ._operator import Refinement, Rows, band_from_entries, on_device
from ._schemes import AbstractScheme
from ._subdivide import LOOP, AnyMesh, exact, plan_subdivision

_FIRST_HOLD = 0.3
_EASIER, _HARDER = 0.3, 4.0
_STEPS_PER_SOLVE = 100
_SOLVE_RTOL = 1e-3


class ControlFit(eqx.Module):
    """A control mesh fitted to points.

    - `cage`: the control mesh; `surface`: its limit at the vertices of the refined
      cage, as triangles; `operator`: surface.vertices = operator @ cage.vertices.
    - `rms` [max_steps + 1]: the root mean square distance of the points to the surface
      at the start and after each step, the last value repeated; `energies` likewise:
      rms^2 plus the prior, which never grows.
    - `steps`; `result`: `successful`, `nonlinear_max_steps_reached` where the energy
      still fell faster than `rtol` at the end, `too_few_points` without any real point.
    """

    cage: AnyMesh
    surface: TriangleMesh
    operator: Refinement
    rms: Float[Array, " t"]
    energies: Float[Array, " t"]
    steps: Int[Array, ""]
    result: RESULTS


def fit_control_mesh(
    cloud: PointCloud | Float[Array, "n 3"],
    cage: AnyMesh,
    *,
    levels: int = 2,
    scheme: AbstractScheme = LOOP,
    creases: Creases | None = None,
    smoothness: float = 1e-2,
    rtol: float = 1e-2,
    max_steps: int = 30,
) -> ControlFit:
    """The control mesh, connected like `cage`, whose limit surface fits the points.

    Minimises over the control vertices V

        mean_i d(p_i, M V)^2 + smoothness * mean_v |(L V)_v|^2,

    M being the operator to limit positions of the cage after `levels` levels, joined by
    triangles, and L the difference of each control vertex and the mean of its neighbors
    (a thin plate). Gauss-Newton through M: with the closest points held, each point
    counts along the direction n_i to its closest point, and a share `hold` <= 1 across
    it; the normal equations are solved by conjugate gradients. A step that raises the
    energy is not taken and repeated with more hold: for hold = 1 it never does.

    A host function, jitted inside, without derivative. Points that are masked or not
    finite do not count.

    **Arguments:**

    - `cloud`: a `PointCloud` or points [n, 3], already near the cage.
    - `smoothness`: dimensionless, 0 for none (then cage vertices far from all points
      are free). `rtol`: stop when the energy falls by less than this share.
    - `levels`, `scheme`, `creases`: as for `subdivide` and `limit`.

    Raises `GeometryError` as `limit` does, and for negative settings.

    Source: H. Pottmann, S. Leopoldseder, A concept for parametric surface fitting which
    avoids the parametrization problem, 2003 (tangent distance minimisation); T.
    Cashman, A. Fitzgibbon, What shape are dolphins?, 2013 (fitting through the scheme).
    """
    _check_settings(smoothness, rtol, max_steps)
    cloud = cloud if isinstance(cloud, PointCloud) else PointCloud(cloud)
    cage = exact(cage)
    plan = plan_subdivision(cage, levels, scheme=scheme, creases=creases)
    fine = plan(cage)
    operator = limit(fine, scheme=scheme, creases=plan.creases).position @ plan.operator
    faces = fine.triangulate() if isinstance(fine, PolygonMesh) else fine
    points = jnp.asarray(cloud.points, float)
    live = jnp.asarray(cloud.mask) & jnp.all(jnp.isfinite(points), axis=1)
    problem = _Problem(
        jnp.where(live[:, None], points, 0),
        live / jnp.maximum(jnp.sum(live), 1),
        operator,
        jnp.asarray(faces.faces),
        _umbrella(cage, creases),
        jnp.asarray(smoothness, points.dtype),
    )
    start = jnp.asarray(cage.vertices, points.dtype)
    rtol = jnp.asarray(rtol, points.dtype)
    room = bucket(max_steps + 1)
    end, surface, result = _fit(problem, start, rtol, jnp.int32(max_steps), room)
    moved = eqx.tree_at(lambda mesh: mesh.vertices, cage, end.vertices)
    if isinstance(moved, TriangleMesh):
        moved = TriangleMesh(moved.vertices, moved.faces, attributes=moved.attributes)
    mesh = TriangleMesh(surface, faces.faces)
    rms, energies = end.rms[: max_steps + 1], end.energies[: max_steps + 1]
    return ControlFit(moved, mesh, operator, rms, energies, end.looks - 1, result)


class _Problem(eqx.Module):
    """What is minimised; `shares` [n] add up to one over the real points."""

    points: Float[Array, "n 3"]
    shares: Float[Array, " n"]
    operator: Refinement
    faces: Int[Array, "f 3"]
    umbrella: Refinement
    smoothness: Float[Array, ""]

    def prior(self, vertices):
        """smoothness * mean |L V|^2."""
        return (
            self.smoothness * jnp.sum((self.umbrella @ vertices) ** 2) / len(vertices)
        )


class _Feet(eqx.Module):
    """The closest points of the surface, held during one step."""

    corners: Int[Array, "n 3"]
    weights: Float[Array, "n 3"]
    gaps: Float[Array, "n 3"]
    mean_square: Float[Array, ""]

    def __matmul__(self, surface: Float[Array, "m 3"]) -> Float[Array, "n 3"]:
        return jnp.einsum("nk,nkd->nd", self.weights, surface[self.corners])


class _State(eqx.Module):
    """The best vertices so far, and the candidate to be looked at next."""

    candidate: Float[Array, "v 3"]
    vertices: Float[Array, "v 3"]
    feet: _Feet
    hold: Float[Array, ""]
    rms: Float[Array, " t"]
    energies: Float[Array, " t"]
    looks: Int[Array, ""]
    done: Bool[Array, ""]


@eqx.filter_jit
def _fit(problem: _Problem, start, rtol, max_steps, room: int):
    first = _first(problem, start, room)
    more = lambda state: ~state.done & (state.looks <= max_steps)
    end = jax.lax.while_loop(more, lambda state: _look(problem, state, rtol), first)
    late = RESULTS.nonlinear_max_steps_reached
    result = RESULTS.where(end.done, RESULTS.successful, late)
    some = jnp.any(problem.shares > 0)
    result = RESULTS.where(some, result, RESULTS.too_few_points)
    return end, problem.operator @ end.vertices, result


def _first(problem: _Problem, start, room: int) -> _State:
    """Nothing looked at yet: any candidate is better."""
    n, dtype = problem.points.shape[0], start.dtype
    none = jnp.zeros((n, 3), dtype)
    feet = _Feet(jnp.zeros((n, 3), jnp.int32), none, none, jnp.zeros((), dtype))
    history = jnp.full(room, jnp.inf, dtype)
    hold, looks = jnp.asarray(_FIRST_HOLD, dtype), jnp.int32(0)
    return _State(start, start, feet, hold, history, history, looks, jnp.asarray(False))


def _look(problem: _Problem, state: _State, rtol) -> _State:
    """Keep the candidate if it lowers the energy; then the next Gauss-Newton step.

    The closest points are searched here only: the search is what takes time to compile.
    """
    found = _feet(problem, state.candidate)
    energy, before = (
        found.mean_square + problem.prior(state.candidate),
        state.energies[-1],
    )
    better, opening = energy < before, state.looks == 0
    pick = lambda new, old: jax.tree.map(lambda a, b: jnp.where(better, a, b), new, old)
    new, old = (state.candidate, found), (state.vertices, state.feet)
    vertices, feet = pick(new, old)
    later = jnp.arange(state.rms.shape[0]) >= state.looks
    record = lambda history, value: jnp.where(later, value, history)
    # With full hold a step cannot raise the energy but by rounding.
    stuck = ~better & (state.hold >= 1)
    settled = better & ~opening & (before - energy <= rtol * before)
    factor = jnp.where(better, jnp.where(opening, 1, _EASIER), _HARDER)
    hold = jnp.clip(state.hold * factor, jnp.finfo(energy.dtype).eps, 1)
    return _State(
        vertices + _direction(problem, vertices, feet, hold),
        vertices,
        feet,
        hold,
        record(state.rms, jnp.sqrt(feet.mean_square)),
        record(state.energies, jnp.minimum(energy, before)),
        state.looks + 1,
        stuck | settled,
    )


def _direction(problem: _Problem, at, feet: _Feet, hold) -> Float[Array, "v 3"]:
    """The step of Gauss and Newton: J^T J x = -J^T r for all terms together."""
    scale = jnp.sqrt(problem.shares)[:, None]
    normals = safe_normalize(feet.gaps)
    weight = jnp.sqrt(problem.smoothness / len(at))

    def residuals(vertices):
        moved = feet @ (problem.operator @ vertices)
        along = jnp.sum(normals * moved, axis=1, keepdims=True) * normals
        across = moved - along
        rough = weight * (problem.umbrella @ vertices)
        return scale * along, scale * jnp.sqrt(hold) * across, rough

    transpose = jax.linear_transpose(residuals, at)
    normal_matrix = lambda x: transpose(residuals(x))[0]
    rough = weight * (problem.umbrella @ at)
    errors = scale * feet.gaps, jnp.zeros_like(feet.gaps), rough
    return iterate(
        normal_matrix,
        -transpose(errors)[0],
        rtol=_SOLVE_RTOL,
        max_steps=_STEPS_PER_SOLVE,
        preconditioner=lambda r: r,
        start=jnp.zeros_like,
    ).value


def _feet(problem: _Problem, vertices) -> _Feet:
    surface = problem.operator @ vertices
    near = closest_on_mesh(TriangleMesh(surface, problem.faces), problem.points)
    gaps = near.points - problem.points
    mean_square = jnp.sum(problem.shares * near.distances**2)
    corners = problem.faces.at[near.faces].get(mode="clip")
    return _Feet(corners, near.barycentric, gaps, mean_square)


def _umbrella(cage: AnyMesh, creases: Creases | None) -> Refinement:
    """Each vertex minus the mean of its neighbors; along the border and creases only
    the neighbors there, and nothing for vertices that are fixed."""
    net = with_creases(net_of(cage), creases)
    sharp = net.sharpness > 0
    number = np.bincount(net.ends[:, sharp].ravel(), minlength=net.num_vertices)
    on_line = number == 2
    counts = np.where(on_line, 2, net.valence)
    free = (number < 3) & (net.pins == 0) & (counts > 0)
    a, b = net.ends
    weight = lambda end: (
        (sharp | ~on_line[end]) * free[end] / np.maximum(counts, 1)[end]
    )
    each = np.arange(net.num_vertices)
    rows = np.concatenate([each, a, b])
    columns = np.concatenate([each, b, a])
    weights = np.concatenate([free * 1.0, -weight(a), -weight(b)])
    shape = (net.num_vertices, net.num_vertices)
    band = band_from_entries(rows, columns, weights, shape)
    return Refinement(on_device((Rows((band,), net.num_vertices),)))


def _check_settings(smoothness, rtol, max_steps):
    for name, value in (("smoothness", smoothness), ("rtol", rtol)):
        if not value >= 0:
            must = f"{name} must be at least 0"
            raise GeometryError(message(must, f"{value}", "Use a small number."))
    if max_steps < 1:
        must = "max_steps must be at least 1"
        raise GeometryError(message(must, f"{max_steps}", "Allow some steps."))
