"""How far a reconstructed surface is from the true one."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..shapes import TriangleMesh
from ._metrics import harmonic_mean, match, point_to_mesh
from ._sampling import sample_surface


class Evaluation(eqx.Module):
    """Errors of a mesh against a reference, in the unit of the meshes.

    From samples of both surfaces (limited by the sampling: see `evaluate`):

    - `accuracy`, `completeness`: mean distance of the samples of the mesh to the
      nearest samples of the reference, and the reverse.
    - `chamfer`: CD-L1, the mean of these two.
    - `precision`, `recall`, `f_score`: shares within the threshold, and 2PR / (P + R).
    - `normal_consistency`: mean absolute cosine of face normals, both ways.

    From samples of one surface to the other surface itself (exact distances):

    - `rms_to_reference`: root mean square, samples of the mesh to the reference.
    - `rms_from_reference`: root mean square, samples of the reference to the mesh.
    - `rms`: root of the mean of the squares of these two.
    - `hausdorff`: the largest distance, both ways.
    """

    chamfer: Float[Array, ""]
    accuracy: Float[Array, ""]
    completeness: Float[Array, ""]
    f_score: Float[Array, ""]
    precision: Float[Array, ""]
    recall: Float[Array, ""]
    normal_consistency: Float[Array, ""]
    rms: Float[Array, ""]
    rms_to_reference: Float[Array, ""]
    rms_from_reference: Float[Array, ""]
    hausdorff: Float[Array, ""]


def evaluate(
    mesh: TriangleMesh,
    reference_mesh: TriangleMesh,
    *,
    key: Array,
    num: int = 100_000,
    threshold: float = 0.01,
) -> Evaluation:
    """The errors of `mesh` against `reference_mesh`, from `num` samples on each.

    `threshold` (of the F-score) is a fraction of the longest side of the bounding box
    of the reference. The sampled Chamfer distance of a surface from itself is not zero
    but about half the spacing of the samples: compare methods by `rms` and `hausdorff`.
    Under jit, `num` must be static. `key` is a typed key, used once.

    Source: S. Peng et al., Shape As Points, 2021 (protocol of the sampled metrics).
    """
    key_mesh, key_reference = jax.random.split(key)
    samples = sample_surface(mesh, num, key=key_mesh).cloud()
    truth = sample_surface(reference_mesh, num, key=key_reference).cloud()
    # One search mapped over both directions: half as much to compile.
    pair = lambda a, b: jax.tree.map(lambda *x: jnp.stack(x), a, b)
    pairs = (pair(samples, truth), pair(truth, samples))
    both = jax.lax.map(lambda ab: match(*ab), pairs)
    there, back = (jax.tree.map(lambda x, i=i: x[i], both) for i in range(2))
    exact = point_to_mesh(samples, reference_mesh)
    exact_back = point_to_mesh(truth, mesh)
    near = threshold * _longest_side(reference_mesh)
    precision, recall = there.share_within(near), back.share_within(near)
    accuracy, completeness = there.mean(), back.mean()
    return Evaluation(
        chamfer=(accuracy + completeness) / 2,
        accuracy=accuracy,
        completeness=completeness,
        f_score=harmonic_mean(precision, recall),
        precision=precision,
        recall=recall,
        normal_consistency=(there.mean_cosine() + back.mean_cosine()) / 2,
        rms=jnp.sqrt((exact.rms**2 + exact_back.rms**2) / 2),
        rms_to_reference=exact.rms,
        rms_from_reference=exact_back.rms,
        hausdorff=jnp.maximum(exact.max, exact_back.max),
    )


def _longest_side(mesh):
    real = mesh.vertex_mask[:, None]
    high = jnp.max(jnp.where(real, mesh.vertices, -jnp.inf), axis=0, initial=-jnp.inf)
    low = jnp.min(jnp.where(real, mesh.vertices, jnp.inf), axis=0, initial=jnp.inf)
    return jnp.max(high - low)
