"""DeepSDF: one decoder and a code per shape, trained together; codes for new clouds."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from .._core import RESULTS, masked_mean, safe_normalize
from ..shapes import PointCloud
from ._losses import Samples, clamped_error, drawn_points, drawn_samples
from ._networks import Decoder, LatentField
from ._training import Adam, number, train, train_jit


class Family(eqx.Module):
    """A decoder with the codes [s, c] of the shapes that it was trained on."""

    decoder: Decoder
    codes: Float[Array, "s c"]

    @staticmethod
    def create(
        num_shapes: int,
        decoder: Decoder,
        *,
        key: Key[Array, ""],
        spread: float = 0.1,
    ) -> "Family":
        """Codes for `num_shapes` shapes: normal deviates of `spread` to start from."""
        shape = (num_shapes, decoder.code_size)
        return Family(decoder, spread * jax.random.normal(key, shape))

    def field(self, shape: int) -> LatentField:
        """The field of one of the shapes of training."""
        return self.decoder.field(self.codes[shape])


class FamilyLoss(eqx.Module):
    """E |clip(f(z_s, x)) - clip(d_s(x))| + prior E |z_s|^2, over shapes s.

    Each step draws `shapes` of them and `batch` samples of each (both static).

    Source: J. J. Park et al., DeepSDF, 2019, eq. 9.
    """

    prior: Float[Array, ""] = eqx.field(converter=number, default=1e-3)
    clamp: float = eqx.field(static=True, default=0.2)
    shapes: int = eqx.field(static=True, default=16)
    batch: int = eqx.field(static=True, default=128)

    def __call__(self, family: Family, samples: Samples, key: Key[Array, ""]):
        """The loss of decoder and codes; samples [s, m] of every shape."""
        key_shape, key_sample = jax.random.split(key)
        num = samples.values.shape[0]
        rows = jax.random.randint(key_shape, (self.shapes,), 0, num)
        codes = family.codes[rows]

        def of_shape(code, one, key):
            drawn = drawn_samples(one, self.batch, key=key)
            values = jax.vmap(family.decoder.field(code))(drawn.points)
            return clamped_error(values, drawn.values, self.clamp)

        chosen = jax.tree.map(lambda x: x[rows], samples)
        keys = jax.random.split(key_sample, self.shapes)
        fit = jnp.mean(jax.vmap(of_shape)(codes, chosen, keys))
        size = jnp.mean(jnp.sum(codes**2, axis=-1))
        return fit + self.prior.astype(fit.dtype) * size


class CodeLoss(eqx.Module):
    """How badly one code explains a cloud; the decoder rests.

    E |f(z, p)| over points p of the cloud, with normals n E |f(z, p +- t n) -+ t| for
    t = `offset`, + prior |z|^2. `batch` (static) points are drawn per step.

    Source: J. J. Park et al., DeepSDF, 2019, eq. 10 and section 5 (partial scans).
    """

    prior: Float[Array, ""] = eqx.field(converter=number, default=1e-3)
    offset: float = eqx.field(static=True, default=0.03)
    batch: int = eqx.field(static=True, default=256)

    def __call__(self, code, given: tuple[Decoder, PointCloud], key: Key[Array, ""]):
        """The loss of a code [c]."""
        decoder, cloud = given
        field = decoder.field(code)
        drawn = drawn_points(cloud, self.batch, key=key)
        loss = masked_mean(jnp.abs(jax.vmap(field)(drawn.points)), drawn.mask)
        if drawn.normals is not None:
            normals = safe_normalize(drawn.normals)
            for t in (self.offset, -self.offset):
                off = jnp.abs(jax.vmap(field)(drawn.points + t * normals) - t)
                loss += masked_mean(off, drawn.mask)
        return loss + self.prior.astype(loss.dtype) * jnp.dot(code, code)


class Encoded(eqx.Module):
    """The member of a family that explains a cloud.

    `losses` [num_steps] of the search; `result`: its status.
    """

    field: LatentField
    losses: Float[Array, " s"]
    result: RESULTS

    @property
    def code(self) -> Float[Array, " c"]:
        """The code [c] that was found."""
        return self.field.code


def encode(
    decoder: Decoder,
    cloud: PointCloud,
    *,
    key: Key[Array, ""],
    loss: CodeLoss | None = None,
    adam: Adam | None = None,
) -> Encoded:
    """The code of a new, perhaps partial, cloud by optimisation (host form).

    The decoder is not changed: this is inference. The search starts at the code zero,
    the middle of the family. `cloud` is in the unit and place of the training shapes.

    **Statuses:** those of `train`.
    """
    loss, adam = _defaults(loss, adam)
    start = jnp.zeros(decoder.code_size)
    found = train(start, loss, (decoder, cloud), key=key, adam=adam)
    return Encoded(decoder.field(found.model), found.losses, found.result)


def encode_jit(
    decoder: Decoder,
    cloud: PointCloud,
    *,
    key: Key[Array, ""],
    loss: CodeLoss | None = None,
    adam: Adam | None = None,
) -> Encoded:
    """As `encode`, pure: for your own `jax.jit`, and `jax.vmap` over ragged clouds."""
    loss, adam = _defaults(loss, adam)
    start = jnp.zeros(decoder.code_size)
    found = train_jit(start, loss, (decoder, cloud), key=key, adam=adam)
    return Encoded(decoder.field(found.model), found.losses, found.result)


def _defaults(loss, adam):
    adam = Adam(num_steps=400, rate=5e-3) if adam is None else adam
    return CodeLoss() if loss is None else loss, adam
