"""One template deformed onto every scan of a ragged batch: meshes in correspondence."""

import equinox as eqx
import jax
import jax.numpy as jnp

from ..registration import Deformed, nonrigid
from ..shapes import PointCloud, TriangleMesh
from ._devices import gathered, on_each, placed
from ._items import check_batch
from ._register import masked


def nonrigid_many(template: TriangleMesh, targets: PointCloud, **settings) -> Deformed:
    """The template deformed onto each scan of a ragged batch, in one compiled call.

    All results have the faces of the template: vertex i of one mesh corresponds to
    vertex i of every other. The scans are worked on one after the other on each local
    device, and each is that of `nonrigid` alone.

    **Arguments:**

    - `template`: a mesh, roughly aligned with all targets (see `register_many`).
    - `targets`: scans as one batch [b, n, 3] with masks, of `jaxgeom.stack`. Points and
      normals that are not finite are ignored.
    - `settings`: keyword arguments of `nonrigid`, the same for all.

    Returns a `Deformed` on the host whose arrays have a leading axis [b]. **Statuses:**
    those of `nonrigid`, one for each scan. Raises `GeometryError` for targets that are
    no batch.
    """
    check_batch(targets, "registration.nonrigid")
    items, mesh = placed(masked(targets))
    template = jax.tree.map(jnp.asarray, template)
    found = _deform(items, (template, settings), mesh)
    return gathered(found, targets.points.shape[0])


@eqx.filter_jit
def _deform(items, given, mesh):
    arrays, fixed = eqx.partition(given, eqx.is_array)

    def run(targets, arrays):
        template, settings = eqx.combine(arrays, fixed)
        one = lambda target: nonrigid(template, target, **settings)
        return jax.lax.map(one, targets)

    return on_each(run, mesh)(items, arrays)
