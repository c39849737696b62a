"""Tangent, curvature, torsion and length of any curve, by automatic derivatives."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._core import safe_divide, safe_norm, safe_normalize
from ._abstract import AbstractCurve, floating
from ._quadrature import rule


class Bend(eqx.Module):
    """How a curve bends at a point.

    - `curvature`: |c' x c''| / |c'|^3, in 1 / length.
    - `torsion`: (c' x c'') . c''' / |c' x c''|^2, in 1 / length; positive for a
      right-handed screw, zero where the curvature is.
    """

    curvature: Float[Array, ""]
    torsion: Float[Array, ""]


def velocity(curve: Callable, t: Float[Array, ""]) -> Float[Array, " 3"]:
    """The derivative c'(t), in length per parameter."""
    return jax.jacfwd(curve)(floating(t))


def tangent(curve: Callable, t: Float[Array, ""]) -> Float[Array, " 3"]:
    """The unit tangent c' / |c'|; zero where the curve stands still."""
    return safe_normalize(velocity(curve, t))


def bend(curve: Callable, t: Float[Array, ""]) -> Bend:
    """The curvature and the torsion at t; zero where the curve stands still.

    In the plane (d = 2) use only points [x, y, 0]. Source: M. P. do Carmo,
    Differential geometry of curves and surfaces, 1976, section 1.5.
    """
    t = floating(t)
    first = jax.jacfwd(curve)
    second = jax.jacfwd(first)
    a, b, c = first(t), second(t), jax.jacfwd(second)(t)
    binormal = jnp.cross(a, b)
    square = jnp.dot(binormal, binormal)
    curvature = safe_divide(safe_norm(binormal), safe_norm(a) ** 3)
    return Bend(curvature, safe_divide(jnp.dot(binormal, c), square))


def length(curve: AbstractCurve, *, cells: int = 16, order: int = 8):
    """The length of a curve: the integral of |c'|.

    By Gauss-Legendre quadrature with `order` nodes in each of about `cells` cells, none
    across a break; the error falls as cells^(-2 order) on smooth pieces.
    Differentiable in the parameters of the curve.
    """
    nodes, weights = rule(curve.interval(), cells, order)
    speeds = jax.vmap(lambda t: safe_norm(velocity(curve, t)))(nodes)
    return jnp.dot(weights, speeds)
