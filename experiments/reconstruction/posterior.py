"""What stochastic Poisson reconstruction costs, and how far to trust its intervals.

    python experiments/reconstruction/posterior.py SCAN.ply... [--picture PICTURE.png]

For each oriented scan, 5 000 of its points. First the cost on 64^3 nodes: mean and 32
samples, seconds of the first call and of the next, and the peak memory of the process.
Then calibration, 2 000 points and 40^3 nodes: length, variance and noise are those that
make the normals of 24 held-out points most likely, found by gradient steps; of 200
points that neither has seen, the share whose normal components lie within the 90 %
interval of the prediction (noise included), and the share where the field is zero
within its own 90 % interval. The picture shows a slice: mean, deviation, probability
inside.
"""

import argparse
import pathlib
import resource
import time

import jax
import jax.numpy as jnp
import numpy as np

from jaxgeom import io, learning
from jaxgeom.reconstruction import Matern, stochastic_poisson
from jaxgeom.shapes import Grid, PointCloud

POINTS, TUNED, TESTED, WITHIN = 5000, 24, 200, 1.6449
FEWER = 2000


def load(path):
    """5 000 + 224 points with normals, in units of half the longest side."""
    cloud = io.load_cloud(path)
    points = np.asarray(cloud.points, np.float64)
    center = (points.max(0) + points.min(0)) / 2
    points = (points - center) / np.ptp(points, axis=0).max() * 2
    normals = np.asarray(cloud.normals)
    count = POINTS + TUNED + TESTED
    chosen = np.random.default_rng(0).choice(len(points), count, replace=False)
    return jnp.float32(points[chosen]), jnp.float32(normals[chosen])


def period(n):
    """A grid about the scan, twice as wide."""
    return Grid(jnp.full(3, -2.0), jnp.full(3, 4 / n), (n, n, n))


def log_likelihood(settings, data, key):
    """Minus the mean log density of held-out normals, given the logarithms of the
    length, the variance and the noise."""
    cloud, points, normals = data
    length, variance, noise = jnp.exp(settings)
    found = stochastic_poisson(
        cloud, period(40), kernel=Matern(length), variance=variance, noise=noise
    )
    mean, std = found.normals_at(points)
    total = (std**2 + noise**2)[:, None]
    return jnp.mean((normals - mean) ** 2 / total + jnp.log(total)) / 2


def cost(cloud):
    """Seconds of the first call and the next, and GiB."""
    grid = period(64)

    @jax.jit
    def run(cloud, key):
        found = stochastic_poisson(cloud, grid)
        return found, found.samples(key, 32)

    seconds = []
    for seed in range(2):
        start = time.perf_counter()
        found, samples = jax.block_until_ready(run(cloud, jax.random.key(seed)))
        seconds.append(time.perf_counter() - start)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(
        f"  64^3, mean and 32 samples: {seconds[0]:.1f} s, then {seconds[1]:.1f} s, "
        f"{int(found.steps)} steps, peak {peak:.2f} GiB, {found.result}",
        flush=True,
    )
    return grid, found, samples


def calibration(cloud, points, normals):
    """Tune, then count."""
    tuned = (points[:TUNED], normals[:TUNED])
    start = jnp.log(jnp.array([0.15, 1 / 3, 0.1]))
    out = learning.train(
        start,
        log_likelihood,
        (cloud, *tuned),
        key=jax.random.key(0),
        adam=learning.Adam(num_steps=15, rate=0.25),
    )
    length, variance, noise = jnp.exp(out.model)
    settings = dict(kernel=Matern(length), variance=variance, noise=noise)
    found = stochastic_poisson(cloud, period(40), **settings)
    mean, std = found.normals_at(points[TUNED:])
    gap = jnp.abs(normals[TUNED:] - mean) / jnp.sqrt(std**2 + noise**2)[:, None]
    field = jnp.abs(jax.vmap(found)(points[TUNED:])) / found.std(points[TUNED:])
    print(
        f"  length {length:.3f}, variance {variance:.3f}, noise {noise:.3f}; "
        f"log likelihood {-out.losses[0]:.3f} to {-out.losses[-1]:.3f}; within 90 %: "
        f"normals {float(jnp.mean(gap < WITHIN)):.3f}, "
        f"field {float(jnp.mean(field < WITHIN)):.3f}",
        flush=True,
    )


def picture(path, grid, found, samples):
    """A slice through the middle of the period."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    middle = grid.shape[2] // 2
    std = jnp.std(samples, axis=0)
    inside = jax.scipy.stats.norm.cdf(-found.values / std)
    panels = {"mean": found.values, "deviation": std, "probability inside": inside}
    figure, axes = plt.subplots(1, 3, figsize=(11, 3.4), layout="constrained")
    for ax, (name, values) in zip(axes, panels.items(), strict=True):
        image = ax.imshow(np.asarray(values)[:, :, middle].T, origin="lower")
        ax.contour(np.asarray(found.values)[:, :, middle].T, [0.0], colors="white")
        ax.set_title(name)
        ax.set_axis_off()
        figure.colorbar(image, ax=ax)
    figure.savefig(path, dpi=90)


def main():
    """One paragraph per scan."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scans", nargs="+", type=pathlib.Path)
    parser.add_argument("--picture")
    parser.add_argument("--no-calibration", action="store_true")
    parser.add_argument("--no-cost", action="store_true")
    options = parser.parse_args()
    for path in options.scans:
        print(path.stem, flush=True)
        points, normals = load(path)
        if not options.no_cost:
            found = cost(PointCloud(points[:POINTS], normals[:POINTS]))
            if options.picture:
                picture(options.picture, *found)
        if not options.no_calibration:
            fewer = PointCloud(points[:FEWER], normals[:FEWER])
            calibration(fewer, points[POINTS:], normals[POINTS:])


if __name__ == "__main__":
    main()
