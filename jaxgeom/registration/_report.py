"""What an alignment found, and how far it can be trusted."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._core import RESULTS, failure_where, first_failure, safe_divide
from ..transforms import Affine, Rigid, Similarity
from ._problem import Problem
from ._scene import Scene


class Track(eqx.Module):
    """How the search for the minimum went."""

    steps: Int[Array, ""]
    done: Bool[Array, ""]
    history: Float[Array, " steps"] | None


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


def report(
    scene: Scene, problem: Problem, pose, track: Track, min_matches: int
) -> Registration:
    """The alignment at a pose between the centered clouds, with its last problem."""
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
        failure_where(~track.done, RESULTS.not_converged),
    )
    return Registration(
        target_from_source=scene.outward(pose),
        result=result,
        rmse=_root(square),
        fitness=fitness,
        distance=_root(safe_divide(gaps, jnp.sum(problem.weights))),
        num_matches=count,
        num_steps=track.steps,
        width=problem.width,
        information=outward(matrix),
        scatter=outward(scatter),
        noise=noise,
        sharpness=safe_divide(jnp.sum(problem.curvatures(rows)), total),
        degeneracy=Degeneracy(values, directions),
        history=track.history,
    )


def _root(square):
    """The square root, with gradient zero at zero."""
    positive = square > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1)), 0)
