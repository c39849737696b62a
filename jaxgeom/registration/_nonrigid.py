"""Non-rigid registration: a mesh deformed onto a cloud or another mesh.

    energy = mean of w |D (v' - q)|^2 + stiffness * strain + landmark weight * mean of
             |v'_l - p_l|^2

with v' the moved vertices, q the closest points of the target, w robust weights and D
the part across the surface and a share of that along it. Correspondences, Gauss-Newton
step (conjugate gradients on J^T J, which is never formed), and again, while the
stiffness falls. Everything runs in units of the half diagonal of the template.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._core import RESULTS, failure_where, first_failure, safe_divide
from ..linear import iterate
from ..meshes import vertex_normals
from ..shapes import PointCloud, TriangleMesh
from ._deformation import AbstractDeformation, Frames
from ._matching import across, finder, matched
from ._stiffness import AsRigidAsPossible, StiffnessSchedule


class Landmarks(eqx.Module):
    """Vertices [l] of the template and the points [l, 3] where they belong.

    `weight` is that of their mean squared distance beside that of the closest points.
    """

    vertices: Int[Array, " l"]
    points: Float[Array, "l 3"]
    weight: Float[Array, ""] | float = 10.0


class Deformed(eqx.Module):
    """The template in its new shape, and how well it lies on the target.

    `rmse` is the root mean square distance of matched vertices to their closest points,
    in the unit of the template; `fitness` the share of the vertices that are matched.
    `result` is `not_converged` where the last stage was still moving, `too_few_points`
    where nothing matched, `no_surface` for a target without faces.
    """

    mesh: TriangleMesh
    rmse: Float[Array, ""]
    fitness: Float[Array, ""]
    steps: Int[Array, ""]
    result: RESULTS


class Conditions(eqx.Module):
    """When vertices match and when steps end; lengths in units of the template."""

    max_distance: Float[Array, ""] | float
    least_cosine: Float[Array, ""] | float
    tangential: Float[Array, ""] | float
    max_steps: int = eqx.field(static=True)
    rtol: Float[Array, ""] | float
    linear_steps: int = eqx.field(static=True)


class _LeastSquares(eqx.Module):
    """All matched vertices count the same; kernels have these two methods."""

    def width(self, squares, mask, previous):
        """The width of the kernel, in the unit of the residuals."""
        return jnp.ones((), squares.dtype)

    def weight(self, s):
        """The weight of a squared residual, in units of the squared width."""
        return jnp.ones_like(s)


def nonrigid(
    template: TriangleMesh,
    target: PointCloud | TriangleMesh,
    *,
    model: AbstractDeformation | None = None,
    landmarks: Landmarks | None = None,
    kernel=None,
    schedule: StiffnessSchedule | None = None,
    max_distance: float = jnp.inf,
    max_angle: float = jnp.pi / 3,
    tangential: float = 0.01,
    max_steps: int = 10,
    rtol: float = 1e-3,
    linear_steps: int = 100,
) -> Deformed:
    """The template deformed onto the target; faces and attributes stay as they are.

    **Arguments:**

    - `template`, `target`: roughly aligned (see `procrustes`, `align_features`). A
      cloud without normals is matched by its points alone.
    - `model`: `AsRigidAsPossible()` by default, `PerVertexAffine()`, `EmbeddedGraph()`.
    - `kernel`: weighs residuals by `weight(s)`, s their square in units of the squared
      width `width(squares, mask, previous)`; least squares by default.
    - `schedule`: the falling stiffness; with each, at most `max_steps` Gauss-Newton
      steps, until vertices move less than `rtol` half diagonals (root mean square).
    - `max_distance` (unit of the points), `max_angle` (radians between the normals):
      what is farther or steeper does not match.
    - `tangential`: the weight of the residual along the surface of the target, squared:
      0 is point-to-plane, 1 point-to-point.
    - `linear_steps`: conjugate gradients per Gauss-Newton step, at most.

    Made for jit; memory grows with v + f, not with their product. The shape is the
    minimum only up to `rtol`: differentiate the energy, not this function.

    Source: B. Amberg, S. Romdhani, T. Vetter, Optimal step nonrigid ICP algorithms for
    surface registration, 2007 (the loop); models name their own.
    """
    template = jax.tree.map(jnp.asarray, template)
    center, size = _half_diagonal(template)
    inside = lambda x: (x - center) / size
    mesh = eqx.tree_at(lambda m: m.vertices, template, inside(template.vertices))
    wash = jnp.where(mesh.vertex_mask[:, None], mesh.vertices, 0)
    mesh = eqx.tree_at(lambda m: m.vertices, mesh, wash)
    find, ready = finder(jax.tree.map(jnp.asarray, target), inside)
    if landmarks is not None:
        moved = inside(jnp.asarray(landmarks.points, mesh.vertices.dtype))
        landmarks = Landmarks(jnp.asarray(landmarks.vertices), moved, landmarks.weight)
    cosine = jnp.cos(max_angle)
    conditions = Conditions(
        max_distance / size, cosine, tangential, max_steps, rtol, linear_steps
    )
    problem = _Problem(
        mesh,
        AsRigidAsPossible() if model is None else model,
        landmarks,
        _LeastSquares() if kernel is None else kernel,
        StiffnessSchedule() if schedule is None else schedule,
        conditions,
    )
    out = _anneal(problem, find)
    return _report(template, out, first_failure(ready, out.result), center, size)


class _Problem(eqx.Module):
    """What stays the same during the run."""

    mesh: TriangleMesh
    model: AbstractDeformation
    landmarks: Landmarks | None
    kernel: eqx.Module
    schedule: StiffnessSchedule
    conditions: Conditions


class _State(eqx.Module):
    """Where the run stands; `step` counts within the stage."""

    frames: Frames
    width: Float[Array, ""]
    stage: Int[Array, ""]
    step: Int[Array, ""]
    steps: Int[Array, ""]
    moving: Bool[Array, ""]


class _Outcome(eqx.Module):
    vertices: Float[Array, "v 3"]
    rmse: Float[Array, ""]
    fitness: Float[Array, ""]
    steps: Int[Array, ""]
    result: RESULTS


def _anneal(problem: _Problem, find) -> _Outcome:
    """Gauss-Newton steps while the stiffness falls."""
    model, conditions = problem.model, problem.conditions
    prepared = model.prepare(problem.mesh)
    dtype = problem.mesh.vertices.dtype
    real = problem.mesh.vertex_mask
    number = jnp.maximum(jnp.sum(real), 1).astype(dtype)

    def look(frames):
        vertices = model.vertices(prepared, frames)
        return vertices, matched(problem.mesh, conditions, find, vertices)

    def step(state):
        before, matches = look(state.frames)
        stiffness = problem.schedule(state.stage, dtype)
        frames, width = _gauss_newton(
            problem, prepared, state.frames, matches, stiffness, state.width
        )
        change = jnp.sum((model.vertices(prepared, frames) - before) ** 2, axis=-1)
        moved = jnp.sqrt(jnp.sum(jnp.where(real, change, 0)) / number)
        moving = moved > conditions.rtol
        on = moving & (state.step + 1 < conditions.max_steps)
        return _State(
            frames,
            width,
            jnp.where(on, state.stage, state.stage + 1),
            jnp.where(on, state.step + 1, 0),
            state.steps + 1,
            moving,
        )

    none = jnp.int32(0)
    first = _State(
        prepared.rest, jnp.full((), jnp.inf, dtype), none, none, none, jnp.asarray(True)
    )
    more = lambda s: s.stage < problem.schedule.stages
    end = jax.lax.while_loop(more, step, first)
    vertices, matches = look(end.frames)
    square = jnp.sum((vertices - matches.points) ** 2, axis=-1)
    count = jnp.sum(matches.mask).astype(dtype)
    total = jnp.sum(jnp.where(matches.mask, square, 0))
    few = failure_where(count == 0, RESULTS.too_few_points)
    late = failure_where(end.moving, RESULTS.not_converged)
    return _Outcome(
        vertices,
        jnp.sqrt(safe_divide(total, count)),
        count / number,
        end.steps,
        first_failure(few, late),
    )


def _gauss_newton(problem, prepared, frames, matches, stiffness, width):
    """The frames after one step down the energy of fixed correspondences."""
    model, conditions = problem.model, problem.conditions
    vertices = model.vertices(prepared, frames)
    rows = across(vertices, matches, conditions.tangential)
    squares = jnp.sum(rows**2, axis=-1)
    width = problem.kernel.width(squares, matches.mask, width)
    width = jnp.where(width > 0, width, jnp.finfo(width.dtype).tiny ** 0.25)
    weights = jnp.where(matches.mask, problem.kernel.weight(squares / width**2), 0)
    weights = safe_divide(weights, jnp.sum(matches.mask).astype(weights.dtype))
    stiff = jnp.sqrt(stiffness)

    def residuals(tangent):
        moved = model.move(prepared, frames, tangent)
        vertices = model.vertices(prepared, moved)
        data = across(vertices, matches, conditions.tangential)
        strain = [stiff * row for row in model.strain(prepared, moved)]
        return (
            jnp.sqrt(weights)[:, None] * data,
            strain,
            landmark_rows(problem.landmarks, vertices),
        )

    zero = jnp.zeros((frames.points.shape[0], model.freedoms), vertices.dtype)
    value, push = jax.linearize(residuals, zero)
    pull = jax.linear_transpose(push, zero)
    solution = iterate(
        lambda t: pull(push(t))[0],
        -pull(value)[0],
        rtol=1e-2,
        max_steps=conditions.linear_steps,
        preconditioner=lambda r: r,
        start=jnp.zeros_like,
    )
    return model.move(prepared, frames, solution.value), width


def landmark_rows(landmarks: Landmarks | None, vertices) -> Float[Array, "l 3"]:
    """Rows whose sum of squares is the weighted mean squared distance."""
    if landmarks is None:
        return vertices[:0]
    number = landmarks.points.shape[0]
    scale = jnp.sqrt(jnp.asarray(landmarks.weight, vertices.dtype) / number)
    return scale * (vertices[landmarks.vertices] - landmarks.points)


def _half_diagonal(mesh: TriangleMesh):
    """The center and half the diagonal of the bounding box."""
    real = mesh.vertex_mask[:, None]
    low = jnp.min(jnp.where(real, mesh.vertices, jnp.inf), axis=0)
    high = jnp.max(jnp.where(real, mesh.vertices, -jnp.inf), axis=0)
    some = mesh.num_vertices > 0
    low, high = jnp.where(some, low, 0), jnp.where(some, high, 0)
    size = jnp.sqrt(jnp.sum((high - low) ** 2)) / 2
    return (low + high) / 2, jnp.where(size > 0, size, 1)


def _report(template, out: _Outcome, result, center, size) -> Deformed:
    vertices = jnp.where(
        template.vertex_mask[:, None], center + size * out.vertices, template.vertices
    )
    mesh = eqx.tree_at(lambda m: m.vertices, template, vertices)
    if template.normals is not None:
        mesh = eqx.tree_at(lambda m: m.normals, mesh, vertex_normals(mesh))
    return Deformed(mesh, size * out.rmse, out.fitness, out.steps, result)
