"""Losses: what makes a field fit points, distances or insides."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from .._core import masked_mean, safe_norm, safe_normalize
from ..shapes import PointCloud
from ._training import number


class Samples(eqx.Module):
    """Points [m, 3] of space with what is known there: distances [m] (or insides)."""

    points: Float[Array, "m 3"]
    values: Float[Array, " m"]


class SurfaceLoss(eqx.Module):
    """Points on the surface, and slope 1 everywhere: no distance need be known.

    data E|f(p)| + normals E|grad f(p) - n| + eikonal E(|grad f(x)| - 1)^2
    + away E exp(-sharpness |f(x)|), with p in the cloud and x half near the cloud
    (normal deviates of `spread`) and half uniform in the cube [-reach, reach]^3.

    The last term keeps stray surfaces away where there are no points. Without normals
    in the cloud their term is absent: the sphere at the start decides what is inside.
    Padding has no influence. The weights are arrays; `batch` (static) is the number of
    points and of x drawn per step. Lengths are in the unit of the field.

    Sources: A. Gropp et al., Implicit geometric regularization for learning shapes,
    2020, eq. 2; V. Sitzmann et al., SIREN, 2020, eq. 6 (last term).
    """

    data: Float[Array, ""] = eqx.field(converter=number, default=3.0)
    normals: Float[Array, ""] = eqx.field(converter=number, default=1.0)
    eikonal: Float[Array, ""] = eqx.field(converter=number, default=0.1)
    away: Float[Array, ""] = eqx.field(converter=number, default=0.01)
    sharpness: float = eqx.field(static=True, default=50.0)
    spread: float = eqx.field(static=True, default=0.1)
    reach: float = eqx.field(static=True, default=0.6)
    batch: int = eqx.field(static=True, default=512)

    def __call__(self, field, cloud: PointCloud, key: Key[Array, ""]):
        """The loss of a field, estimated with `key`."""
        key_data, key_space = jax.random.split(key)
        drawn = drawn_points(cloud, self.batch, key=key_data)
        value, slope = jax.vmap(jax.value_and_grad(field))(drawn.points)
        weigh = lambda weight, term: weight.astype(term.dtype) * term
        loss = weigh(self.data, masked_mean(jnp.abs(value), drawn.mask))
        if drawn.normals is not None:
            given = safe_normalize(drawn.normals)
            known = drawn.mask & (safe_norm(given) > 0)
            turned = masked_mean(safe_norm(slope - given), known)
            loss += weigh(self.normals, turned)
        value, slope = jax.vmap(jax.value_and_grad(field))(
            self._space(drawn.points, key_space)
        )
        steep = jnp.mean((safe_norm(slope) - 1) ** 2)
        stray = jnp.mean(jnp.exp(-self.sharpness * jnp.abs(value)))
        return loss + weigh(self.eikonal, steep) + weigh(self.away, stray)

    def _space(self, points, key):
        key_near, key_far = jax.random.split(key)
        half = points.shape[0] // 2
        shape, dtype = (half, 3), points.dtype
        near = points[:half] + self.spread * jax.random.normal(key_near, shape, dtype)
        far = self.reach * jax.random.uniform(key_far, shape, dtype, -1.0, 1.0)
        return jnp.concatenate([near, far])


class DistanceLoss(eqx.Module):
    """E |clip(f(x)) - clip(d)|, clip to [-clamp, clamp]: known distances d at x.

    `batch` (static) samples are drawn per step. Serves unsigned distances, too (then
    the field is an `Unsigned` one). Source: J. J. Park et al., DeepSDF, 2019, eq. 4.
    """

    clamp: float = eqx.field(static=True, default=0.2)
    batch: int = eqx.field(static=True, default=1024)

    def __call__(self, field, samples: Samples, key: Key[Array, ""]):
        """The loss of a field, estimated with `key`."""
        drawn = drawn_samples(samples, self.batch, key=key)
        values = jax.vmap(field)(drawn.points)
        return clamped_error(values, drawn.values, self.clamp)


class OccupancyLoss(eqx.Module):
    """Cross-entropy of insides: E softplus(f(x)) inside, E softplus(-f(x)) outside.

    The logit of being inside is -f, so that f is a field whose surface lies at level 0,
    where inside and outside are equally likely; the probability of being inside is
    `fields.SoftOccupancy(f, 1)`. `samples.values` are negative inside.

    Source: L. Mescheder et al., Occupancy networks, 2019, eq. 3.
    """

    batch: int = eqx.field(static=True, default=1024)

    def __call__(self, field, samples: Samples, key: Key[Array, ""]):
        """The loss of a field, estimated with `key`."""
        drawn = drawn_samples(samples, self.batch, key=key)
        values = jax.vmap(field)(drawn.points)
        return jnp.mean(jax.nn.softplus(jnp.where(drawn.values < 0, values, -values)))


def clamped_error(values, distances, clamp):
    """The mean absolute difference of values and distances, both clipped."""
    cut = lambda x: jnp.clip(x, -clamp, clamp)
    return jnp.mean(jnp.abs(cut(values) - cut(distances)))


def drawn_points(cloud: PointCloud, num: int, *, key: Key[Array, ""]) -> PointCloud:
    """`num` points drawn at random from the real ones (with repetition).

    With no real point all are masked out. Which are drawn does not depend on how many
    rows of padding follow the real points.
    """
    cloud = jax.tree.map(jnp.asarray, cloud).washed()
    rank = jnp.cumsum(cloud.mask)
    count = rank[-1]
    uniform = jax.random.uniform(key, (num,))
    wanted = jnp.floor(uniform * count).astype(rank.dtype) + 1
    rows = jnp.searchsorted(rank, jnp.minimum(wanted, count))
    pick = lambda x: x[rows]
    normals = None if cloud.normals is None else pick(cloud.normals)
    mask: Bool[Array, " n"] = pick(cloud.mask) & (count > 0)
    return PointCloud(pick(cloud.points), normals, mask)


def drawn_samples(samples: Samples, num: int, *, key: Key[Array, ""]) -> Samples:
    """`num` samples drawn at random (with repetition)."""
    rows = jax.random.randint(key, (num,), 0, samples.values.shape[-1])
    return Samples(samples.points[rows], samples.values[rows])
