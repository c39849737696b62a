"""Models of deformation with a frame on every vertex, and the schedule of stiffness."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..transforms import rotation_exp
from ._deformation import AbstractDeformation, Frames, Links, half_edges, links


class StiffnessSchedule(eqx.Module):
    """Stiffness falls from `start` to `end` in `stages` steps of equal ratio.

    The stiffness is the weight of the mean squared strain beside the mean squared
    residual in units of the half diagonal of the template squared.
    """

    start: float = 10.0
    end: float = 0.01
    stages: int = eqx.field(static=True, default=8)

    def __call__(self, stage, dtype) -> Float[Array, ""]:
        """The stiffness of a stage, counted from 0."""
        ratio = jnp.asarray(self.end, dtype) / self.start
        share = stage.astype(dtype) / max(self.stages - 1, 1)
        return self.start * ratio**share


class OnVertices(eqx.Module):
    """Frames on the vertices: they are the vertices."""

    rest: Frames
    links: Links

    def carry(self, frames: Frames) -> Float[Array, "v 3"]:
        """The vertices that frames carry."""
        return frames.points


class AsRigidAsPossible(AbstractDeformation):
    """Every vertex turns with its surroundings: no bending of its edges, no stretching.

    For sides i, j of all faces with cotangent weights w, e at rest and e' now,

        strain = mean of w |e' - R_i e|^2 + w |e' - R_j e|^2, over the length squared

    with a rotation R of every vertex as an unknown beside its place: Gauss-Newton moves
    both at once, where the original alternates. Zero for rigid motions only.

    Source: O. Sorkine, M. Alexa, As-rigid-as-possible surface modeling, 2007, equation
    3 (spokes).
    """

    @property
    def freedoms(self):
        return 6

    def prepare(self, mesh):
        start, end, cotangents, _ = half_edges(mesh)
        pairs = links(start, end, cotangents, mesh.vertices)
        return OnVertices(Frames.at(mesh.vertices), pairs)

    def move(self, prepared, frames, tangent):
        # Turns are counted as lengths at the ends of the edges: both parts weigh alike.
        turns = jax.vmap(rotation_exp)(tangent[:, 3:] / prepared.links.length)
        return Frames(frames.points + tangent[:, :3], turns @ frames.linear)

    def strain(self, prepared, frames):
        pairs = prepared.links
        rest = pairs.between(prepared.rest.points)
        start, end = _ends(pairs, frames)
        scale = jnp.sqrt(pairs.weights / 2)[:, None] / pairs.length
        turned = lambda at: jnp.einsum("eij,ej->ei", at.linear, rest)
        now = end.points - start.points
        return tuple(scale * (now - turned(at)) for at in (start, end))


class PerVertexAffine(AbstractDeformation):
    """Every vertex carries an affine map, and neighbors carry nearly the same one.

    For the sides i, j of all faces, with T_i(x) = v_i' + A_i (x - v_i) and m the middle
    of the side at rest,

        strain = mean of |T_i(m) - T_j(m)|^2 + reach^2 |A_i - A_j|^2, over length^2

    Zero for every affine map of the whole mesh. The paper compares the maps at the
    origin instead of at m, which makes its energy depend on where the mesh lies.

    `reach` (1 / gamma in the paper), in half diagonals of the mesh, is the size of a
    bump whose bending costs as much as its stretching. Source: B. Amberg, S. Romdhani,
    T. Vetter, Optimal step nonrigid ICP algorithms for surface registration, 2007,
    equation 4.
    """

    reach: float = 0.1

    @property
    def freedoms(self):
        return 12

    def prepare(self, mesh):
        start, end, _, real = half_edges(mesh)
        pairs = links(start, end, real.astype(mesh.vertices.dtype), mesh.vertices)
        return OnVertices(Frames.at(mesh.vertices), pairs)

    def move(self, prepared, frames, tangent):
        change = tangent[:, 3:].reshape(-1, 3, 3) / self.reach
        return Frames(frames.points + tangent[:, :3], frames.linear + change)

    def strain(self, prepared, frames):
        pairs = prepared.links
        rest = pairs.between(prepared.rest.points)
        start, end = _ends(pairs, frames)
        mean = (start.linear + end.linear) / 2
        apart = end.points - start.points - jnp.einsum("eij,ej->ei", mean, rest)
        scale = jnp.sqrt(pairs.weights) / pairs.length
        differ = scale[:, None, None] * (end.linear - start.linear)
        return self.reach * differ, scale[:, None] * apart


def _ends(pairs: Links, frames: Frames) -> tuple[Frames, Frames]:
    """The frames at both ends of the sides of faces.

    The end of a side is the start of the next one: every corner is read only once, and
    written only once where this is transposed.
    """
    fold = lambda x: x[pairs.start].reshape(-1, 3, *x.shape[1:])
    corners = jax.tree.map(fold, frames)
    flat = lambda x: x.reshape(-1, *x.shape[2:])
    ahead = jax.tree.map(lambda x: flat(jnp.roll(x, -1, axis=1)), corners)
    return jax.tree.map(flat, corners), ahead
