"""Random points on a surface, no two of them near each other."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from .._core import RESULTS, GeometryError, failure_where, message, prefix_sum
from ..shapes import TriangleMesh
from ._geometry import area
from ._sampling import SurfaceSamples, sample_surface

_CANDIDATES = 12
# Cells are a little wider than the radius, so that rounding cannot put two points
# nearer than it more than one cell apart.
_MARGIN = 1 + 2.0**-8
_PRIMES = (73856093, 19349663, 83492791)
# Points found, times radius^2 / area, with the candidates there are by default; to
# which none at all can be added there are 0.696.
_PACKING = 0.585


class DiskSamples(eqx.Module):
    """Samples in which any two points are at least `radius` apart.

    `samples` holds them in front, with `mask`, faces and barycentric coordinates.
    `required_samples` is the number found, even if it is above the capacity; then
    `result` is `capacity_exceeded` and the last ones are missing. `no_surface` tells of
    a mesh without area.
    """

    samples: SurfaceSamples
    required_samples: Int[Array, ""]
    result: RESULTS


def sample_poisson_disk(
    mesh: TriangleMesh,
    radius: Float[Array, ""] | float,
    *,
    capacity: int,
    key: Array,
    candidates: int | None = None,
) -> DiskSamples:
    """Random points with |p_i - p_j| >= radius, to which no candidate could be added.

    Of `candidates` uniform points (12 for each of the `capacity` by default) one after
    the other is taken if no earlier one that was taken is nearer than `radius`, in
    space: dart throwing, done for all points that nothing stands against at once. More
    candidates fill the gaps better. `disk_radius` gives a radius for a number of
    points. Points and normals are differentiable in the vertices, for a fixed choice of
    faces and barycentric coordinates. `key` is a typed key, used once.

    Raises `GeometryError` for a capacity below 1.

    Source: R. L. Cook, Stochastic sampling in computer graphics, 1986; L.-Y. Wei,
    Parallel Poisson disk sampling, 2008.
    """
    if capacity < 1:
        must = "the capacity must be at least 1"
        raise GeometryError(message(must, f"{capacity}", "Pass a larger number."))
    number = _CANDIDATES * capacity if candidates is None else candidates
    drawn = sample_surface(mesh, number, key=key)
    taken = _throw(lax.stop_gradient(drawn.points), drawn.mask, radius)
    required = jnp.sum(taken, dtype=jnp.int32)
    place = jnp.where(taken, prefix_sum(taken.astype(jnp.int32)), capacity)
    rows = jnp.full(capacity, number, jnp.int32)
    rows = rows.at[place].set(jnp.arange(number, dtype=jnp.int32), mode="drop")
    take = lambda x, fill=0: x.at[rows].get(mode="fill", fill_value=fill)
    f = mesh.faces.shape[0]
    samples = SurfaceSamples(
        take(drawn.points),
        take(drawn.normals),
        take(drawn.faces, f),
        take(drawn.barycentric),
        take(drawn.mask, False),
    )
    none, over = ~jnp.any(drawn.mask), required > capacity
    result = RESULTS.where(
        none, RESULTS.no_surface, failure_where(over, RESULTS.capacity_exceeded)
    )
    return DiskSamples(samples, required, result)


def disk_radius(mesh: TriangleMesh, num: int) -> Float[Array, ""]:
    """The radius with which `sample_poisson_disk` finds about `num` points.

    sqrt(0.585 area / num), right to a few percent for the default candidates (leave
    that much room in the capacity); fewer where sheets of the surface are nearer to
    each other than the radius.
    """
    return jnp.sqrt(_PACKING * area(mesh) / num)


# Outside jit, loops would compile what they close over as constants (slowly).
@jax.jit
def _throw(points, mask, radius):
    """Which points are taken when each one in turn keeps its distance."""
    n = points.shape[0]
    size = 1 << max(2 * n - 1, 1).bit_length()
    number = jnp.arange(n, dtype=jnp.int32)
    radius = jnp.asarray(radius, points.dtype)
    low = jnp.min(jnp.where(mask[:, None], points, jnp.inf), axis=0, initial=jnp.inf)
    low = jnp.where(jnp.isfinite(low), low, 0)
    width = jnp.where(radius > 0, radius * _MARGIN, 1)
    cells = jnp.floor((points - low) / width).astype(jnp.int32)
    steps = jnp.stack(jnp.meshgrid(*[jnp.arange(-1, 2)] * 3, indexing="ij"), -1)
    steps = steps.reshape(-1, 3)
    own = _slot(cells, size)

    def listed(chosen):
        """The first of the chosen points in every slot."""
        table = jnp.full(size, n, jnp.int32)
        return table.at[own].min(jnp.where(chosen, number, n))

    def is_near(table, before):
        """True where a point of the table (an earlier one if `before`) is too near."""

        def look(found, step):
            other = table[_slot(cells + step, size)]
            there = points.at[other].get(mode="fill", fill_value=jnp.inf)
            near = jnp.sum((points - there) ** 2, axis=-1) < radius**2
            near &= (other < number) if before else (other < n)
            return found | near, None

        return lax.scan(look, jnp.zeros(n, bool), steps)[0]

    def one_round(carry):
        taken, open_ = carry
        # Cells may share a slot: only the first point of a slot is looked at, so that
        # two points taken at once have seen each other.
        first = listed(open_)
        new = open_ & (first[own] == number) & ~is_near(first, True)
        covered = is_near(listed(new), False)
        return taken | new, open_ & ~covered & ~new

    start = (jnp.zeros(n, bool), mask)
    return lax.while_loop(lambda c: jnp.any(c[1]), one_round, start)[0]


def _slot(cells, size):
    a, b, c = (
        cells[..., d].astype(jnp.uint32) * jnp.uint32(p) for d, p in enumerate(_PRIMES)
    )
    return ((a ^ b ^ c) & jnp.uint32(size - 1)).astype(jnp.int32)
