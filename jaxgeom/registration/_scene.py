"""What an alignment is given, about the centers of its clouds."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._core import GeometryError, check_shape, message
from ..neighbors import AbstractIndex, kd_groups
from ..shapes import PointCloud, TriangleMesh
from ._correspondences import AbstractCorrespondence, Found, Indexed, Nearest
from ._kernels import AbstractKernel, Tukey
from ._models import AbstractModel, RigidModel, Tangent, tangent_of
from ._objectives import AbstractObjective, PointToPlane
from ._problem import Problem, problem_of
from ._solvers import AbstractSolver, GaussNewton

# Points of a group; successive groups are near each other too.
_GROUP = 8


class Method(eqx.Module):
    """The parts an alignment is composed of."""

    correspondence: AbstractCorrespondence = Nearest()
    objective: AbstractObjective = PointToPlane()
    kernel: AbstractKernel = Tukey()
    model: AbstractModel = RigidModel()
    solver: AbstractSolver = GaussNewton()

    @property
    def normals_of(self) -> tuple[str, ...]:
        """Whose normals are read, of "source" and "target"."""
        checked = self.correspondence.check is not None
        return ("source", "target") if checked else self.objective.normals_of


class Scene(eqx.Module):
    """Source and target about their centers, and what does not change."""

    source: PointCloud
    weights: Float[Array, " n"]
    prepared: eqx.Module
    source_center: Float[Array, " 3"]
    center: Float[Array, " 3"]
    tangent: Tangent
    method: Method
    max_distance: Float[Array, ""]

    @property
    def size(self):
        """The size of the target, the unit of shifts."""
        return jnp.max(jnp.abs(self.tangent.basis))

    def outward(self, pose):
        """A transform between the centered clouds as one between the given ones."""
        shift = pose.shift() + self.center - pose.linear() @ self.source_center
        return eqx.tree_at(lambda t: t.translation, pose, shift)

    def inward(self, pose):
        """The other way round."""
        shift = pose.shift() - self.center + pose.linear() @ self.source_center
        return eqx.tree_at(lambda t: t.translation, pose, shift)

    def moved(self, pose) -> PointCloud:
        """The source at a pose, with normals if they are read.

        Column by column: a CPU takes ten times as long for so narrow a product of
        matrices.
        """
        matrix, source = pose.linear(), self.source
        columns = [source.points[:, j, None] * matrix[:, j] for j in range(3)]
        read = source.normals is not None and "source" in self.method.normals_of
        normals = pose.normals(source.normals) if read else None
        return PointCloud(sum(columns) + pose.shift(), normals, source.mask)

    def match(self, pose, last: Found | None = None) -> Found:
        """The pairs at a pose, given those at the pose before."""
        rule, moved = self.method.correspondence, self.moved(pose)
        return rule.match(self.prepared, moved, self.max_distance, last)

    def problem(self, pose, found, previous) -> Problem:
        """The problem of given pairs at a pose, with the next width."""
        method, moved = self.method, self.moved(pose)
        places = method.correspondence.places(self.prepared, moved, found)
        parts = dict(
            tangent=self.tangent,
            pose=self.outward(pose),
            objective=method.objective,
            kernel=method.kernel,
            model=method.model,
        )
        mask = found.mask & (self.weights > 0)
        args = (moved, places, mask, self.weights, previous)
        problem = problem_of(*args, **parts)
        zero = jnp.zeros(problem.size, moved.points.dtype)
        width = method.kernel.width(problem.squares(zero), mask, previous)
        # Residuals below rounding say nothing of the noise.
        rounding = 64 * jnp.finfo(width.dtype).eps * self.size
        width = jnp.maximum(width, rounding)
        width = jnp.where(jnp.any(mask), width, previous)
        return eqx.tree_at(lambda p: p.width, problem, width)


class PreparedTarget(eqx.Module):
    """A target about its center, with its search structure, for many alignments."""

    prepared: eqx.Module
    center: Float[Array, " 3"]
    size: Float[Array, ""]

    @property
    def cloud(self) -> PointCloud:
        """The points of a cloud about their center."""
        return self._indexed().target

    @property
    def index(self) -> AbstractIndex:
        """The search structure of these points, for other uses."""
        return self._indexed().index

    def with_normals(self, normals: Float[Array, "n 3"]) -> "PreparedTarget":
        """The same cloud, with other unit normals."""
        cloud = self.cloud.with_normals(normals)
        return eqx.tree_at(lambda t: t.prepared.target, self, cloud)

    def _indexed(self):
        if isinstance(self.prepared, Indexed):
            return self.prepared
        raise GeometryError(
            message(
                "only a cloud as target has points and an index",
                type(self.prepared).__name__,
                "Prepare a PointCloud with Nearest, Mutual or Reciprocal.",
            )
        )


def prepare_target(target, correspondence: AbstractCorrespondence) -> PreparedTarget:
    """What `icp` needs of a target: pass it instead of the target to share the work."""
    target = _washed(target) if isinstance(target, PointCloud) else target
    center, size = _extent(target)
    prepared = correspondence.prepare(_shifted(target, center))
    return PreparedTarget(prepared, center, size)


def scene_of(source, target, method: Method, max_distance, weights) -> Scene:
    """Source and target, washed and about their centers, the target prepared."""
    if not isinstance(target, PreparedTarget):
        target = prepare_target(target, method.correspondence)
    source = _washed(source)
    dtype = source.points.dtype
    given = source.mask.astype(dtype)
    if weights is not None:
        check_shape("weights", weights, source.mask.shape)
        given = jnp.where(source.mask, weights, 0).astype(dtype)
    source_center, _ = _center(source.points, source.mask)
    source, given = _side_by_side(source, given)
    return Scene(
        _shifted(source, source_center),
        given,
        target.prepared,
        source_center,
        target.center.astype(dtype),
        tangent_of(method.model, target.center.astype(dtype), target.size),
        method,
        jnp.asarray(max_distance, dtype),
    )


def _washed(cloud) -> PointCloud:
    points = jnp.asarray(cloud.points)
    mask = cloud.mask & jnp.all(jnp.isfinite(points), axis=1)
    normals = cloud.normals
    if normals is not None:
        normals = jnp.asarray(normals)
        mask = mask & jnp.all(jnp.isfinite(normals), axis=1)
        normals = jnp.where(mask[:, None], normals, 0)
    return PointCloud(jnp.where(mask[:, None], points, 0), normals, mask)


def _side_by_side(source, weights):
    """The source sorted so that neighbors follow one another, wherever it moves: then
    searches need not sort. What is masked makes way for blank rows at the end."""
    rows = kd_groups(jax.lax.stop_gradient(source.points), source.mask, _GROUP)
    rows = rows.reshape(-1)[: weights.shape[0]]
    take = lambda x: x.at[rows].get(mode="fill", fill_value=0)
    return jax.tree.map(take, (source, weights))


def _extent(target):
    """Center and size of a target of any kind."""
    if isinstance(target, PointCloud):
        return _center(target.points, target.mask)
    if isinstance(target, TriangleMesh):
        return _center(jnp.asarray(target.vertices), target.vertex_mask)
    # A field knows no extent: its coordinates are taken as they are.
    return jnp.zeros(3), jnp.ones(())


def _shifted(shape, center):
    """The shape about its center."""
    if isinstance(shape, PointCloud):
        there = jnp.where(shape.mask[:, None], shape.points - center, 0)
        return PointCloud(there, shape.normals, shape.mask)
    if isinstance(shape, TriangleMesh):
        return eqx.tree_at(lambda m: m.vertices, shape, shape.vertices - center)
    return shape


def _center(points, mask):
    """Mean and root mean square radius; they only choose coordinates."""
    points = jax.lax.stop_gradient(points)
    count = jnp.maximum(jnp.sum(mask), 1).astype(points.dtype)
    mean = jnp.sum(jnp.where(mask[:, None], points, 0), axis=0) / count
    gaps = jnp.where(mask[:, None], points - mean, 0)
    square = jnp.sum(gaps**2) / count
    return mean, jnp.where(square > 0, jnp.sqrt(square), 1)


def check_normals(scene: Scene) -> None:
    """Raise where the objective needs normals that a cloud does not have."""
    needs = scene.method.objective.normals_of
    target = getattr(scene.prepared, "target", None)
    lacking = [
        name
        for name, cloud in (("source", scene.source), ("target", target))
        if name in needs and cloud is not None and cloud.normals is None
    ]
    if lacking:
        raise GeometryError(
            message(
                f"{type(scene.method.objective).__name__} needs normals of the "
                + " and the ".join(needs),
                "no normals of the " + " and the ".join(lacking),
                "Call normals.estimate first, or use PointToPoint.",
            )
        )
