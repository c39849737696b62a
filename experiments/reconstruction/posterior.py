"""What stochastic Poisson reconstruction costs, and how far to trust its intervals.

    python experiments/reconstruction/posterior.py SCAN.ply... [--picture PICTURE.png]

For each oriented scan, 5 000 of its points. First the cost on 64^3 nodes: mean and 32
samples, seconds of the first call and of the next, and the peak memory of the process.
Then calibration, 2 000 points and 40^3 nodes: `tune` chooses length, variance and noise
by 120 held-out points (24 of them in its search); of 200 points that nothing has seen,
the share whose normal components lie within the 90 % interval of the prediction (noise
included), and the share where the field is zero within its own. The same again with the
places of the points believed as far as `calibrate_values` finds by 300 others, and the
share of 800 further points. Then the
networks of `neural_posterior` beside the grid, 2 000 points, kernel of a fifth of the
longest side, 200 random places in a cube 1.2 sides wide. The picture shows a slice:
mean, deviation, probability inside.
"""

import argparse
import pathlib
import resource
import time

import jax
import jax.numpy as jnp
import numpy as np

from jaxgeom import io
from jaxgeom._core import name_of
from jaxgeom.pipelines import neural_posterior
from jaxgeom.reconstruction import (
    Matern,
    calibrate_values,
    stochastic_poisson,
    tune,
)
from jaxgeom.shapes import Grid, PointCloud

POINTS, TUNED, CALIBRATED, TESTED, WITHIN = 5000, 120, 300, 200, 1.6449
FURTHER = 800
FEWER = 2000


def load(path):
    """5 000 + 620 points with normals, in units of half the longest side, and 800 of
    the rest."""
    cloud = io.load_cloud(path)
    points = np.asarray(cloud.points, np.float64)
    center = (points.max(0) + points.min(0)) / 2
    points = (points - center) / np.ptp(points, axis=0).max() * 2
    normals = np.asarray(cloud.normals)
    count = POINTS + TUNED + CALIBRATED + TESTED
    chosen = np.random.default_rng(0).choice(len(points), count, replace=False)
    rest = np.setdiff1d(np.arange(len(points)), chosen)
    rest = np.random.default_rng(1).choice(rest, FURTHER, replace=False)
    return tuple(
        jnp.float32(x) for x in (points[chosen], normals[chosen], points[rest])
    )


def period(n):
    """A grid about the scan, twice as wide."""
    return Grid(jnp.full(3, -2.0), jnp.full(3, 4 / n), (n, n, n))


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


def calibration(cloud, points, normals, further):
    """Tune, calibrate, and count."""
    grid = period(40)
    held_out = PointCloud(points[:TUNED], normals[:TUNED])
    others = PointCloud(points[TUNED:-TESTED], normals[TUNED:-TESTED])
    test = points[-TESTED:], normals[-TESTED:]
    start = time.perf_counter()
    tuned = jax.jit(lambda a, b: tune(a, grid, b, length=0.15))(cloud, held_out)
    settings = jax.block_until_ready(tuned.settings)
    seconds = time.perf_counter() - start
    print(
        f"  length {settings.kernel.length:.3f}, variance {settings.variance:.3f}, "
        f"noise {settings.noise:.3f}, last factor {tuned.widening:.3f}; minus log "
        f"density {tuned.first_loss:.3f} to {tuned.loss:.3f}, {int(tuned.steps)} steps "
        f"in {seconds:.0f} s, {name_of(tuned.result)}; within 90 %: "
        f"{covered(cloud, grid, settings, *test)}",
        flush=True,
    )
    start = time.perf_counter()
    run = jax.jit(lambda s, a, b: calibrate_values(s, a, grid, b))
    found = jax.block_until_ready(run(settings, cloud, others))
    seconds = time.perf_counter() - start
    print(
        f"  value noise {found.settings.value_noise:.4f} in {seconds:.0f} s, "
        f"{name_of(found.result)}; within 90 %: "
        f"{covered(cloud, grid, found.settings, *test)}, of {FURTHER} further points: "
        f"{covered(cloud, grid, found.settings, further)}",
        flush=True,
    )


def covered(cloud, grid, settings, points, normals=None):
    """The shares of normals and of fields within 90 %, noise included, and the root
    mean squares of the field and of its deviation."""
    found = jax.jit(lambda c, s: s(c, grid))(cloud, settings)
    share = lambda x: f"{float(jnp.mean(x < WITHIN)):.3f}"
    rms = lambda x: float(jnp.sqrt(jnp.mean(x**2)))
    said = ""
    if normals is not None:
        mean, std = found.normals_at(points)
        gap = jnp.abs(normals - mean) / jnp.sqrt(std**2 + settings.noise**2)
        said = f"normals {share(gap)}, "
    field, std = jax.vmap(found)(points), found.std(points)
    own = 0 if settings.value_noise is None else settings.value_noise
    level = jnp.abs(field) / jnp.sqrt(std**2 + own**2)
    return (
        f"{said}field {share(level)}; field {rms(field):.4f}, its deviation "
        f"{rms(std):.4f}"
    )


def networks(cloud):
    """Both posteriors of the same scan at the same places."""
    kernel = Matern(0.4)
    start = time.perf_counter()
    found = neural_posterior(
        cloud, key=jax.random.key(0), kernel=kernel, screening=0.01
    )
    trained = time.perf_counter() - start
    places = jax.random.uniform(jax.random.key(1), (200, 3), minval=-1.2, maxval=1.2)
    start = time.perf_counter()
    known = jax.jit(lambda c: stochastic_poisson(c, period(40), kernel=kernel))(cloud)
    std = jax.block_until_ready(known.std(places))
    solved = time.perf_counter() - start
    mean, true = (np.asarray(jax.vmap(f)(places)) for f in (found, known))
    ratio = np.asarray(found.std(places) / std)
    chance = found.probability_inside(places) - known.probability_inside(places)
    low, high = np.quantile(ratio, [0.1, 0.9])
    print(
        f"  networks: {trained:.0f} s, explained {float(found.explained):.2f}, "
        f"{name_of(found.result)}; grid {solved:.0f} s; mean correlated by "
        f"{np.corrcoef(mean, true)[0, 1]:.3f}, apart by "
        f"{np.sqrt(np.mean(((mean - true) / std) ** 2)):.2f} deviations (rms); "
        f"deviations correlated by {np.corrcoef(found.std(places), std)[0, 1]:.3f}, "
        f"ratio {np.median(ratio):.2f} ({low:.2f} to {high:.2f}); probability inside "
        f"apart by {np.abs(chance).mean():.3f} in the mean",
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
    parser.add_argument("--no-networks", action="store_true")
    options = parser.parse_args()
    for path in options.scans:
        print(path.stem, flush=True)
        points, normals, further = load(path)
        if not options.no_cost:
            found = cost(PointCloud(points[:POINTS], normals[:POINTS]))
            if options.picture:
                picture(options.picture, *found)
        if not options.no_calibration:
            fewer = PointCloud(points[:FEWER], normals[:FEWER])
            calibration(fewer, points[POINTS:], normals[POINTS:], further)
        if not options.no_networks:
            networks(PointCloud(points[:FEWER], normals[:FEWER]))


if __name__ == "__main__":
    main()
