"""Which scans of an object overlap, and rough poses that follow from the pairs."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from .._core import RESULTS
from ..shapes import PointCloud
from ..transforms import Rigid
from ._global import GlobalStart, align_views, describe_view


class ViewGraph(eqx.Module):
    """The pairwise alignments of b scans: p = b (b - 1) / 2 pairs.

    `pairs` [p, 2] name target and source, `starts` hold a `GlobalStart` for each (its
    transform is target_from_source), and `score` [p] says how far to trust it: the
    pairs of features that agree, times the share of the source that is covered; zero
    where there is no consensus.
    """

    pairs: Int[Array, "p 2"]
    starts: GlobalStart
    score: Float[Array, " p"]


class Poses(eqx.Module):
    """The pose of every scan in the frame of the first.

    `reached` [b] is False for scans that no trusted pair joins to the first one; these
    keep the identity. `parent` [b] is the scan that each was placed by.
    """

    world_from_scan: Rigid
    reached: Bool[Array, " b"]
    parent: Int[Array, " b"]


def match_views(
    clouds: PointCloud,
    *,
    voxel_size: Float[Array, ""] | float,
    key: Key[Array, ""],
    capacity: int = 4096,
) -> ViewGraph:
    """All pairs of scans aligned from features, without any start.

    **Arguments:**

    - `clouds`: a stacked `PointCloud` [b, n, ...] with oriented normals.
    - `voxel_size`, `key`, `capacity`: as in `align_features`; about 1/40 of the size of
      the object.

    Scans are described once and aligned one pair after the other (bounded memory). A
    constant under differentiation.
    """
    count = clouds.points.shape[0]
    pairs = np.array(list(itertools.combinations(range(count), 2)), np.int32)
    describe = lambda cloud: describe_view(
        cloud, voxel_size=voxel_size, capacity=capacity
    )
    views = jax.lax.map(describe, jax.tree.map(jnp.asarray, clouds))
    at = lambda i: jax.tree.map(lambda x: x[i], views)

    def align(row):
        (target, source), part = row
        return align_views(at(source), at(target), key=part)

    starts = jax.lax.map(align, (jnp.asarray(pairs), jax.random.split(key, len(pairs))))
    agreed = starts.result == RESULTS.successful
    score = jnp.where(agreed, starts.num_inliers * starts.fitness, 0)
    return ViewGraph(jnp.asarray(pairs), starts, score)


def spanning_poses(graph: ViewGraph, num_scans: int) -> Poses:
    """The poses along the maximum spanning tree of the scores, from scan 0.

    Source: Prim 1957.
    """
    b = num_scans
    target, source = graph.pairs[:, 0], graph.pairs[:, 1]
    there = graph.starts.target_from_source
    back = jax.vmap(lambda t: t.inverse())(there)
    eye = jax.vmap(lambda _: Rigid.identity(there.translation.dtype))(jnp.arange(b * b))
    eye = jax.tree.map(lambda x: x.reshape(b, b, *x.shape[1:]), eye)
    put = lambda x, t, u: x.at[target, source].set(t).at[source, target].set(u)
    edges = jax.tree.map(put, eye, there, back)
    score = put(jnp.zeros((b, b), graph.score.dtype), graph.score, graph.score)

    def place(_, carry):
        poses, reached, parent = carry
        open_ = reached[:, None] & ~reached[None, :] & (score > 0)
        best = jnp.argmax(jnp.where(open_, score, -1))
        i, j = best // b, best % b
        at = lambda tree, *k: jax.tree.map(lambda x: x[k], tree)
        pose = at(poses, i) @ at(edges, i, j)
        use = open_[i, j]
        poses = jax.tree.map(
            lambda x, y: x.at[j].set(jnp.where(use, y, x[j])), poses, pose
        )
        return (
            poses,
            reached.at[j].set(reached[j] | use),
            parent.at[j].set(jnp.where(use, i, parent[j])),
        )

    start = (
        jax.tree.map(lambda x: x[0], eye),
        jnp.arange(b) == 0,
        jnp.arange(b, dtype=jnp.int32),
    )
    return Poses(*jax.lax.fori_loop(0, b - 1, place, start))
