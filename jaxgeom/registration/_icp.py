"""Iterative closest points: pairs, a step, pairs again, until the pose stays."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._core import (
    RESULTS,
    GeometryError,
    check_shape,
    failure_where,
    first_failure,
    message,
    safe_divide,
)
from ..shapes import PointCloud, TriangleMesh
from ..transforms import Affine, Rigid, Similarity
from ._correspondences import AbstractCorrespondence, Found, Nearest
from ._kernels import AbstractKernel, Tukey
from ._models import AbstractModel, RigidModel, Tangent, tangent_of
from ._objectives import AbstractObjective, PointToPlane
from ._problem import Problem, problem_of
from ._solvers import AbstractSolver, GaussNewton

_SETTLED = 0.99


class Degeneracy(eqx.Module):
    """Which moves the pairs do not determine.

    `eigenvalues` [k], ascending, of the information matrix with shifts in units of the
    size of the target, and the moves `directions` [k, dof] they belong to (tangent
    vectors about the origin, row by row).
    """

    eigenvalues: Float[Array, " k"]
    directions: Float[Array, "k dof"]


class Registration(eqx.Module):
    """An alignment, why it stopped, and how far it can be trusted.

    - `target_from_source`: the transform.
    - `result`: `too_few_points`, `no_overlap`, `too_few_matches`, `degenerate_input`,
      `not_converged` or success.
    - `rmse`: root mean square residual of the objective over the pairs, with the
      weights of the kernel, in the unit of the target.
    - `fitness`: the share of the source's weight that has a pair.
    - `distance`: root mean square distance between the points of the pairs.
    - `num_matches`, `num_steps`: pairs at the end, searches made.
    - `width`: of the kernel at the end.
    - `information`: [dof, dof] = sum w rho' J^T J for tangent vectors about the origin.
    - `scatter`: [dof, dof] = sum (w rho' J^T r)(...)^T, for the sandwich form.
    - `noise`: standard deviation of one residual, as the weighted rows have it:
      sqrt(sum w rho'^2 r^2 / sum w rho').
    - `sharpness`: the second derivative of the kernel over its weight, mean over the
      pairs: sum w (rho' + 2 s rho'') / sum w rho'. One for `L2`, smaller for others.
    - `degeneracy`: its eigenvalues and the moves they belong to.
    - `history`: [max_steps] costs, infinite after the last step; None if not asked for.
    """

    target_from_source: Rigid | Similarity | Affine
    result: RESULTS
    rmse: Float[Array, ""]
    fitness: Float[Array, ""]
    distance: Float[Array, ""]
    num_matches: Int[Array, ""]
    num_steps: Int[Array, ""]
    width: Float[Array, ""]
    information: Float[Array, "dof dof"]
    scatter: Float[Array, "dof dof"]
    noise: Float[Array, ""]
    sharpness: Float[Array, ""]
    degeneracy: Degeneracy
    history: Float[Array, " steps"] | None


class Method(eqx.Module):
    """The parts an alignment is composed of."""

    correspondence: AbstractCorrespondence = Nearest()
    objective: AbstractObjective = PointToPlane()
    kernel: AbstractKernel = Tukey()
    model: AbstractModel = RigidModel()
    solver: AbstractSolver = GaussNewton()


class _Scene(eqx.Module):
    """Source and target about their centers, and what does not change."""

    source: PointCloud
    weights: Float[Array, " n"]
    prepared: eqx.Module
    source_center: Float[Array, " 3"]
    center: Float[Array, " 3"]
    tangent: Tangent
    method: Method
    max_distance: Float[Array, ""]

    def outward(self, pose):
        """A transform between the centered clouds as one between the given ones."""
        shift = pose.shift() + self.center - pose.linear() @ self.source_center
        return eqx.tree_at(lambda t: t.translation, pose, shift)

    def inward(self, pose):
        """The other way round."""
        shift = pose.shift() - self.center + pose.linear() @ self.source_center
        return eqx.tree_at(lambda t: t.translation, pose, shift)

    def match(self, pose, last: Found | None = None) -> Found:
        """The pairs at a pose, given those at the pose before."""
        rule, moved = self.method.correspondence, pose(self.source)
        return rule.match(self.prepared, moved, self.max_distance, last)

    def problem(self, pose, found, previous) -> Problem:
        """The problem of given pairs at a pose, with the next width."""
        method, moved = self.method, pose(self.source)
        places = method.correspondence.places(self.prepared, moved, found)
        parts = dict(
            tangent=self.tangent,
            pose=self.outward(pose),
            objective=method.objective,
            kernel=method.kernel,
            model=method.model,
        )
        mask = found.mask & (self.weights > 0)
        args = (moved, places, mask, self.weights, previous)
        problem = problem_of(*args, **parts)
        zero = jnp.zeros(problem.size, moved.points.dtype)
        width = method.kernel.width(problem.squares(zero), mask, previous)
        # Residuals below rounding say nothing of the noise.
        rounding = 64 * jnp.finfo(width.dtype).eps * _size_of(self)
        width = jnp.maximum(width, rounding)
        width = jnp.where(jnp.any(mask), width, previous)
        return eqx.tree_at(lambda p: p.width, problem, width)


class _State(eqx.Module):
    pose: Rigid | Similarity | Affine
    found: Found
    damping: Float[Array, ""]
    width: Float[Array, ""]
    steps: Int[Array, ""]
    done: Bool[Array, ""]
    history: Float[Array, " steps"] | None


def icp(
    source: PointCloud,
    target: PointCloud | TriangleMesh,
    *,
    init: Rigid | Similarity | Affine | None = None,
    method: Method | None = None,
    max_distance: Float[Array, ""] | float = jnp.inf,
    weights: Float[Array, " n"] | None = None,
    rtol: float | None = None,
    max_steps: int = 50,
    min_matches: int = 6,
    history: bool = False,
) -> Registration:
    """The transform that lays the source on the target, from a start nearby.

    Pairs every source point with a place of the target, makes one step of the solver on
    sum_i w_i width^2 rho(|r_i|^2 / width^2), and pairs anew, until a step is shorter
    than `rtol`. What r, rho, the pairs, the step and the transforms are, is the choice
    of `method`.

    **Arguments:**

    - `source`: a cloud, with unit normals where the objective needs them. Points that
      are masked or not finite are ignored.
    - `target`: a cloud; a mesh with `ClosestSurface`; a field with `DistanceField`; or
      what `prepare_target` made of one.
    - `init`: target_from_source at the start; the identity by default.
    - `method`: by default nearest points, point-to-plane, `Tukey` with a width from the
      median residual, rigid, `GaussNewton`.
    - `max_distance`: pairs farther apart are none, in the unit of the points.
    - `weights`: [n] nonnegative, or None for equal ones.
    - `rtol`: in radians, and in sizes of the target; eps^(2/3) by default.
    - `max_steps`: the most searches for pairs.
    - `min_matches`: fewer pairs are a failure.
    - `history`: keep the cost of every step.

    **Statuses:** `too_few_points` in the source; `no_overlap` where no point has a
    pair; `too_few_matches`; `degenerate_input` where some move costs nothing, to
    rounding; `not_converged`. The transform is finite and never a reflection.

    Derivatives with respect to points, normals, weights and widths are those of the
    minimum at the last pairs (implicit function theorem, exact second derivatives); the
    start has none. Raises `GeometryError` for normals that are missing and parts that
    do not go together.

    Source: Besl and McKay 1992; Chen and Medioni 1991; for robust kernels Zhang, Yao,
    Deng 2021.
    """
    method = Method() if method is None else method
    method.solver.validate(method.objective, method.model)
    scene = _scene(source, target, method, max_distance, weights)
    _check_normals(scene)
    start = Rigid.identity(scene.center.dtype) if init is None else init
    cast = lambda x: jnp.asarray(x, scene.center.dtype)
    pose = scene.inward(method.model.cast(jax.tree.map(cast, start)))
    rtol = jnp.finfo(scene.center.dtype).eps ** (2 / 3) if rtol is None else rtol
    # The way to the minimum has no part in the derivative of the minimum.
    # A field may be a plain function, which is no array.
    arrays, rest = eqx.partition((scene, pose), eqx.is_array)
    still = eqx.combine(jax.lax.stop_gradient(arrays), rest)
    state = _iterate(*still, rtol, max_steps, history)
    problem = scene.problem(state.pose, state.found, state.width)
    pose = _attached(problem, state.pose)
    return _report(scene, problem, pose, state, min_matches)


def _check_normals(scene):
    """Raise where the objective needs normals that a cloud does not have."""
    needs = scene.method.objective.normals_of
    target = getattr(scene.prepared, "target", None)
    lacking = [
        name
        for name, cloud in (("source", scene.source), ("target", target))
        if name in needs and cloud is not None and cloud.normals is None
    ]
    if lacking:
        raise GeometryError(
            message(
                f"{type(scene.method.objective).__name__} needs normals of the "
                + " and the ".join(needs),
                "no normals of the " + " and the ".join(lacking),
                "Call normals.estimate first, or use PointToPoint.",
            )
        )


def _iterate(scene, pose, rtol, max_steps, history) -> _State:
    solver = scene.method.solver
    dtype = scene.center.dtype

    def body(state):
        problem = scene.problem(state.pose, state.found, state.width)
        step = solver.step(problem, state.damping)
        # At first there are no pairs: nothing moves until they are found.
        some = jnp.any(state.found.mask)
        move = _pick(some, step.transform, _still(step.transform))
        settled = problem.width >= _SETTLED * state.width
        settled = settled | ~jnp.isfinite(problem.width)
        done = (_step_size(move, scene) <= rtol) & settled
        pose = move @ state.pose
        return _State(
            pose,
            scene.match(pose, state.found),
            jnp.where(some, step.damping, state.damping),
            problem.width,
            state.steps + 1,
            (state.steps > 0) & done,
            _recorded(state, problem),
        )

    record = jnp.full(max_steps, jnp.inf, dtype) if history else None
    nothing = jax.tree.map(
        lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(scene.match, pose)
    )
    start = _State(
        pose,
        nothing,
        jnp.asarray(solver.start(), dtype),
        jnp.asarray(jnp.inf, dtype),
        jnp.zeros((), jnp.int32),
        jnp.asarray(False),
        record,
    )
    going = lambda state: ~state.done & (state.steps < max_steps)
    return jax.lax.while_loop(going, body, start)


def _pick(use, new, old):
    return jax.tree.map(lambda a, b: jnp.where(use, a, b), new, old)


def _still(transform):
    """The identity, of the same kind."""
    return type(transform).identity(transform.shift().dtype)


def _recorded(state, problem):
    """The history with the cost at the pairs of this step, once there are some."""
    if state.history is None:
        return None
    cost = problem.energy(jnp.zeros(problem.size, problem.points.dtype))
    return state.history.at[state.steps - 1].set(
        jnp.where(state.steps > 0, cost, jnp.inf)
    )


def _step_size(step, scene):
    """The largest of the entries of M - I and of the shift in units of the size."""
    eye = jnp.eye(3, dtype=scene.center.dtype)
    size = _size_of(scene)
    linear = jnp.max(jnp.abs(step.linear() - eye))
    return jnp.maximum(linear, jnp.max(jnp.abs(step.shift())) / size)


def _size_of(scene):
    return jnp.max(jnp.abs(scene.tangent.basis))


def icp_unrolled(
    source: PointCloud,
    target: PointCloud | TriangleMesh,
    *,
    init: Rigid | Similarity | Affine | None = None,
    method: Method | None = None,
    max_distance: Float[Array, ""] | float = jnp.inf,
    weights: Float[Array, " n"] | None = None,
    steps: int = 20,
) -> Rigid | Similarity | Affine:
    """The transform after a fixed number of steps, differentiated step by step.

    For comparison with `icp`, whose derivative is that of the minimum: this one depends
    on the start, and its memory grows with the steps. Arguments are those of `icp`.
    """
    method = Method() if method is None else method
    scene = _scene(source, target, method, max_distance, weights)
    _check_normals(scene)
    start = Rigid.identity(scene.center.dtype) if init is None else init
    pose = scene.inward(method.model.cast(start))
    infinite = jnp.asarray(jnp.inf, scene.center.dtype)

    def step(carry, _):
        pose, width = carry
        found = jax.lax.stop_gradient(scene.match(pose))
        problem = scene.problem(pose, found, width)
        # Widths found from the residuals are constants, as in `icp`.
        move = method.solver.step(problem, jnp.asarray(method.solver.start()))
        return (move.transform @ pose, jax.lax.stop_gradient(problem.width)), None

    (pose, _), _ = jax.lax.scan(step, (pose, infinite), None, length=steps)
    return scene.outward(pose)


def _attached(problem, pose):
    """The pose, with the derivative of the minimum at these pairs (implicit function
    theorem): dz = -H^-1 d(grad E), H the exact second derivative of the cost."""
    slope = jax.grad(lambda z: problem.energy(z))
    zero = jnp.zeros(problem.size, problem.points.dtype)

    def solve_tangent(matvec, right):
        matrix = jax.vmap(matvec)(jnp.eye(problem.size, dtype=right.dtype))
        matrix = (matrix + matrix.T) / 2
        return jnp.linalg.solve(matrix, right)

    z = jax.lax.custom_root(slope, zero, lambda _, z: z, solve_tangent)
    return problem.model.exp(problem.tangent.basis @ z) @ pose


def _report(scene, problem, pose, state, min_matches) -> Registration:
    rows, slopes = problem.linearized()
    robust = problem.robust_weights(rows)
    equations = problem.normal_equations()
    matrix = equations.matrix
    pushes = robust * jnp.einsum("krn,rn->kn", slopes, rows)
    scatter = pushes @ pushes.T
    back = scene.tangent.from_origin
    outward = lambda m: back.T @ m @ back
    values, vectors = jnp.linalg.eigh(jax.lax.stop_gradient(matrix))
    directions = (scene.tangent.about_origin @ vectors).T
    count = jnp.sum(problem.weights > 0)
    squares, total = jnp.sum(rows**2, axis=0), jnp.sum(robust)
    square = safe_divide(jnp.sum(robust * squares), total)
    pull = safe_divide(robust, problem.weights)
    noise = _root(safe_divide(jnp.sum(robust * pull * squares), total))
    gaps = jnp.sum(problem.weights * (problem.points - problem.there) ** 2)
    fitness = safe_divide(jnp.sum(problem.weights), jnp.sum(scene.weights))
    eps = jnp.finfo(values.dtype).eps
    result = first_failure(
        failure_where(jnp.sum(scene.weights > 0) < min_matches, RESULTS.too_few_points),
        failure_where(count == 0, RESULTS.no_overlap),
        failure_where(count < min_matches, RESULTS.too_few_matches),
        failure_where(values[0] <= 64 * eps * values[-1], RESULTS.degenerate_input),
        failure_where(~state.done, RESULTS.not_converged),
    )
    return Registration(
        target_from_source=scene.outward(pose),
        result=result,
        rmse=_root(square),
        fitness=fitness,
        distance=_root(safe_divide(gaps, jnp.sum(problem.weights))),
        num_matches=count,
        num_steps=state.steps,
        width=problem.width,
        information=outward(matrix),
        scatter=outward(scatter),
        noise=noise,
        sharpness=safe_divide(jnp.sum(problem.curvatures(rows)), total),
        degeneracy=Degeneracy(values, directions),
        history=state.history,
    )


def _root(square):
    """The square root, with gradient zero at zero."""
    positive = square > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1)), 0)


class PreparedTarget(eqx.Module):
    """A target about its center, with its search structure, for many alignments."""

    prepared: eqx.Module
    center: Float[Array, " 3"]
    size: Float[Array, ""]


def prepare_target(target, correspondence: AbstractCorrespondence) -> PreparedTarget:
    """What `icp` needs of a target: pass it instead of the target to share the work."""
    target = _washed(target) if isinstance(target, PointCloud) else target
    center, size = _extent(target)
    prepared = correspondence.prepare(_shifted(target, center))
    return PreparedTarget(prepared, center, size)


def _scene(source, target, method, max_distance, weights) -> _Scene:
    if not isinstance(target, PreparedTarget):
        target = prepare_target(target, method.correspondence)
    source = _washed(source)
    dtype = source.points.dtype
    given = source.mask.astype(dtype)
    if weights is not None:
        check_shape("weights", weights, source.mask.shape)
        given = jnp.where(source.mask, weights, 0).astype(dtype)
    source_center, _ = _center(source.points, source.mask)
    return _Scene(
        _shifted(source, source_center),
        given,
        target.prepared,
        source_center,
        target.center.astype(dtype),
        tangent_of(method.model, target.center.astype(dtype), target.size),
        method,
        jnp.asarray(max_distance, dtype),
    )


def _washed(cloud) -> PointCloud:
    points = jnp.asarray(cloud.points)
    mask = cloud.mask & jnp.all(jnp.isfinite(points), axis=1)
    normals = cloud.normals
    if normals is not None:
        normals = jnp.asarray(normals)
        mask = mask & jnp.all(jnp.isfinite(normals), axis=1)
        normals = jnp.where(mask[:, None], normals, 0)
    return PointCloud(jnp.where(mask[:, None], points, 0), normals, mask)


def _extent(target):
    """Center and size of a target of any kind."""
    if isinstance(target, PointCloud):
        return _center(target.points, target.mask)
    if isinstance(target, TriangleMesh):
        return _center(jnp.asarray(target.vertices), target.vertex_mask)
    # A field knows no extent: its coordinates are taken as they are.
    return jnp.zeros(3), jnp.ones(())


def _shifted(shape, center):
    """The shape about its center."""
    if isinstance(shape, PointCloud):
        there = jnp.where(shape.mask[:, None], shape.points - center, 0)
        return PointCloud(there, shape.normals, shape.mask)
    if isinstance(shape, TriangleMesh):
        return eqx.tree_at(lambda m: m.vertices, shape, shape.vertices - center)
    return shape


def _center(points, mask):
    """Mean and root mean square radius; they only choose coordinates."""
    points = jax.lax.stop_gradient(points)
    count = jnp.maximum(jnp.sum(mask), 1).astype(points.dtype)
    mean = jnp.sum(jnp.where(mask[:, None], points, 0), axis=0) / count
    gaps = jnp.where(mask[:, None], points - mean, 0)
    square = jnp.sum(gaps**2) / count
    return mean, jnp.where(square > 0, jnp.sqrt(square), 1)
