"""FPFH against Open3D's on the same points, normals and neighborhoods.

    JAXGEOM_DATA=... python experiments/registration/features.py

Prints the largest and the mean difference of a feature entry (each group of eleven adds
up to 200), the share of points whose nearest feature of another scan is the same for
both, and the ratio of the medians of the times in turns. A pair whose angle lies on the
border of two bins may fall to either side, so a few entries differ. Needs Open3D.
"""

import os
import pathlib
import time

import jax
import numpy as np
import open3d as o3d
from scipy.spatial import cKDTree

from jaxgeom import PointCloud
from jaxgeom.normals import estimate, orient_toward_viewpoint
from jaxgeom.registration import fpfh

RADIUS, K = 0.02, 64


def scan(name):
    """Every eighth point of a scan with normals that face the scanner."""
    folder = pathlib.Path(os.environ["JAXGEOM_DATA"]) / "registration/stanford_bunny"
    points = np.load(folder / "bunny_scans.npz")[f"{name}_xyz"][::8]
    far = np.array([0, 0, 10], np.float32)
    return orient_toward_viewpoint(estimate(PointCloud(points), k=16), far)


def theirs(cloud):
    """Open3D's features: K neighbors and the point itself within RADIUS."""
    copy = o3d.geometry.PointCloud()
    copy.points = o3d.utility.Vector3dVector(np.asarray(cloud.points, float))
    copy.normals = o3d.utility.Vector3dVector(np.asarray(cloud.normals, float))
    search = o3d.geometry.KDTreeSearchParamHybrid(radius=RADIUS, max_nn=K + 1)
    features = o3d.pipelines.registration.compute_fpfh_feature(copy, search)
    return np.asarray(features.data).T


def main():
    """The comparison."""
    ours = jax.jit(lambda cloud: fpfh(cloud, radius=RADIUS, k=K))
    clouds = [scan("bun000"), scan("bun045")]
    a = [np.asarray(ours(cloud)) for cloud in clouds]
    b = [theirs(cloud) for cloud in clouds]
    gap = np.abs(a[0] - b[0])
    print(
        f"{len(a[0])} points: largest difference {gap.max():.3f}, mean {gap.mean():.5f}"
    )
    print(f"entries off by more than 0.1: {100 * np.mean(gap > 0.1):.2f} %")
    match = [cKDTree(f[1]).query(f[0])[1] for f in (a, b)]
    print(f"same nearest feature: {100 * np.mean(match[0] == match[1]):.1f} %")
    times = {"ours": [], "theirs": []}
    for _ in range(7):
        for name, call in (("ours", ours), ("theirs", theirs)):
            begin = time.perf_counter()
            jax.block_until_ready(call(clouds[0]))
            times[name].append(time.perf_counter() - begin)
    ms = {name: 1e3 * np.median(row) for name, row in times.items()}
    print(f"ours {ms['ours']:.0f} ms, Open3D {ms['theirs']:.0f} ms (all threads)")
    print(f"ratio {ms['ours'] / ms['theirs']:.2f}")


if __name__ == "__main__":
    main()
