"""The command line: what can be asked.

This file imports neither JAX nor trimesh, so that help and usage errors are immediate.
"""

import argparse

from .. import __version__
from . import _values as values

_EPILOG = """exit codes: 0 ok, 1 internal error, 2 usage, 3 file, 4 bad data,
5 the result failed its own check, 6 some scans of a batch failed, 130 interrupted"""


def parser() -> argparse.ArgumentParser:
    """The arguments of every command."""
    top = argparse.ArgumentParser(
        prog="jaxgeom",
        description="From raw scans to watertight meshes.",
        epilog=_EPILOG,
    )
    top.add_argument("--version", action="version", version=f"%(prog)s {__version__}")
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND")
    _add_demo(commands)
    _add_reconstruct(commands)
    _add_register(commands)
    _add_register_many(commands)
    _add_batch(commands)
    _add_fuse(commands)
    _add_mesh(commands)
    _add_info(commands)
    _add_pictures(commands)
    for command in commands.choices.values():
        command.add_argument(
            "-v", "--verbose", action="store_true", help="show tracebacks"
        )
    return top


def _add_demo(commands):
    demo = commands.add_parser(
        "demo", help="make a statue, scan it with noise, reconstruct and check it"
    )
    demo.add_argument("--out", default="demo", metavar="DIR", help="folder (demo)")
    demo.add_argument("--resolution", type=values.resolution, default=128, metavar="N")
    demo.add_argument("--seed", type=int, default=0)


def _add_reconstruct(commands):
    command = commands.add_parser(
        "reconstruct", help="a watertight mesh from a point cloud"
    )
    command.add_argument("input", metavar="SCAN", help="ply, xyz, csv, npz, pcd, ...")
    command.add_argument("--ignore-normals", action="store_true", help="estimate them")
    command.add_argument("--flip-normals", action="store_true")
    _add_surface(command)


def _add_surface(command):
    """The options of every command that makes a mesh."""
    command.add_argument("-o", "--output", required=True, metavar="MESH")
    size = command.add_mutually_exclusive_group()
    size.add_argument(
        "--resolution", type=values.resolution, metavar="N", help="nodes (128)"
    )
    size.add_argument("--depth", type=values.depth, metavar="D", help="resolution 2^D")
    _add_point_weight(command)
    command.add_argument(
        "--scale",
        type=values.scale,
        default=1.1,
        help="side of the cube / longest side (1.1)",
    )
    _add_trim(command)
    command.add_argument(
        "--min-component",
        type=values.nonnegative,
        default=0.01,
        metavar="F",
        help="drop bodies below this share of the largest (0.01; 0 keeps all)",
    )
    command.add_argument("--report", metavar="JSON", help="parameters, sizes, statuses")


def _add_trim(command):
    command.add_argument(
        "--trim",
        type=values.nonnegative,
        metavar="T",
        help="cut where samples are sparser than T x the median density",
    )


def _add_point_weight(command):
    command.add_argument(
        "--point-weight",
        type=values.nonnegative,
        metavar="W",
        help="screening weight; 0 for plain Poisson (default: from the noise)",
    )


def _add_register(commands):
    command = commands.add_parser(
        "register", help="the motion that lays one scan on another; prints it"
    )
    command.add_argument("source", metavar="SOURCE", help="the scan that is moved")
    command.add_argument("target", metavar="TARGET", help="the scan that stays")
    command.add_argument("-o", "--output", metavar="FILE", help="write the moved scan")
    start = command.add_mutually_exclusive_group()
    start.add_argument(
        "--init", metavar="FILE", help="a text file with the 4 x 4 matrix to start from"
    )
    start.add_argument(
        "--mean", action="store_true", help="start with the centers on each other"
    )
    start.add_argument(
        "--global",
        dest="find_start",
        action="store_true",
        help="find a start from features",
    )
    command.add_argument("--seed", type=int, default=0, help="for --global (0)")
    _add_alignment(command)


def _add_register_many(commands):
    command = commands.add_parser(
        "register-many", help="lay many scans on one, in one compiled call"
    )
    command.add_argument("target", metavar="TARGET", help="the scan that stays")
    command.add_argument("sources", nargs="+", metavar="SCAN")
    _add_alignment(command)


def _add_batch(commands):
    command = commands.add_parser(
        "batch", help="register or reconstruct every line of a manifest; reruns go on"
    )
    _add_manifest(command)
    command.add_argument("--out", required=True, metavar="DIR", help="folder of states")
    command.add_argument(
        "--shard", metavar="I/N", help="from 0/N (default: of the array job, or all)"
    )
    command.add_argument("--retry-failed", action="store_true")
    command.add_argument(
        "--dask",
        metavar="local|ADDRESS",
        help="workers of Dask: a process for each device here, or those of a scheduler",
    )
    command = commands.add_parser(
        "warmup", help="compile what a batch will need into the cache"
    )
    _add_manifest(command)
    status = commands.add_parser("batch-status", help="how the scans of a batch ended")
    status.add_argument("out", metavar="DIR")
    table = commands.add_parser("batch-collect", help="one CSV table of a batch")
    table.add_argument("out", metavar="DIR")
    table.add_argument("-o", "--output", required=True, metavar="CSV")


