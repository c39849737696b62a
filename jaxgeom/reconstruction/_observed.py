"""What oriented points see of a vector field and its potential, and its inverse.

    rows = H (v, f) + noise,    T = H C H^T + noise^2,

C the covariance of (v, f), H the values of v at the samples and, screened, those of f
less their mean. Without the last, T is the same matrix for each component of v, so that
it has one row of n numbers in place of four.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._core import safe_divide
from ..linear import (
    LinearSolution,
    Nystrom,
    conjugate_gradients,
    interpolate,
    splat,
)
from ._kernels import Spectrum


class Observed(eqx.Module):
    """The samples of one cloud, and the prior: all linear maps of the model.

    - `share`: [n] of each sample in the mean; 0 for padding.
    - `noise`: [1 or 4, n] variances: of the normals, of all three components and f.
    - `scale`: [1 or 4, n] one over the deviations; T is solved scaled by it.
    """

    spectrum: Spectrum
    q: Float[Array, "n 3"]
    real: Bool[Array, " n"]
    share: Float[Array, " n"]
    noise: Float[Array, "r n"]
    scale: Float[Array, "r n"]
    preconditioner: Nystrom | None
    rtol: float
    max_steps: int = eqx.field(static=True)

    @staticmethod
    def of(spectrum, q, real, weight, noise, *, rank, rtol, max_steps) -> "Observed":
        """With a preconditioner of `rank` or of as many as there are unknowns."""
        share = jnp.where(real, weight, 0)
        share = safe_divide(share, jnp.sum(share))
        # Points without noise are not divided by it.
        node = jnp.zeros(spectrum.shape, q.dtype).at[0, 0, 0].set(1)
        own = jnp.stack([spectrum.variance] * 3 + [spectrum.levels_from(node)[0, 0, 0]])
        least = jnp.finfo(q.dtype).eps * own[: len(noise), None]
        scale = 1 / jnp.sqrt(jnp.maximum(noise, least))
        out = Observed(spectrum, q, real, share, noise, scale, None, rtol, max_steps)
        rank = min(rank, noise.size)
        if rank == 0:
            return out
        found = Nystrom.of(
            out.scaled_covariance, _tests(rank, noise.shape, real, q.dtype)
        )
        return eqx.tree_at(
            lambda o: o.preconditioner, out, found, is_leaf=lambda x: x is None
        )

    @property
    def screened(self) -> bool:
        """Whether the samples say where the surface is."""
        return len(self.noise) == 4

    def at(self, values):
        """Values at the samples, zero for padding."""
        return jnp.where(self.real, interpolate(values, self.q), 0)

    def spread(self, x):
        """The transpose of `at`."""
        return splat(jnp.where(self.real, x, 0), self.q, self.spectrum.shape)

    def rows(self, v, f):
        """H (v, f): [3 or 4, n]."""
        seen = jax.vmap(self.at)(v)
        if not self.screened:
            return seen
        level = self.at(f)
        level = jnp.where(self.real, level - jnp.sum(self.share * level), 0)
        return jnp.concatenate([seen, level[None]])

    def sources(self, rows):
        """H^T rows: sources of v [3, x, y, z] and of f [x, y, z]."""
        vectors = jax.vmap(self.spread)(rows[:3])
        if not self.screened:
            return vectors, jnp.zeros_like(vectors[0])
        level = jnp.where(self.real, rows[3], 0)
        return vectors, self.spread(level - self.share * jnp.sum(level))

    def fields(self, rows):
        """C H^T rows: v [3, x, y, z] and f [x, y, z]."""
        return self.spectrum.both_from(*self.sources(rows))

    def covariance(self, x):
        """H C H^T x for one row, or for all four."""
        if self.screened:
            return self.rows(*self.fields(x))
        return self.at(self.spectrum.smooth(self.spread(x[0])))[None]

    def scaled_covariance(self, x):
        """The same in units of the noise."""
        return self.scale * self.covariance(self.scale * x)

    def solve(self, rows) -> LinearSolution:
        """T^-1 rows [m, n]; residual and steps of each system [m], or [m / 4]."""
        own = self.scale**2 * self.noise

        def one(b):
            return conjugate_gradients(
                lambda x: self.scaled_covariance(x) + own * x,
                self.scale * b,
                rtol=self.rtol,
                max_steps=self.max_steps,
                preconditioner=self.preconditioner or (lambda r: r),
            )

        out = jax.vmap(one)(rows.reshape(-1, *self.noise.shape))
        value = (self.scale * out.value).reshape(rows.shape)
        return eqx.tree_at(lambda o: o.value, out, value)

    def solved(self, rows):
        """T^-1 rows; NaN where the residual is above the tolerance."""
        out = self.solve(rows)
        good = jnp.repeat(out.residual <= self.rtol, len(self.noise))
        return jnp.where(good[:, None], out.value, jnp.nan)

    def anchored(self, values):
        """Less the mean at the samples."""
        return values - jnp.sum(self.share * self.at(values))

    def looking_at(self, q):
        """The source whose product with a field is its anchored value at q."""
        return _point(q, self.spectrum.shape) - self.spread(self.share)

    def level_variance(self, q):
        """Of the anchored f at q."""
        source = self.looking_at(q)
        v, f = self.spectrum.vectors_from(source), self.spectrum.levels_from(source)
        looks = (jnp.zeros_like(v), source)
        return _least(_missed, looks, self, self.rows(v, f))

    def vector_variance(self, q):
        """[3] of the components of v at q."""
        source = _point(q, self.spectrum.shape)
        smooth = self.spectrum.smooth(source)
        if not self.screened:
            # One row for all three.
            seen = self.at(smooth)[None]
            return jnp.full(3, _least(_missed_alone, source, self, seen))
        # Cov(f, v_d) is minus its transpose.
        levels = -self.spectrum.vectors_from(source)

        def along(e):
            alone = lambda x: e[:, None, None, None] * x
            seen = self.rows(alone(smooth), jnp.tensordot(e, levels, 1))
            looks = (alone(source), jnp.zeros_like(source))
            return _least(_missed, looks, self, seen)

        return jax.vmap(along)(jnp.eye(3, dtype=q.dtype))


@eqx.filter_custom_jvp
def _least(missed, looks, data, seen):
    """The variance of what sources see of the prior, given the samples, of which `seen`
    is the covariance with it: that of the error of the predictor x = T^-1 seen. No
    difference of large numbers; and least there, so that an error of x counts by
    its square, and its derivative not at all."""
    return missed(looks, data, data.solved(seen))


@_least.def_jvp
def _least_jvp(primals, tangents):
    missed, looks, data, seen = primals
    x = data.solved(seen)
    return eqx.filter_jvp(
        lambda looks, data: missed(looks, data, x), (looks, data), tangents[1:3]
    )


def _missed(looks, data, x):
    """(e - H^T x)^T C (e - H^T x) + x^T noise x, e sources of v and f."""
    vectors, level = (e - h for e, h in zip(looks, data.sources(x), strict=True))
    v, f = data.spectrum.both_from(vectors, level)
    return jnp.vdot(vectors, v) + jnp.vdot(level, f) + jnp.sum(data.noise * x**2)


def _missed_alone(source, data, x):
    """The same for one component of v."""
    left = source - data.spread(x[0])
    own = jnp.vdot(left, data.spectrum.smooth(left))
    return own + jnp.sum(data.noise * x**2)


def _point(q, shape):
    """The source of a value at q."""
    return splat(jnp.ones(1, q.dtype), q[None], shape)


def _tests(rank, shape, real, dtype):
    """Random vectors [rank, *shape]; those of a sample hang on its number alone, so
    that padding changes nothing."""
    draw = lambda i: jax.random.normal(
        jax.random.fold_in(jax.random.key(0), i), (rank, shape[0]), dtype
    )
    drawn = jax.vmap(draw, out_axes=-1)(jnp.arange(shape[1]))
    return jnp.where(real, drawn, 0)
