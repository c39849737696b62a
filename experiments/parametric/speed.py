"""NURBS against geomdl: points and derivatives of a bicubic 8 x 8 net.

python experiments/parametric/speed.py [points] [repeats]

Both run in double precision in this process, in turn; printed are the medians and their
ratio. geomdl derivatives are those it gives: all d^(k+l) up to k + l = 2.
"""

import statistics
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
from geomdl import NURBS, BSpline

from jaxgeom import parametric as jp

jax.config.update("jax_enable_x64", True)


def shapes(rational):
    """The same surface here and in geomdl."""
    generator = np.random.default_rng(0)
    u, v = np.meshgrid(np.linspace(0, 1, 8), np.linspace(0, 1, 8), indexing="ij")
    control = np.stack([u, v, 0.2 * generator.normal(size=(8, 8))], axis=-1)
    weights = generator.uniform(0.5, 2, (8, 8)) if rational else np.ones((8, 8))
    basis = jp.SplineBasis.clamped(8, 3)
    ours = jp.NurbsSurface(control, (basis, basis), weights)
    theirs = (NURBS if rational else BSpline).Surface()
    theirs.degree_u = theirs.degree_v = 3
    if rational:
        lifted = np.concatenate([control * weights[..., None], weights[..., None]], -1)
        theirs.set_ctrlpts(lifted.reshape(-1, 4).tolist(), 8, 8)
    else:
        theirs.set_ctrlpts(control.reshape(-1, 3).tolist(), 8, 8)
    theirs.knotvector_u = theirs.knotvector_v = list(basis.knots)
    return ours, theirs


def seconds(run):
    start = time.perf_counter()
    run()
    return time.perf_counter() - start


def compare(name, ours, theirs, gap, repeats):
    """Alternate both; print medians, ratio and the largest difference."""
    first = seconds(ours)
    pairs = [(seconds(ours), seconds(theirs)) for _ in range(repeats)]
    here, there = (statistics.median(side) for side in zip(*pairs, strict=True))
    least = min(b / a for a, b in pairs)
    worst = np.max(gap())
    print(
        f"| {name} | {first:.2f} s | {1e3 * here:.2f} ms | {1e3 * there:.1f} ms |"
        f" {there / here:.0f} | {least:.0f} | {worst:.1e} |",
        flush=True,
    )


def main(number=10_000, repeats=9):
    """Print the table."""
    uv = np.random.default_rng(1).uniform(size=(number, 2))
    places, given = jnp.asarray(uv), uv.tolist()
    print("| work | first call | jaxgeom | geomdl | ratio | least | difference |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for rational in (False, True):
        kind = "rational" if rational else "polynomial"
        ours, theirs = shapes(rational)
        check_points(kind, ours, theirs, places, given, repeats)
        few = max(number // 10, 1)
        check_derivatives(kind, ours, theirs, places[:few], given[:few], repeats)


def check_points(kind, ours, theirs, places, given, repeats):
    """Points alone."""
    points = jax.jit(jax.vmap(ours))
    here = lambda: points(places).block_until_ready()
    there = lambda: theirs.evaluate_list(given)
    name = f"{len(given)} points, {kind}"
    compare(name, here, there, lambda: np.abs(np.subtract(here(), there())), repeats)


def check_derivatives(kind, ours, theirs, places, given, repeats):
    """Points with all derivatives up to order 2."""
    table = jax.jit(jax.vmap(lambda x: ours.derivatives(x, 2)))
    here = lambda: table(places).block_until_ready()
    there = lambda: [theirs.derivatives(u, v, 2) for u, v in given]

    def gap():
        exact, rows = np.asarray(here()), there()
        both = [(k, m) for k in range(3) for m in range(3 - k)]
        return [np.abs(exact[:, k, m] - [r[k][m] for r in rows]) for k, m in both]

    compare(f"order 2 at {len(given)} points, {kind}", here, there, gap, repeats)


if __name__ == "__main__":
    main(*(int(x) for x in sys.argv[1:]))
