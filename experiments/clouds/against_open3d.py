"""The same points kept as by Open3D, and how long it takes (CPU).

    python experiments/clouds/against_open3d.py DATA/registration/small_gicp/target.ply

Voxel means, statistical and radius outliers, farthest points, boxes and a plane of one
cloud. Open3D puts its voxels half a voxel below the bounding box, and counts a point
among its own neighbors: the settings below say the same in both. Medians of 5 runs in
one process, in ms, after compilation.
"""

import argparse
import time

import jax
import jax.numpy as jnp
import numpy as np
import open3d as o3d

from jaxgeom import PointCloud, clouds, io


def timed(job):
    """The result and the median time in ms."""
    times = []
    for _ in range(6):
        start = time.perf_counter()
        out = jax.block_until_ready(job())
        times.append(time.perf_counter() - start)
    return out, 1e3 * float(np.median(times[1:]))


def line(name, ours, theirs, note):
    """One row."""
    ratio = ours / theirs
    print(f"{name:18s} {ours:8.1f} {theirs:8.1f} {ratio:6.2f}  {note}", flush=True)


def run(path):
    """The table of one cloud."""
    points = np.asarray(io.load_cloud(path).points, np.float32)
    cloud = PointCloud(jnp.asarray(points))
    peer = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points.astype(float)))
    size = float(np.ptp(points, axis=0).max()) / 100
    print(f"{path.split('/')[-1]}: {len(points)} points, voxel {size:.4g}")
    print("what                   ours   Open3D  ratio  points kept by ours, Open3D")
    origin = jnp.asarray(points.min(axis=0) - np.float32(size / 2))
    voxels = jax.jit(lambda c: clouds.voxel_downsample(c, size, origin=origin))
    ours, t = timed(lambda: voxels(cloud))
    theirs, s = timed(lambda: peer.voxel_down_sample(size))
    line("voxels", t, s, f"{int(ours.required_points)}, {len(theirs.points)}")
    stat = jax.jit(lambda c: clouds.statistical_inliers(c, k=19, ratio=2.0))
    ours, t = timed(lambda: stat(cloud))
    (_, rows), s = timed(lambda: peer.remove_statistical_outlier(20, 2.0))
    same = (
        int((np.flatnonzero(ours) == np.sort(rows)).sum())
        if int(ours.sum()) == len(rows)
        else -1
    )
    line("statistical", t, s, f"{int(ours.sum())}, {len(rows)}; same {same}")
    near = jax.jit(lambda c: clouds.radius_inliers(c, size, least=16))
    ours, t = timed(lambda: near(cloud))
    (_, rows), s = timed(lambda: peer.remove_radius_outlier(16, size))
    differ = np.setxor1d(np.flatnonzero(ours), rows).size
    line("radius", t, s, f"{int(ours.sum())}, {len(rows)}; differ in {differ}")
    far = jax.jit(lambda c: clouds.farthest_points(c, 500).points)
    ours, t = timed(lambda: far(cloud))
    theirs, s = timed(lambda: peer.farthest_point_down_sample(500))
    cover = lambda x: np.max(
        o3d.geometry.PointCloud(peer).compute_point_cloud_distance(
            o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.asarray(x, float)))
        )
    )
    line("farthest 500", t, s, f"cover {cover(ours):.4g}, {cover(theirs.points):.4g}")
    box = jax.jit(clouds.oriented_box)
    ours, t = timed(lambda: box(cloud))
    theirs, s = timed(lambda: peer.get_minimal_oriented_bounding_box())
    line("box", t, s, f"volume {float(ours.volume):.5g}, {theirs.volume():.5g}")
    plane = jax.jit(lambda c, k: clouds.fit_primitive(c, threshold=size / 2, key=k))
    ours, t = timed(lambda: plane(cloud, jax.random.key(0)))
    (_, rows), s = timed(lambda: peer.segment_plane(size / 2, 3, 512))
    line("plane, 512 tries", t, s, f"{int(ours.num_inliers)}, {len(rows)}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("clouds", nargs="+")
    for each in parser.parse_args().clouds:
        run(each)
