"""Smoothing: filters on the positions of the vertices."""

from abc import abstractmethod
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from .._core import RESULTS, check_shape, safe_divide
from ..linear import conjugate_gradients
from ..shapes import TriangleMesh
from ._laplacian import cotangent_laplacian, lumped_mass, uniform_laplacian
from ._sparse import SparseOperator


class Smoothed(eqx.Module):
    """A smoothed mesh, with the residual, the steps and the status of the solver.

    Filters that solve nothing have residual 0 and succeed. The vertex normals of the
    mesh, if it had any, are dropped; other attributes stay.
    """

    mesh: TriangleMesh
    residual: Float[Array, ""]
    steps: Int[Array, ""]
    result: RESULTS


class AbstractSmoothing(eqx.Module):
    """A filter: new positions from old ones."""

    @abstractmethod
    def filter(
        self, mesh: TriangleMesh, points: Float[Array, "v 3"], free: Bool[Array, " v"]
    ) -> Smoothed:
        """`mesh` with the points where `free` moved."""


class Laplacian(AbstractSmoothing):
    """`steps` times x <- x - rate D^-1 L x, D the diagonal of L. Shrinks.

    `rate` in (0, 1]; `laplacian` is `uniform_laplacian` (the default: also evens out
    the triangles) or `cotangent_laplacian`, made once from the given mesh.
    """

    steps: int = eqx.field(static=True, default=10)
    rate: Float[Array, ""] | float = 0.5
    laplacian: Callable[[TriangleMesh], SparseOperator] = eqx.field(
        static=True, default=uniform_laplacian
    )

    def filter(self, mesh, points, free):
        move = _mover(self.laplacian(mesh), free)
        once = lambda x, _: (move(x, self.rate), None)
        return _done(
            mesh, lax.scan(once, points, None, length=self.steps)[0], self.steps
        )


class Taubin(AbstractSmoothing):
    """`steps` pairs of a smoothing step `rate` and an inflating step `back` < -rate.

    Hardly shrinks: waves below the pass band 1 / rate + 1 / back stay.

    Source: G. Taubin, A signal processing approach to fair surface design, 1995.
    """

    steps: int = eqx.field(static=True, default=10)
    rate: Float[Array, ""] | float = 0.5
    back: Float[Array, ""] | float = -0.53
    laplacian: Callable[[TriangleMesh], SparseOperator] = eqx.field(
        static=True, default=uniform_laplacian
    )

    def filter(self, mesh, points, free):
        move = _mover(self.laplacian(mesh), free)
        once = lambda x, _: (move(move(x, self.rate), self.back), None)
        return _done(
            mesh, lax.scan(once, points, None, length=self.steps)[0], self.steps
        )


class Implicit(AbstractSmoothing):
    """One step of mean curvature flow: (M + time L) x = M x_0, stable for any `time`.

    `time` is in length^2: waves shorter than about 2 pi sqrt(time) go. L is the
    cotangent Laplacian and M the barycentric mass of the given mesh; the center of mass
    stays where it is on a mesh without fixed vertices. By conjugate gradients to the
    relative residual `rtol`, at most `max_steps`.

    Source: M. Desbrun et al., Implicit fairing of irregular meshes using diffusion and
    curvature flow, 1999.
    """

    time: Float[Array, ""] | float
    rtol: float = eqx.field(static=True, default=1e-5)
    max_steps: int = eqx.field(static=True, default=1000)

    def filter(self, mesh, points, free):
        laplacian, mass = cotangent_laplacian(mesh), lumped_mass(mesh)
        mass = mass[:, None]
        free = free[:, None] & (mass > 0)
        # From the origin, positions would hide what moves below the tolerance.
        middle = safe_divide(jnp.sum(mass * points, axis=0), jnp.sum(mass))
        points = points - middle
        whole = lambda x: mass * x + self.time * (laplacian @ x)
        operator = lambda x: jnp.where(free, whole(jnp.where(free, x, 0)), x)
        held = jnp.where(free, 0, points)
        right = jnp.where(free, mass * points - whole(held), points)
        diagonal = mass + self.time * laplacian.diagonal()[:, None]
        scale = lax.stop_gradient(jnp.where(free & (diagonal > 0), diagonal, 1))
        found = conjugate_gradients(
            operator,
            right,
            rtol=self.rtol,
            max_steps=self.max_steps,
            preconditioner=lambda r: r / scale,
        )
        moved = _with_vertices(mesh, found.value + middle)
        return Smoothed(moved, found.residual, found.steps, found.result)


def smooth(
    mesh: TriangleMesh,
    method: AbstractSmoothing | None = None,
    *,
    fixed: Bool[Array, " v"] | None = None,
) -> Smoothed:
    """The mesh with its vertices moved by a low-pass filter.

    `method` is `Taubin()` (the default), `Laplacian()` or `Implicit(time)`; `fixed` [v]
    is True for the vertices that must stay, for example `boundary_vertices(mesh)`.
    Differentiable in the vertices and in the numbers of the method. Padding vertices
    come out as zero. Status: that of the solver of `Implicit`.
    """
    method = Taubin() if method is None else method
    free = mesh.vertex_mask
    if fixed is not None:
        check_shape("fixed", fixed, (mesh.vertices.shape[0],))
        free = free & ~jnp.asarray(fixed)
    points = jnp.where(mesh.vertex_mask[:, None], mesh.vertices, 0)
    out = _filter(method, mesh, points, free)
    real = mesh.vertex_mask[:, None]
    washed = jnp.where(real, out.mesh.vertices, 0)
    return eqx.tree_at(lambda s: s.mesh.vertices, out, washed)


# Outside jit, loops would compile what they close over as constants (slowly).
@jax.jit
def _filter(method, mesh, points, free):
    return method.filter(mesh, points, free)


def _mover(operator, free):
    """(x, rate) -> x - rate D^-1 L x, where free."""
    diagonal = operator.diagonal()[:, None]

    def move(x, rate):
        return jnp.where(
            free[:, None], x - rate * safe_divide(operator @ x, diagonal), x
        )

    return move


def _done(mesh, points, steps):
    zero = jnp.zeros((), points.dtype)
    return Smoothed(
        _with_vertices(mesh, points), zero, jnp.int32(steps), RESULTS.successful
    )


def _with_vertices(mesh, points):
    counts = {"num_vertices": mesh.num_vertices, "num_faces": mesh.num_faces}
    return TriangleMesh(points, mesh.faces, None, mesh.attributes, **counts)
