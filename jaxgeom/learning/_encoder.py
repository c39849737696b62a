"""One-pass inference: a network that reads a cloud and writes the code of its shape."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from ..shapes import PointCloud
from ._losses import Samples, clamped_error, drawn_samples
from ._networks import Decoder, LatentField
from ._perceptron import Perceptron, Softplus, spread_perceptron


class PointEncoder(eqx.Module):
    """code = head(max over real points p of local(p)): a set to a vector.

    The order of the points does not matter, and padding has no influence at all. A
    cloud without any real point has the code of a set whose features are zero. The
    normals are not read.

    Source: C. Qi et al., PointNet, 2017, eq. 1.
    """

    local: Perceptron
    head: Perceptron

    @staticmethod
    def create(
        code_size: int,
        *,
        key: Key[Array, ""],
        width: int = 128,
    ) -> "PointEncoder":
        """Two layers per point and two after the maximum, of `width` units."""
        key_local, key_head = jax.random.split(key)
        local = spread_perceptron((3, width, width), Softplus(), key=key_local)
        head = spread_perceptron((width, width, code_size), Softplus(), key=key_head)
        return PointEncoder(local, head)

    def __call__(self, cloud: PointCloud) -> Float[Array, " c"]:
        """The code [c] of one cloud."""
        cloud = jax.tree.map(jnp.asarray, cloud).washed()
        features = jax.vmap(self.local)(cloud.points)
        real = cloud.mask[:, None]
        most = jnp.max(jnp.where(real, features, -jnp.inf), axis=0)
        return self.head(jnp.where(jnp.any(cloud.mask), most, 0))


class EncodedFamily(eqx.Module):
    """An encoder and a decoder trained as one: `field(cloud)` in a single pass.

    Sources: L. Mescheder et al., Occupancy networks, 2019 (the pair); J. J. Park et
    al., DeepSDF, 2019 (the decoder).
    """

    encoder: PointEncoder
    decoder: Decoder

    def field(self, cloud: PointCloud) -> LatentField:
        """The field of the shape that a cloud shows."""
        return self.decoder.field(self.encoder(cloud))


class EncodedLoss(eqx.Module):
    """E |clip(f(encoder(cloud_s), x)) - clip(d_s(x))| over shapes s and their clouds.

    Each step draws `shapes` of them, keeps at most `points` random points of the cloud
    of each, with normal `noise`, so that sparse and noisy clouds are learned, and draws
    `batch` samples. In a share `partial` of the cases all points beyond a random plane
    through the origin are left out (a view from one side).
    """

    clamp: float = eqx.field(static=True, default=0.2)
    shapes: int = eqx.field(static=True, default=16)
    batch: int = eqx.field(static=True, default=128)
    points: int = eqx.field(static=True, default=128)
    noise: float = eqx.field(static=True, default=0.003)
    partial: float = eqx.field(static=True, default=0.3)

    def __call__(
        self,
        family: EncodedFamily,
        given: tuple[Samples, PointCloud],
        key: Key[Array, ""],
    ):
        """The loss of both networks; samples [s, m] and clouds [s, n]."""
        key_shape, key_each = jax.random.split(key)
        num = given[0].values.shape[0]
        rows = jax.random.randint(key_shape, (self.shapes,), 0, num)
        samples, clouds = jax.tree.map(lambda x: x[rows], given)
        keys = jax.random.split(key_each, self.shapes)

        def of_shape(one, cloud, key):
            key_view, key_draw = jax.random.split(key)
            field = family.field(self._view(cloud, key_view))
            drawn = drawn_samples(one, self.batch, key=key_draw)
            values = jax.vmap(field)(drawn.points)
            return clamped_error(values, drawn.values, self.clamp)

        return jnp.mean(jax.vmap(of_shape)(samples, clouds, keys))

    def _view(self, cloud, key):
        """What a poor scan would show of a cloud."""
        key_rows, key_noise, key_plane, key_cut = jax.random.split(key, 4)
        n = cloud.points.shape[0]
        rows = jax.random.randint(key_rows, (self.points,), 0, n)
        points = cloud.points[rows]
        plane = jax.random.normal(key_plane, (3,), points.dtype)
        seen = points @ plane > 0
        cut = jax.random.uniform(key_cut) < self.partial
        noise = self.noise * jax.random.normal(key_noise, points.shape, points.dtype)
        mask = cloud.mask[rows] & (seen | ~cut)
        return PointCloud(points + noise, None, mask)
