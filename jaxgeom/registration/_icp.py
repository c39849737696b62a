"""Iterative closest points: pairs, a step, pairs again, until the pose stays."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from ..shapes import PointCloud, TriangleMesh
from ..transforms import Affine, Rigid, Similarity
from ._correspondences import Found
from ._report import Registration, Track, report
from ._scene import Method, check_normals, scene_of

# A kernel has settled when a step narrows it by less than a hundredth.
_SETTLED = 0.99


class _State(eqx.Module):
    pose: Rigid | Similarity | Affine
    anchor: Rigid | Similarity | Affine
    found: Found
    memory: PyTree
    width: Float[Array, ""]
    track: Track


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
    than `rtol`, or comes back so near to an earlier pose. What r, rho, the pairs, the
    step and the transforms are, is the choice of `method`.

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
    scene = scene_of(source, target, method, max_distance, weights)
    check_normals(scene)
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
    return report(scene, problem, pose, state.track, min_matches)


def _iterate(scene, pose, rtol, max_steps, history) -> _State:
    solver, dtype = scene.method.solver, scene.center.dtype

    def body(state):
        track = state.track
        problem = scene.problem(state.pose, state.found, state.width)
        step = solver.step(problem, state.memory)
        # At first there are no pairs: nothing moves until they are found.
        some = jnp.any(state.found.mask)
        move = _pick(some, step.transform, _still(step.transform))
        settled = problem.width >= _SETTLED * state.width
        settled = settled | ~jnp.isfinite(problem.width)
        pose = move @ state.pose
        # Pairs may alternate for ever: then poses come back (Brent 1980).
        still = _apart(pose, state.pose, scene) <= rtol
        still = still | (_apart(pose, state.anchor, scene) <= rtol)
        done = (track.steps > 0) & still & settled & ~step.stuck
        mark = jax.lax.population_count(track.steps) == 1
        history = _recorded(track, problem)
        return _State(
            pose,
            _pick(mark, pose, state.anchor),
            scene.match(pose, state.found),
            _pick(some, step.memory, state.memory),
            problem.width,
            Track(track.steps + 1, done, history),
        )

    record = jnp.full(max_steps, jnp.inf, dtype) if history else None
    nothing = jax.eval_shape(scene.match, pose).blank()
    start = _State(
        pose,
        pose,
        nothing,
        solver.start(scene.tangent.basis.shape[1], dtype),
        jnp.asarray(jnp.inf, dtype),
        Track(jnp.zeros((), jnp.int32), jnp.asarray(False), record),
    )
    going = lambda state: ~state.track.done & (state.track.steps < max_steps)
    return jax.lax.while_loop(going, body, start)


def _pick(use, new, old):
    return jax.tree.map(lambda a, b: jnp.where(use, a, b), new, old)


def _still(transform):
    """The identity, of the same kind."""
    return type(transform).identity(transform.shift().dtype)


def _recorded(track, problem):
    """The history with the cost at the pairs of this step, once there are some."""
    if track.history is None:
        return None
    cost = problem.energy(jnp.zeros(problem.size, problem.points.dtype))
    cost = jnp.where(track.steps > 0, cost, jnp.inf)
    return track.history.at[track.steps - 1].set(cost)


def _apart(a, b, scene):
    """The largest difference of linear parts, and of shifts in units of the size."""
    shift = jnp.max(jnp.abs(a.shift() - b.shift())) / scene.size
    return jnp.maximum(jnp.max(jnp.abs(a.linear() - b.linear())), shift)


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
    scene = scene_of(source, target, method, max_distance, weights)
    check_normals(scene)
    start = Rigid.identity(scene.center.dtype) if init is None else init
    pose = scene.inward(method.model.cast(start))
    solver, dtype = method.solver, scene.center.dtype

    def step(carry, _):
        pose, width, memory = carry
        found = jax.lax.stop_gradient(scene.match(pose))
        problem = scene.problem(pose, found, width)
        # Widths found from the residuals are constants, as in `icp`.
        move = solver.step(problem, memory)
        width = jax.lax.stop_gradient(problem.width)
        return (move.transform @ pose, width, move.memory), None

    memory = solver.start(scene.tangent.basis.shape[1], dtype)
    start = (pose, jnp.asarray(jnp.inf, dtype), memory)
    (pose, *_), _ = jax.lax.scan(step, start, None, length=steps)
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
