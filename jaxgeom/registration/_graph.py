"""Deformation by a graph of few nodes that carry the mesh with them."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._core import safe_divide
from ..neighbors import BruteForce, build, knn
from ._deformation import AbstractDeformation, Frames, Links, links

_NEIGHBORS = 6


class OnNodes(eqx.Module):
    """Frames on nodes; vertex v at rest is carried by `nodes` [v, k] by `shares`."""

    rest: Frames
    links: Links
    vertices: Float[Array, "v 3"]
    nodes: Int[Array, "v k"]
    shares: Float[Array, "v k"]

    def carry(self, frames: Frames) -> Float[Array, "v 3"]:
        """sum over k of share (g' + A (v - g))."""
        arms = self.vertices[:, None] - self.rest.points[self.nodes]
        turned = jnp.einsum("vkij,vkj->vki", frames.linear[self.nodes], arms)
        there = frames.points[self.nodes] + turned
        return jnp.sum(self.shares[..., None] * there, axis=1)


class EmbeddedGraph(AbstractDeformation):
    """Nodes spread over the mesh, each with an affine map that is nearly a rotation.

    With g at rest, g' now and the neighbors k of each node j,

        strain = mean over j, k of |g_k' - g_j' - A_j (g_k - g_j)|^2 over length squared
                 + rigidity * mean over j of |A_j^T A_j - I|^2

    Zero for rigid motions. `nodes` are chosen far from each other among the vertices; a
    vertex is carried by the `carriers` nearest ones, the nearer the more. Neighbors are
    nearest in space: parts that touch at rest stick together.

    Source: R. W. Sumner, J. Schmid, M. Pauly, Embedded deformation for shape
    manipulation, 2007, equations 1 to 6.
    """

    nodes: int = eqx.field(static=True, default=200)
    carriers: int = eqx.field(static=True, default=4)
    rigidity: float = 1.0

    @property
    def freedoms(self):
        return 12

    def prepare(self, mesh):
        vertices, mask = mesh.vertices, mesh.vertex_mask
        number = min(self.nodes, vertices.shape[0])
        nodes = vertices[spread(vertices, mask, number)]
        index = build(nodes, backend=BruteForce())
        count = min(self.carriers + 1, number)
        near = knn(index, vertices, count)
        # The first node that does not carry sets where the influence ends.
        reach = near.distances[:, -1:] * (1 + jnp.finfo(vertices.dtype).eps ** 0.5)
        shares = (1 - safe_divide(near.distances, reach)) ** 2
        k = max(count - 1, 1)
        shares = safe_divide(shares[:, :k], jnp.sum(shares[:, :k], -1, keepdims=True))
        around = knn(index, nodes, min(_NEIGHBORS + 1, number)).indices[:, 1:]
        start = jnp.repeat(jnp.arange(number), around.shape[1])
        pairs = links(
            start, around.reshape(-1), jnp.ones(start.shape, vertices.dtype), nodes
        )
        return OnNodes(Frames.at(nodes), pairs, vertices, near.indices[:, :k], shares)

    def move(self, prepared, frames, tangent):
        change = tangent[:, 3:].reshape(-1, 3, 3) / prepared.links.length
        return Frames(frames.points + tangent[:, :3], frames.linear + change)

    def strain(self, prepared, frames):
        pairs = prepared.links
        rest, now = pairs.between(prepared.rest.points), pairs.between(frames.points)
        apart = now - jnp.einsum("eij,ej->ei", frames.linear[pairs.start], rest)
        apart = jnp.sqrt(pairs.weights)[:, None] / pairs.length * apart
        grams = jnp.einsum("gji,gjk->gik", frames.linear, frames.linear)
        number = frames.points.shape[0]
        skewed = grams - jnp.eye(3, dtype=grams.dtype)
        return apart, jnp.sqrt(self.rigidity / number) * skewed


def spread(
    points: Float[Array, "n 3"], mask: Bool[Array, " n"], number: int
) -> Int[Array, " number"]:
    """Rows of `number` real points, each the farthest from those before.

    T. F. Gonzalez, Clustering to minimize the maximum intercluster distance, 1985.
    """
    first = jnp.argmax(mask).astype(jnp.int32)

    def step(gaps, _):
        row = jnp.argmax(gaps).astype(jnp.int32)
        gaps = jnp.minimum(gaps, jnp.sum((points - points[row]) ** 2, axis=-1))
        return gaps, row

    squares = jnp.sum((points - points[first]) ** 2, axis=-1)
    _, rows = jax.lax.scan(step, jnp.where(mask, squares, -1), None, length=number - 1)
    return jnp.concatenate([first[None], rows])
