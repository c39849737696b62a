"""The museum task: oriented points of a statue in, a watertight mesh out."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._core import (
    RESULTS,
    GeometryError,
    first_failure,
    message,
    runtime_token,
)
from ..isosurface import (
    AsymptoticDecider,
    Capacity,
    Cubic,
    MarchingCubes,
    pad_outside,
)
from ..linear import interpolate
from ..meshes import (
    Topology,
    keep_faces,
    large_components,
    topology,
    trim_by_attribute,
)
from ..reconstruction import FieldSolution, PoissonStats, ScreenedPoisson, spread
from ..shapes import Grid, PointCloud, TriangleMesh
from ._memory import check_memory
from ._prepare import padded, prepare

EXTRACTOR = MarchingCubes(placement=Cubic(), ambiguity=AsymptoticDecider())


class Reconstruction(eqx.Module):
    """A mesh with the field whose level set it is.

    - `mesh`: vertices in the unit of the points, unit normals, and the attribute
      `density` (samples per unit of area) beside those of the cloud.
    - `field`: the `FieldSolution`; a field itself, negative inside.
    - `result`: the first status that is not success, of the solver or the extractor.
    - `stats`: of the solver. `topology`: the check of the mesh (host forms; else None).
    - `notes`: sentences on what was estimated, ignored or looks odd (host form).
    """

    mesh: TriangleMesh
    field: FieldSolution
    result: RESULTS
    stats: PoissonStats
    topology: Topology | None = None
    notes: tuple[str, ...] = eqx.field(static=True, default=())


def reconstruct(
    cloud: PointCloud | Float[Array, "n 3"],
    *,
    resolution: int = 128,
    method=None,
    extractor=None,
    weights: Float[Array, " n"] | None = None,
    orientation=None,
    padding: float = 0.1,
    trim: float | None = None,
    min_component: float = 0.01,
    throw: bool = True,
) -> Reconstruction:
    """The watertight mesh of a scanned surface (host form).

    Checks the cloud, centers it in double precision, estimates missing normals, solves
    for the field on resolution^3 nodes, extracts, cleans and checks the mesh.

    **Arguments:**

    - `cloud`: a `PointCloud`, or points [n, 3] in any unit.
    - `resolution`: nodes along each side of the cube around the cloud.
    - `method`: `ScreenedPoisson()` by default, `Poisson()`, `SSD()` or `Wavelet()`.
    - `extractor`: by default `MarchingCubes` with cubic placement and the asymptotic
      decider.
    - `weights`: [n] confidence of the points.
    - `orientation`: how missing normals are found: `normals.LocalPlanes()` by default,
      or `normals.WindingConsistency()`.
    - `padding`: width of the empty margin, as a share of the longest side.
    - `trim`: remove the surface where samples are sparser than `trim` times the median
      density of the samples; the mesh is open there. None keeps it closed.
    - `min_component`: remove bodies with fewer than this share of the faces of the
      largest; 0 keeps all.
    - `throw`: raise `GeometryError` for a status that left no usable mesh.

    **Statuses:** those of `screened_poisson` and `marching_cubes`.
    """
    check_memory(check_resolution(resolution), jnp.zeros(()).dtype.itemsize)
    method = ScreenedPoisson() if method is None else method
    extractor = EXTRACTOR if extractor is None else extractor
    ready = prepare(cloud, weights=weights, orientation=orientation)
    unit, confidence, token = *_padded(ready), runtime_token()
    field = _solve(unit, confidence, method, resolution, padding, token)
    closed = trim is None
    values, grid = field.values, field.grid
    if closed:
        values, grid = _pad(values, grid, field.level)
    needed = _measure(extractor, values, field.level)
    capacity = Capacity.holding(*(int(n) for n in jax.tree.leaves(needed)))
    if throw:
        _raise_without_surface(needed)
    mesh, status = _mesh(field, (values, grid), unit, extractor, capacity, token)
    check = _topology(mesh)
    if not closed or int(check.num_components) > 1:
        share = None if closed else jnp.asarray(trim, values.dtype)
        least = jnp.asarray(min_component, values.dtype)
        mesh = _clean(mesh, field.stats.area, share, least)
        check = _topology(mesh)
    notes = ready.notes + notes_on(field)
    mesh, field = to_user(mesh.trim(), field, ready)
    result = first_failure(field.result, status)
    return Reconstruction(mesh, field, result, field.stats, check, notes)


def reconstruct_jit(
    cloud: PointCloud,
    *,
    resolution: int,
    capacity: Capacity | None = None,
    method=None,
    extractor=None,
    weights: Float[Array, " n"] | None = None,
    padding: float = 0.1,
    token: Bool[Array, ""] | None = None,
) -> Reconstruction:
    """The mesh of one oriented cloud at static capacity: pure, for use inside your own
    `jax.jit`, `jax.vmap` (ragged clouds by their masks) and `jax.grad`.

    Derivatives reach the points, normals, weights and the screening weight of `method`;
    they are those of the exact solution of the linear system.

    **Arguments:** as `reconstruct`, and

    - `cloud`: must have normals; coordinates of order 1 are best in single precision.
    - `capacity`: static sizes of the mesh; a guess from the resolution by default.
    - `token`: a run-time true, `jaxgeom.runtime_token()`, passed to your jitted
      function as an argument, makes it several times faster on CPUs; do not batch it.

    **Statuses:** as `reconstruct`, and `capacity_exceeded`.
    """
    if cloud.normals is None:
        raise GeometryError(
            message(
                "reconstruct_jit needs a cloud with normals",
                "normals=None",
                "Call jaxgeom.normals.estimate and orient_consistently first.",
            )
        )
    method = ScreenedPoisson() if method is None else method
    extractor = EXTRACTOR if extractor is None else extractor
    grid = Grid.around(cloud, resolution=resolution, padding=padding)
    capacity = Capacity.for_surface(grid.shape) if capacity is None else capacity
    field = method(cloud, grid, weights=weights, token=token)
    found = extractor(field.values, grid, field.level, capacity=capacity, token=token)
    mesh = with_attributes(found.mesh, field, cloud, token)
    result = first_failure(field.result, found.result)
    return Reconstruction(mesh, field, result, field.stats)


def check_resolution(resolution) -> int:
    """The resolution; `GeometryError` unless it is a whole number of at least 8."""
    if int(resolution) != resolution or resolution < 8:
        raise GeometryError(
            message(
                "resolution must be a whole number of at least 8",
                f"{resolution}",
                "Typical values are 64 to 512.",
            )
        )
    return int(resolution)


def _padded(ready):
    """The cloud, and the weights, padded to a bucket so that programs are shared."""
    cloud = padded(ready.cloud)
    if ready.weights is None:
        return cloud, None
    padding = cloud.mask.shape[0] - len(ready.weights)
    weights = np.pad(ready.weights.astype(cloud.points.dtype), (0, padding))
    return cloud, jnp.asarray(weights)


@eqx.filter_jit
def _solve(cloud, weights, method, resolution, padding, token):
    grid = Grid.around(cloud, resolution=resolution, padding=padding)
    return method(cloud, grid, weights=weights, token=token)


@eqx.filter_jit
def _pad(values, grid, level):
    return pad_outside(values, grid, level)


@eqx.filter_jit
def _measure(extractor, values, level):
    return extractor.measure(values, level)


@eqx.filter_jit
def _mesh(field, samples, cloud, extractor, capacity, token):
    values, grid = samples
    found = extractor(values, grid, field.level, capacity=capacity, token=token)
    return with_attributes(found.mesh, field, cloud, token), found.result


def cleaned(mesh, areas, trim, min_component):
    """The mesh without what lies in gaps of the scan (None: keep it) and specks."""
    if trim is not None:
        areas = jnp.where(areas > 0, areas, jnp.nan)
        sparsest = trim / jnp.nanmedian(areas)
        mesh = trim_by_attribute(mesh, mesh.attributes["density"], sparsest)
    return keep_faces(mesh, large_components(mesh, min_fraction=min_component))


_clean = eqx.filter_jit(cleaned)
_topology = eqx.filter_jit(topology)


def with_attributes(mesh, field, cloud, token):
    """The density of samples and the cloud's attributes, read at the vertices."""
    q = field.grid.index_of(mesh.vertices)
    attributes = {"density": field.density_at(mesh.vertices)}
    for name, values in cloud.attributes.items():
        flat = values.reshape(values.shape[0], -1).astype(q.dtype)
        at = field.grid.index_of(cloud.points)
        nodes = spread(flat, at, cloud.mask, field.grid.shape, token=token)
        columns = [interpolate(nodes[..., c], q) for c in range(flat.shape[1])]
        shape = (mesh.vertices.shape[0], *values.shape[1:])
        attributes[name] = jnp.stack(columns, axis=-1).reshape(shape)
    return eqx.tree_at(lambda m: m.attributes, mesh, attributes)


