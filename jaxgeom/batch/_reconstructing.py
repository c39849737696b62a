"""Lines without a target: a watertight mesh of the scan."""

import dataclasses
import os
import pathlib
import uuid

import equinox as eqx
import numpy as np

from ..io import load_cloud, save_mesh
from ..meshes import topology
from ..normals import LocalPlanes
from ..pipelines import reconstruct_many
from ..reconstruction import Poisson, ScreenedPoisson
from ..shapes import PointCloud, stack
from ._inputs import hash_of, readable, source_digest
from ._states import place_of
from ._tasks import AbstractTask, Outcome, size_bucket, verdict

# A field, its gradient and what the solver keeps, in bytes a node.
_NODE_BYTES = 24
_MOST_BYTES = 2**30


class _Key(eqx.Module):
    """Scans of one call have the same attributes, and normals all or none."""

    kind: tuple = eqx.field(static=True)
    size: int = eqx.field(static=True)


class Reconstructing(AbstractTask):
    """Reconstruct every scan by `reconstruct_many`; meshes are files `mesh/xx/ID.ply`.

    **Arguments:**

    - `resolution`, `padding`, `min_component`: those of `reconstruct`.
    - `screening`: the weight of the samples; None for that of the noise, 0 for plain
      Poisson.
    - `orientation_points`: the `capacity` of `LocalPlanes`, for scans without normals.
    """

    def __init__(
        self,
        resolution: int = 64,
        screening: float | None = None,
        padding: float = 0.1,
        min_component: float = 0.01,
        orientation_points: int = 4096,
    ):
        method = Poisson() if screening == 0 else ScreenedPoisson(screening=screening)
        self.settings = {
            "resolution": resolution,
            "padding": padding,
            "min_component": min_component,
        }
        self.choices = {
            **self.settings,
            "screening": screening,
            "orientation_points": orientation_points,
        }
        self.settings["method"] = method
        self.settings["orientation"] = LocalPlanes(capacity=orientation_points)

    def input_hash(self, scan):
        return hash_of(source_digest(scan.source), "", self.choices)

    def read(self, scan):
        with readable(scan.source, "source") as path:
            cloud = load_cloud(path)
        cloud = PointCloud(*(cloud.points, cloud.normals, cloud.mask, cloud.attributes))
        named = sorted((k, np.shape(v)[1:]) for k, v in cloud.attributes.items())
        kind = (cloud.normals is not None, *named)
        return _Key(kind, size_bucket(len(cloud.points))), cloud

    def most(self, key, chunk):
        field = _NODE_BYTES * self.settings["resolution"] ** 3
        most = max(1, min(chunk, _MOST_BYTES // field))
        # Chunks are padded to powers of two.
        return most if most == chunk else 1 << (most.bit_length() - 1)

    def program(self, key):
        return key

    def solve(self, key, scans, works, room, out):
        missing = [_without_points(works[0])] * (room - len(works))
        batch = stack([*works, *missing], capacity=key.size)
        found = reconstruct_many(batch, **self.settings)[: len(works)]
        return [_kept(*pair, out) for pair in zip(scans, found, strict=True)]


def _without_points(cloud):
    return eqx.tree_at(lambda c: c.mask, cloud, np.zeros(len(cloud.points), bool))


def _kept(scan, found, out) -> Outcome:
    """Write the mesh of a scan under a name of its own, then rename it."""
    told = verdict(found.result)
    # Notes of a scan that was refused say why in its own numbers.
    text = " ".join(found.notes) or told.text
    told = dataclasses.replace(told, text=text)
    path = pathlib.Path(out) / place_of("mesh", scan.id, ".ply")
    if told.status == "failed":
        # One of an earlier run, with other settings, is not that of this scan.
        path.unlink(missing_ok=True)
        return told
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.parent / f".{uuid.uuid4().hex}.ply"
    try:
        save_mesh(partial, found.mesh)
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)
    check = topology(found.mesh)
    facts = {
        "mesh": path.relative_to(out).as_posix(),
        "vertices": len(found.mesh.vertices),
        "faces": len(found.mesh.faces),
        "watertight": bool(check.is_closed & check.is_manifold),
    }
    if told.status == "ok" and not facts["watertight"]:
        told = Outcome("warning", "not_watertight", "the mesh has a boundary")
    return dataclasses.replace(told, facts=facts)
