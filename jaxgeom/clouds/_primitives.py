"""Planes, spheres and cylinders: from few points, and how far others are from them."""

from abc import abstractmethod
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from .._core import safe_divide, safe_norm, safe_normalize


class AbstractPrimitive(eqx.Module):
    """A simple surface that a few points determine."""

    @abstractmethod
    def heights(self, points: Float[Array, "*n 3"]) -> Float[Array, "*n"]:
        """The signed distances of points."""

    @abstractmethod
    def moved(self, shift: Float[Array, " 3"], scale) -> "AbstractPrimitive":
        """The primitive through scale * x + shift where this one goes through x."""


class AbstractModel(eqx.Module):
    """Which primitive is sought; `sample_size` points determine one."""

    sample_size: eqx.AbstractClassVar[int]
    needs_normals: eqx.AbstractClassVar[bool]

    @abstractmethod
    def through(self, points: Float[Array, "s 3"], normals) -> AbstractPrimitive:
        """The primitive through a minimal sample; not finite where there is none."""


class PlaneShape(AbstractPrimitive):
    """The points with normal . x = offset, for a unit normal."""

    normal: Float[Array, " 3"]
    offset: Float[Array, ""]

    def heights(self, points):
        """normal . x - offset."""
        return points @ safe_normalize(self.normal) - self.offset

    def moved(self, shift, scale):
        """The plane scaled, then shifted."""
        normal = safe_normalize(self.normal)
        return PlaneShape(normal, scale * self.offset + normal @ shift)


class SphereShape(AbstractPrimitive):
    """The points at distance `radius` from `center`."""

    center: Float[Array, " 3"]
    radius: Float[Array, ""]

    def heights(self, points):
        """|x - center| - radius."""
        return safe_norm(points - self.center) - self.radius

    def moved(self, shift, scale):
        """The sphere scaled, then shifted."""
        return SphereShape(scale * self.center + shift, scale * self.radius)


class CylinderShape(AbstractPrimitive):
    """The points at distance `radius` from the line through `point` along `axis`."""

    point: Float[Array, " 3"]
    axis: Float[Array, " 3"]
    radius: Float[Array, ""]

    def heights(self, points):
        """|(x - point) - axis (axis . (x - point))| - radius."""
        axis, away = safe_normalize(self.axis), points - self.point
        return safe_norm(away - (away @ axis)[..., None] * axis) - self.radius

    def moved(self, shift, scale):
        """The cylinder scaled, then shifted."""
        axis = safe_normalize(self.axis)
        return CylinderShape(scale * self.point + shift, axis, scale * self.radius)


class Plane(AbstractModel):
    """Planes through three points."""

    sample_size: ClassVar[int] = 3
    needs_normals: ClassVar[bool] = False

    def through(self, points, normals):
        """The plane of three points."""
        a, b, c = points
        normal = jnp.cross(b - a, c - a)
        size = jnp.linalg.norm(normal)
        normal = normal / size
        return PlaneShape(normal, normal @ a)


class Sphere(AbstractModel):
    """Spheres through four points."""

    sample_size: ClassVar[int] = 4
    needs_normals: ClassVar[bool] = False

    def through(self, points, normals):
        """The sphere of four points: 2 (x_i - x_0) . c = |x_i|^2 - |x_0|^2."""
        rows = points[1:] - points[0]
        square = jnp.sum(rows**2, axis=1)
        volume = jnp.linalg.det(rows)
        # Cramer's rule, without a factorisation for every hypothesis.
        crossed = [jnp.cross(rows[(i + 1) % 3], rows[(i + 2) % 3]) for i in range(3)]
        away = sum(square[i] * crossed[i] for i in range(3)) / (2 * volume)
        return SphereShape(points[0] + away, jnp.linalg.norm(away))


class Cylinder(AbstractModel):
    """Cylinders through two points with normals.

    The axis is perpendicular to both normals and goes through the point where the lines
    along them come nearest to each other.

    Source: R. Schnabel et al., Efficient RANSAC for point-cloud shape detection, 2007.
    """

    sample_size: ClassVar[int] = 2
    needs_normals: ClassVar[bool] = True

    def through(self, points, normals):
        """The cylinder of two oriented points."""
        (a, b), (m, n) = points, normals
        axis = jnp.cross(m, n)
        axis = axis / jnp.linalg.norm(axis)
        flat = lambda x: x - axis * (axis @ x)
        gap, one, two = flat(b - a), flat(m), flat(n)
        # a + s m meets b + t n in the plane across the axis.
        s = (axis @ jnp.cross(gap, two)) / (axis @ jnp.cross(one, two))
        center = a + s * one
        radius = (safe_norm(flat(a - center)) + safe_norm(flat(b - center))) / 2
        return CylinderShape(center, axis, radius)


def refit(primitive: AbstractPrimitive, points, weights, steps: int):
    """Gauss-Newton steps on the sum of `weights` [n] times squared heights."""
    flat, rebuild = ravel_pytree(primitive)
    heights = lambda x: rebuild(x).heights(points)

    def step(_, x):
        rows, residual = jax.jacfwd(heights)(x), heights(x)
        normal = rows.T @ (weights[:, None] * rows)
        # The length of a normal or an axis is free: without damping it is singular.
        damping = jnp.finfo(x.dtype).eps ** 0.5 * jnp.trace(normal)
        normal = normal + damping * jnp.eye(x.size, dtype=x.dtype)
        change = jnp.linalg.solve(normal, rows.T @ (weights * residual))
        better = x - change
        return jnp.where(jnp.all(jnp.isfinite(better)), better, x)

    return rebuild(jax.lax.fori_loop(0, steps, step, flat))


def spread_of(heights, weights):
    """The root mean square of heights [n] under weights."""
    return jnp.sqrt(safe_divide(jnp.sum(weights * heights**2), jnp.sum(weights)))
