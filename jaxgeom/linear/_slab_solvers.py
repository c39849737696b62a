"""(L + D) u = b on a grid that is too large for one device."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.sharding import Mesh
from jax.sharding import PartitionSpec as P
from jaxtyping import Array, Float

from .._core import RESULTS, GeometryError, message
from ._cg import LinearSolution, iterate
from ._cosine import along_axes, basis
from ._multigrid import DAMPING, Multigrid
from ._slabs import Slabs

_GATHERED = 32  # nodes along the longest axis at which a level fits every device


class SlabCosine(eqx.Module):
    """Precondition with the cosine transform of L + mean(D): exact for a constant D.

    The number of nodes along y must be a multiple of the number of devices: the slabs
    are turned from x to y for the transform along x, and back.
    """

    def prepare(self, slabs: Slabs, diagonal, coefficients):
        """r -> (L + mean D)^-1 r for the slabs of r."""
        n, y, z = diagonal.shape
        x, part = n * slabs.count, y // slabs.count
        shift = slabs.dot(diagonal, jnp.ones_like(diagonal)) / (x * y * z)
        bases = [basis(size, diagonal.dtype) for size in (x, y, z)]
        wave = lambda k, size: 2 - 2 * jnp.cos(jnp.pi * k.astype(shift.dtype) / size)
        first = jax.lax.axis_index(slabs.axis) * part
        a, b, c = coefficients
        divisor = (
            a * wave(jnp.arange(x), x)[:, None, None]
            + b * wave(first + jnp.arange(part), y)[:, None]
            + c * wave(jnp.arange(z), z)
            + shift
        )
        regular = divisor > 0
        divisor = jnp.where(regular, divisor, 1)

        def solve(r):
            turned = slabs.turned(along_axes((None, *bases[1:]), r))
            spectrum = along_axes((bases[0], None, None), turned)
            scaled = jnp.where(regular, spectrum / divisor, 0)
            back = along_axes((bases[0].T, None, None), scaled)
            inverse = (None, bases[1].T, bases[2].T)
            return along_axes(inverse, slabs.turned_back(back))

        return solve


class SlabMultigrid(eqx.Module):
    """Precondition with the V-cycle of `Multigrid`, to rounding the same one.

    Levels are cut into slabs as long as these have an even number of slices; the
    coarser ones are small and are worked on by every device alike.
    """

    def prepare(self, slabs: Slabs, diagonal, coefficients):
        """r -> the V-cycle of r, for the slabs of r."""
        n, y, z = diagonal.shape
        longest, shortest = max(n * slabs.count, y, z), min(n * slabs.count, y, z)
        if longest <= _GATHERED or shortest <= 4 or n % 2:
            whole = Multigrid.of(slabs.gathered(diagonal), coefficients)
            return lambda r: slabs.own(whole.v_cycle(slabs.gathered(r)))
        below = self.prepare(slabs, slabs.restrict(diagonal), 2 * coefficients)
        apply = lambda u: slabs.laplacian(u, coefficients) + diagonal * u
        own = slabs.laplacian_diagonal(diagonal.shape, coefficients)
        step = DAMPING / (own + diagonal)

        def cycle(r):
            u = step * r
            coarse = below(slabs.restrict(r - apply(u)))
            u = u + slabs.prolong(coarse, r.shape)
            return u + step * (r - apply(u))

        return cycle


def solve_in_slabs(
    b: Float[Array, "x y z"],
    diagonal: Float[Array, "x y z"],
    coefficients: Float[Array, " 3"],
    *,
    mesh: Mesh,
    method: SlabCosine | SlabMultigrid | None = None,
    rtol: float,
    max_steps: int = 200,
) -> LinearSolution:
    """The solution of (L + D) u = b, each device holding one slab of every grid.

    Conjugate gradients; the devices exchange the borders of their slabs and sums. The
    memory of each device falls with their number. Use it inside `jax.jit`, in one
    process or, after `jax.distributed.initialize`, in several. It has no derivative.

    **Arguments:**

    - `b`, `diagonal`: nonnegative D, placed with `NamedSharding(mesh, P(axis))`.
    - `coefficients`: [3], the weights of the axes in L, as of `laplacian`.
    - `mesh`: the devices, along one named axis.
    - `method`: the preconditioner, `SlabMultigrid()` by default.
    - `rtol`, `max_steps`: as of `conjugate_gradients`.

    **Statuses:** `not_converged`. Raises `GeometryError` for a mesh with several axes,
    and for x (or, for `SlabCosine`, y) that is no multiple of the number of devices.
    """
    method = SlabMultigrid() if method is None else method
    _check(b.shape, mesh, method)
    (axis,) = mesh.axis_names
    slabs, cut = Slabs(axis, mesh.size), P(axis)

    def solve(b, diagonal, coefficients):
        found = iterate(
            lambda u: slabs.laplacian(u, coefficients) + diagonal * u,
            b,
            rtol=rtol,
            max_steps=max_steps,
            preconditioner=method.prepare(slabs, diagonal, coefficients),
            start=jnp.zeros_like,
            dot=slabs.dot,
        )
        return found.value, found.residual, found.steps

    shared = jax.shard_map(
        solve,
        mesh=mesh,
        in_specs=(cut, cut, P()),
        out_specs=(cut, P(), P()),
        check_vma=False,
    )
    value, residual, steps = shared(b, diagonal, coefficients)
    result = RESULTS.where(residual <= rtol, RESULTS.successful, RESULTS.not_converged)
    return LinearSolution(value, residual, steps, result)


def _check(shape, mesh, method):
    """Raise for slabs that would not be equal."""
    axes = 2 if isinstance(method, SlabCosine) else 1
    if len(mesh.axis_names) == 1 and all(n % mesh.size == 0 for n in shape[:axes]):
        return
    names = " and ".join("xy"[:axes])
    must = f"the nodes along {names} must be a multiple of the devices of one axis"
    given = f"{shape} nodes, mesh {dict(mesh.shape)}"
    fix = "Choose another resolution, or a mesh of fewer devices."
    raise GeometryError(message(must, given, fix))