def _add_manifest(command):
    """The manifest, and the options for its lines."""
    command.add_argument(
        "manifest",
        metavar="MANIFEST",
        help="CSV or JSONL: id, source, target, init, parameters; no target: "
        "reconstruct",
    )
    command.add_argument(
        "--chunk",
        type=values.chunk,
        default=64,
        metavar="B",
        help="scans in one call (64)",
    )
    command.add_argument(
        "--resolution",
        type=values.resolution,
        default=64,
        metavar="N",
        help="nodes of the grid of a scan without a target (64)",
    )
    _add_point_weight(command)
    _add_trim(command)
    command.add_argument(
        "--orientation-points",
        type=values.chunk,
        default=4096,
        metavar="N",
        help="that decide the sides of a scan without normals (4096; time ~ N^2)",
    )
    _add_alignment(command)


def _add_alignment(command):
    """The options of every command that aligns scans."""
    command.add_argument(
        "--objective",
        choices=("point-to-point", "point-to-plane", "symmetric", "generalized"),
        default="point-to-plane",
    )
    command.add_argument(
        "--kernel",
        choices=("l2", "huber", "cauchy", "geman-mcclure", "tukey", "welsch"),
        default="tukey",
    )
    command.add_argument(
        "--max-correspondence-distance",
        type=values.distance,
        metavar="D",
        help="at the finest level: a length, or 2%% of the target's diagonal",
    )
    command.add_argument(
        "--voxel-size", type=values.positive, metavar="V", help="of the finest level"
    )
    command.add_argument("--with-scale", action="store_true", help="also find a scale")
    command.add_argument(
        "--report", metavar="JSON", help="transforms, errors, statuses"
    )


def _add_fuse(commands):
    command = commands.add_parser(
        "fuse", help="align several scans of one object and make one mesh of them"
    )
    command.add_argument("inputs", nargs="+", metavar="SCAN", help="two or more files")
    command.add_argument(
        "--viewpoint",
        type=float,
        nargs=3,
        metavar=("X", "Y", "Z"),
        help="the scanner, in the frame of every scan (default: not known)",
    )
    command.add_argument(
        "--voxel-size",
        type=values.positive,
        metavar="V",
        help="of the finest level, in the unit of the points (1/160 of a scan)",
    )
    command.add_argument("--seed", type=int, default=0)
    command.add_argument("--poses", metavar="JSON", help="write T_world_scan here")
    _add_surface(command)


def _add_mesh(commands):
    command = commands.add_parser(
        "mesh", help="the surface of a field that a Python script defines"
    )
    command.add_argument(
        "scene", metavar="SCENE.py:NAME", help="a field, or a callable"
    )
    command.add_argument("-o", "--output", required=True, metavar="MESH")
    command.add_argument(
        "--resolution",
        type=values.mesh_resolution,
        default=128,
        metavar="N",
        help="nodes along the longest side (128)",
    )
    command.add_argument(
        "--method",
        choices=(
            "marching-cubes",
            "dual-contouring",
            "dual-marching-cubes",
            "dual-grid",
            "flexicubes",
        ),
        default="marching-cubes",
    )
    command.add_argument(
        "--tolerance",
        type=values.nonnegative,
        default=0.0,
        metavar="T",
        help="dual-contouring, dual-grid: larger faces, up to this error (0: none)",
    )
    command.add_argument(
        "--level", type=values.finite, default=0.0, help="of the field (0)"
    )
    _add_bounds(command)
    command.add_argument("--report", metavar="JSON", help="parameters, sizes, checks")


def _add_bounds(command):
    command.add_argument(
        "--bounds",
        type=values.bounds,
        metavar="XMIN,XMAX,YMIN,YMAX,ZMIN,ZMAX",
        help="the box to look at (default: the field's own; write --bounds=-1,...)",
    )


def _add_info(commands):
    command = commands.add_parser("info", help="what a file holds")
    command.add_argument("input", metavar="FILE")


def _add_pictures(commands):
    for name, what in (("render", "a picture (PNG)"), ("view", "an HTML page")):
        fields = ", or of a field SCENE.py:NAME" if name == "render" else ""
        command = commands.add_parser(name, help=f"{what} of a mesh or cloud{fields}")
        command.add_argument("input", metavar="FILE")
        command.add_argument("-o", "--output", required=True)
        if name == "render":
            _add_bounds(command)
            command.add_argument("--size", type=int, default=800, help="pixels (800)")
            command.add_argument("--azimuth", type=float, default=-60.0)
            command.add_argument("--elevation", type=float, default=20.0)