def _raise_without_surface(needed):
    if int(needed.faces) == 0:
        raise GeometryError(
            message(
                "the field must change sign within the grid",
                "no surface was found",
                "Check the normals: do they point outward consistently?",
            )
        )


def notes_on(field) -> tuple[str, ...]:
    """What looks odd about a field, in words (host)."""
    corners = np.asarray(field.values)[:: field.values.shape[0] - 1]
    corners = corners[:, :: corners.shape[1] - 1, :: corners.shape[2] - 1]
    if corners.mean() < float(field.level):
        return ("normals look inverted: the surface encloses the outside",)
    return ()


def to_user(mesh, field, ready):
    """Back to the unit and the place of the user, in double precision on the host."""
    scale, dtype = ready.scale, ready.dtype
    back = lambda x: np.asarray(x, np.float64) * scale + ready.center
    attributes = dict(mesh.attributes)
    attributes["density"] = attributes["density"] / scale**2
    mesh = eqx.tree_at(
        lambda m: (m.vertices, m.attributes),
        mesh,
        (back(mesh.vertices).astype(dtype), attributes),
    )
    grid = Grid(
        back(field.grid.origin),
        np.asarray(field.grid.spacing, np.float64) * scale,
        field.grid.shape,
    )
    stats = eqx.tree_at(
        lambda s: (s.noise, s.area),
        field.stats,
        (field.stats.noise * scale, field.stats.area * scale**2),
    )
    field = eqx.tree_at(
        lambda f: (f.grid, f.density, f.stats),
        field,
        (grid, field.density / scale**2, stats),
    )
    return mesh, field
