"""Lines without a target: a watertight mesh of the scan."""

import dataclasses
import pathlib

import equinox as eqx
import numpy as np

from ..io import load_cloud, save_mesh
from ..pipelines import reconstruct_many
from ._inputs import digest_of, hash_of, readable
from ._states import place_of
from ._tasks import AbstractTask, Outcome, padded_batch, size_bucket, verdict

# A field, its gradient and what the solver keeps, in bytes a node.
_NODE_BYTES = 24
_MOST_BYTES = 2**30


class _Key(eqx.Module):
    """Scans of one call have the same attributes, and normals all or none, and one
    resolution and trim."""

    own: tuple = eqx.field(static=True)
    kind: tuple = eqx.field(static=True)
    size: int = eqx.field(static=True)


class Reconstructing(AbstractTask):
    """Reconstruct every scan by `reconstruct_many`; meshes are files `mesh/xx/ID.ply`.

    **Arguments:**

    - `settings`: keyword arguments of `reconstruct_many`.
    - `choices`: what `settings` depends on, as JSON: part of the hash of the inputs.
    """

    def __init__(self, settings: dict | None = None, choices: dict | None = None):
        self.settings = {"resolution": 64, **(settings or {})}
        self.choices = choices or {}

    def input_hash(self, scan):
        digest = digest_of(scan.source, "source_unreadable")
        return hash_of(digest, "", {**self.choices, **dict(_own(scan))})

    def read(self, scan):
        with readable(scan.source, "source_unreadable") as path:
            cloud = load_cloud(path)
        named = sorted((k, np.shape(v)[1:]) for k, v in cloud.attributes.items())
        kind = (cloud.normals is not None, *named)
        return _Key(_own(scan), kind, size_bucket(len(cloud.points))), cloud

    def most(self, key, chunk):
        field = _NODE_BYTES * self._settings(key)["resolution"] ** 3
        return max(1, min(chunk, _MOST_BYTES // field))

    def program(self, key):
        return key

    def solve(self, key, scans, works, room, out):
        batch = padded_batch(works, room, key.size)
        settings = self._settings(key)
        found = reconstruct_many(batch, **settings)[: len(works)]
        is_open = settings.get("trim") is not None
        return [_kept(*pair, is_open, out) for pair in zip(scans, found, strict=True)]

    def _settings(self, key):
        """The settings of the run, but where the lines have their own."""
        return {**self.settings, **dict(key.own)}


def _own(scan):
    """What a line says of its reconstruction: pairs of names and values."""
    said = (("resolution", scan.resolution), ("trim", scan.trim))
    return tuple(pair for pair in said if pair[1] is not None)


def _kept(scan, found, is_open, out) -> Outcome:
    """The outcome of a scan, once its mesh is written."""
    told = verdict(found.result)
    # Notes of a scan that was refused say why in its own numbers.
    told = dataclasses.replace(told, text=" ".join(found.notes) or told.text)
    place = place_of("mesh", scan.id, ".ply")
    path = pathlib.Path(out) / place
    if told.status == "failed":
        # One of an earlier run, with other settings, is not that of this scan.
        path.unlink(missing_ok=True)
        return told
    path.parent.mkdir(parents=True, exist_ok=True)
    save_mesh(path, found.mesh)
    check = found.topology
    facts = {
        "mesh": place.as_posix(),
        "vertices": len(found.mesh.vertices),
        "faces": len(found.mesh.faces),
        "watertight": bool(check.is_closed & check.is_manifold),
    }
    told = dataclasses.replace(told, facts=facts)
    # One that is trimmed is meant to be open.
    if told.status != "ok" or facts["watertight"] or is_open:
        return told
    text = f"the mesh is not closed and manifold. {told.text}".strip()
    return dataclasses.replace(told, status="warning", code="not_watertight", text=text)
