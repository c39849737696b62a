"""Tangents, normals, fundamental forms and curvatures, by automatic derivatives.

All for ONE (u, v); map over many with `jax.vmap`.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._core import safe_divide, safe_norm, safe_normalize
from ..shapes import Curvatures
from ._abstract import AbstractSurface, floating
from ._quadrature import rule

_AT_POLE = 8


def tangents(surface: Callable, uv: Float[Array, " 2"]) -> Float[Array, "2 3"]:
    """The derivatives X_u and X_v, as rows; X_u is zero at a pole of v."""
    return jax.jacfwd(surface)(floating(uv)).T


def normal(surface: Callable, uv: Float[Array, " 2"]) -> Float[Array, " 3"]:
    """The unit normal X_u x X_v / |...| at one (u, v).

    At a declared pole, where X_u x X_v = 0, it is the limit along the meridian through
    (u, v) from inside: that of d(X_u x X_v) towards the middle of the domain. The zero
    vector at other places where X_u and X_v are parallel.
    """
    uv = floating(uv)
    across = lambda x: jnp.cross(*tangents(surface, x))
    outward = across(uv)
    inward = _inward_at_poles(surface, uv)
    if inward is None:
        return safe_normalize(outward)
    _, limit = jax.jvp(across, (uv,), (jax.lax.stop_gradient(inward),))
    return safe_normalize(jnp.where(jnp.any(inward != 0), limit, outward))


def first_form(surface: Callable, uv: Float[Array, " 2"]) -> Float[Array, "2 2"]:
    """The metric [[E, F], [F, G]] with E = X_u . X_u, F = X_u . X_v, G = X_v . X_v."""
    rows = tangents(surface, uv)
    return rows @ rows.T


def second_form(surface: Callable, uv: Float[Array, " 2"]) -> Float[Array, "2 2"]:
    """h_ij = X_i . n_j = -X_ij . n: positive where X bends away from its normal.

    Many texts give it the other sign. Here a sphere of radius r has h = metric / r.
    """
    _, hessian = _two_orders(surface, floating(uv))
    return -jnp.tensordot(hessian, normal(surface, uv), 1)


def area_element(surface: Callable, uv: Float[Array, " 2"]) -> Float[Array, ""]:
    """The area |X_u x X_v| of the surface per du dv."""
    return safe_norm(jnp.cross(*tangents(surface, uv)))


def curvatures(surface: Callable, uv: Float[Array, " 2"]) -> Curvatures:
    """The curvatures at one (u, v).

    The second form in an orthonormal basis of the tangent plane: mean = tr / 2,
    Gaussian = det, principal = eigenvalues. At a declared pole they are taken the cube
    root of the machine epsilon (of the length of the domain) inside: right to its
    square for closed formulas smooth there, to the root itself for a NURBS net. Zero
    where X_u and X_v are parallel. At umbilics (k1 = k2) the derivative of `principal`
    is that of the mean.
    """
    rows, hessian = _two_orders(surface, _off_poles(surface, floating(uv)))
    across = jnp.cross(*rows)
    h = -jnp.tensordot(hessian, safe_normalize(across), 1)
    # An orthonormal basis of the tangent plane: X_u / |X_u|, then X_v without X_u.
    long, patch = safe_norm(rows[0]), safe_norm(across)
    skew = -safe_divide(jnp.dot(*rows), long * patch)
    first = jnp.stack([safe_divide(1, long), jnp.zeros_like(long)])
    basis = jnp.stack([first, jnp.stack([skew, safe_divide(long, patch)])])
    return Curvatures.of_form(basis @ h @ basis.T)


def area(surface: AbstractSurface, *, cells=(8, 8), order: int = 8) -> Float[Array, ""]:
    """The area of a surface: the integral of |X_u x X_v| over its domain.

    By Gauss-Legendre quadrature with `order` x `order` nodes in each of about `cells`
    cells, none across a break. Differentiable in the parameters of the surface.
    """
    return _integral(surface, lambda x: area_element(surface, x), cells, order)


def enclosed_volume(
    surface: AbstractSurface, *, cells=(8, 8), order: int = 8
) -> Float[Array, ""]:
    """The volume inside a closed surface: the integral of X . (X_u x X_v) / 3.

    Positive where the normal points outwards; quadrature as for `area`. For an open
    surface, the volume of the cone from the origin over it.
    """
    cone = lambda x: jnp.dot(surface(x), jnp.cross(*tangents(surface, x))) / 3
    return _integral(surface, cone, cells, order)


def _two_orders(surface, uv):
    """The first derivatives [2, 3] and the second ones [2, 2, 3], in one pass."""
    first = lambda x: (lambda j: (j, j))(jax.jacfwd(surface)(x).T)
    hessian, rows = jax.jacfwd(first, has_aux=True)(uv)
    return rows, jnp.moveaxis(hessian, 1, 2)


def _integral(surface, density, cells, order):
    domain = surface.domain()
    (u, wu), (v, wv) = rule(domain.u, cells[0], order), rule(domain.v, cells[1], order)
    at = lambda u, v: density(jnp.stack([u, v]))
    values = jax.vmap(lambda u: jax.vmap(lambda v: at(u, v))(v))(u)
    return wu @ values @ wv


def _poles(surface):
    """(axis, end, way inside) for every declared pole."""
    if not isinstance(surface, AbstractSurface):
        return []
    domain = surface.domain()
    return [
        (axis, end, side)
        for axis, along in enumerate((domain.u, domain.v))
        for end, side, is_pole in zip(
            (along.low, along.high),
            (along.length, -along.length),
            along.poles,
            strict=True,
        )
        if is_pole
    ]


def _inward_at_poles(surface, uv):
    """The way into the domain at a pole, zero elsewhere; None without poles."""
    poles = _poles(surface)
    if not poles:
        return None
    rounding = _AT_POLE * jnp.finfo(uv.dtype).eps
    inward = jnp.zeros_like(uv)
    for axis, end, side in poles:
        at = jnp.abs(uv[axis] - end) <= rounding * max(abs(side), abs(end))
        inward = inward.at[axis].set(jnp.where(at, side, inward[axis]))
    return inward


def _off_poles(surface, uv):
    """(u, v), held a little away from the poles."""
    by = jnp.finfo(uv.dtype).eps ** (1 / 3)
    for axis, end, side in _poles(surface):
        bound = end + by * side
        hold = jnp.maximum if side > 0 else jnp.minimum
        uv = uv.at[axis].set(hold(uv[axis], bound))
    return uv
