"""What can go wrong at run time, as values that survive jit and vmap."""

import jax.numpy as jnp
import optimistix as optx


class RESULTS(optx.RESULTS):
    """The statuses of jaxgeom: those of optimistix and those of geometry."""

    capacity_exceeded = "The output does not fit its capacity: raise it to required_*."
    degenerate_input = "The points are all equal, collinear or coplanar."
    too_few_points = "Fewer valid points than the method needs."
    zero_normals = "Some normals are zero or not finite: these points were ignored."
    outside_grid = "Some points lie outside the grid: these points were ignored."
    no_surface = "The level set does not meet the grid: there is no surface."
    steep_field = "The field is steeper than its Lipschitz constant: surface is lost."
    no_consensus = "Too few pairs of points agree on one transform."
    no_overlap = "No source point has a target point within the allowed distance."
    too_few_matches = "Fewer pairs of points than the alignment needs."
    diverged = "Training met a loss that is not finite, or ended above its start."
    not_converged = "The solver stopped before the residual fell below rtol."


def name_of(result: RESULTS) -> str:
    """The name of one status, for programs; `RESULTS[result]` is its text (host)."""
    items = RESULTS._name_to_item.items()
    return next(name for name, item in items if bool(result == item))


def first_failure(*results: RESULTS) -> RESULTS:
    """The first status that is not successful, or success."""
    out = results[-1]
    for result in reversed(results[:-1]):
        out = RESULTS.where(result == RESULTS.successful, out, result)
    return out


def failure_where(failed, failure: RESULTS) -> RESULTS:
    """`failure` where `failed` is true, success elsewhere."""
    return RESULTS.where(jnp.asarray(failed), failure, RESULTS.successful)
