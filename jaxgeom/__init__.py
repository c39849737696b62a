"""jaxgeom: from raw scans to watertight meshes, jit-compiled and differentiable.

Rooms and names are loaded when they are first used, so that the command line can answer
without starting JAX.
"""

import importlib

__version__ = "0.1.0"

_ROOMS = (
    "batch",
    "clouds",
    "convert",
    "fields",
    "io",
    "isosurface",
    "learning",
    "linear",
    "meshes",
    "neighbors",
    "normals",
    "parametric",
    "pipelines",
    "reconstruction",
    "registration",
    "render",
    "shapes",
    "subdivision",
    "transforms",
)
_NAMES = {
    "RESULTS": "_core",
    "GeometryError": "_core",
    "runtime_token": "_core",
    "PointCloud": "shapes",
    "TriangleMesh": "shapes",
    "PolygonMesh": "shapes",
    "Grid": "shapes",
    "stack": "shapes",
    "Rigid": "transforms",
    "Similarity": "transforms",
    "Affine": "transforms",
    "procrustes": "transforms",
    "generalized_procrustes": "transforms",
    "interpolate": "transforms",
    "Fusion": "pipelines",
    "FittedField": "pipelines",
    "find_start": "pipelines",
    "fit_field": "pipelines",
    "fit_many": "pipelines",
    "extract_many": "pipelines",
    "fuse": "pipelines",
    "nonrigid_many": "pipelines",
    "Reconstruction": "pipelines",
    "reconstruct": "pipelines",
    "reconstruct_jit": "pipelines",
    "reconstruct_many": "pipelines",
    "MeanAligned": "pipelines",
    "Pyramid": "pipelines",
    "Registration": "registration",
    "icp": "registration",
    "register": "pipelines",
    "register_jit": "pipelines",
    "register_many": "pipelines",
}
__all__ = ["__version__", *_ROOMS, *_NAMES]


def __getattr__(name: str):
    if name in _ROOMS:
        return importlib.import_module(f".{name}", __name__)
    if name in _NAMES:
        return getattr(importlib.import_module(f".{_NAMES[name]}", __name__), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__():
    return sorted(__all__)
