"""Draws an alignment before and after, how steps converge, and how far starts reach.

    JAXGEOM_DATA=... python experiments/registration/pictures.py alignment.png

Bunny 045 on 000. Left to right: the source at the mean-aligned start and at the end,
colored by the distance to the nearest target point; the cost above its minimum by step
of four methods, from a start 10 degrees off, at 3 000 points; the share of 12 starts
that end below 1 degree and 1 mm, by how far they are turned, at voxels of 1 mm.
"""

import argparse

import accuracy
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from matplotlib import pyplot
from scipy.spatial import cKDTree

from jaxgeom import PointCloud, Rigid
from jaxgeom.normals import estimate
from jaxgeom.pipelines import MeanAligned, Pyramid, register
from jaxgeom.registration import (
    L2,
    Alternation,
    Anderson,
    GaussNewton,
    Method,
    PointToPlane,
    PointToPoint,
    Symmetric,
    icp,
)

AXES, DRAWN, FARTHEST = 12, 3000, 5.0
ANGLES = (20, 40, 60, 80, 100)


def scene():
    """Source, target (mm) and the true pose, shifts in mm."""
    table = accuracy.scans()
    truth = accuracy.relative("bun000", "bun045")
    truth = accuracy.matrix(truth[:3, :3], 1e3 * truth[:3, 3])
    return 1e3 * table["bun045"], 1e3 * table["bun000"], truth


def draw_points(panel, points, target, title):
    """The points from the front, colored by the distance to the target."""
    apart = cKDTree(target).query(points)[0]
    order = np.argsort(points[:, 2])
    x, y, _ = points[order].T
    kept = dict(s=0.2, c=apart[order], cmap="viridis", vmin=0, vmax=FARTHEST)
    drawn = panel.scatter(x, y, **kept)
    panel.scatter(*target[::7, :2].T, s=0.1, c="0.8", zorder=0)
    panel.set(title=title, aspect="equal", xticks=[], yticks=[])
    return drawn


def before_and_after(panels, source, target):
    """The two pictures of the source."""
    shift = target.mean(axis=0) - source.mean(axis=0)
    found = register(source, target, init=MeanAligned(), throw=False)
    draw_points(panels[0], source + shift, target, "mean-aligned start")
    moved = np.asarray(found.target_from_source(source))
    drawn = draw_points(panels[1], moved, target, "registered")
    panels[1].figure.colorbar(drawn, ax=panels[:2], label="mm to the target")


def convergence(panel, source, target, truth):
    """Costs by step, above the least one."""
    rng = np.random.default_rng(0)
    start = accuracy.turned(
        *(truth, accuracy.directions(1, 0)[0], 10, np.zeros(3), source.mean(axis=0))
    )
    thin = lambda x: PointCloud(jnp.asarray(x[rng.permutation(len(x))[:DRAWN]]))
    clouds = [eqx.filter_jit(estimate)(thin(x)) for x in (source, target)]
    methods = {
        "points, alternation": (PointToPoint(), Alternation()),
        "points, Anderson": (PointToPoint(), Anderson()),
        "planes, Gauss-Newton": (PointToPlane(), GaussNewton()),
        "symmetric, Gauss-Newton": (Symmetric(), GaussNewton()),
    }
    init = Rigid(jnp.asarray(start[:3, :3]), jnp.asarray(start[:3, 3]))
    for name, (objective, solver) in methods.items():
        method = Method(objective=objective, kernel=L2(), solver=solver)
        given = dict(method=method, max_distance=10.0, max_steps=150, history=True)
        found = eqx.filter_jit(icp)(*clouds, init=init, rtol=1e-9, **given)
        costs = np.asarray(found.history)
        costs = costs[np.isfinite(costs)]
        above = (costs - costs.min()) / costs[0]
        panel.semilogy(np.where(above > 0, above, np.nan), label=name)
    panel.set(title="cost above its minimum", xlabel="step", ylim=(1e-9, 2))
    panel.legend(fontsize=7)


def basin(panel, source, target, truth):
    """The share of good ends by the angle of the start."""
    center, n = source.mean(axis=0), AXES
    axes, shifts = accuracy.directions(n, 0), 5 * accuracy.directions(n, 1)
    pyramids = {
        "register": Pyramid(),
        "points to points": Pyramid(method=Method(objective=PointToPoint())),
        "one level": Pyramid(voxels=(0.5,), gates=(30.0,)),
    }
    for name, pyramid in pyramids.items():
        shares = []
        for degrees in ANGLES:
            good = 0
            for axis, shift in zip(axes, shifts, strict=True):
                start = accuracy.turned(truth, axis, degrees, shift, center)
                found = register(
                    *(source, target),
                    init=Rigid(start[:3, :3], start[:3, 3]),
                    voxel_size=1.0,
                    pyramid=pyramid,
                    throw=False,
                )
                turn, off = accuracy.errors(found.target_from_source, truth, source)
                good += (turn < 1) & (off < 1)
            shares.append(good / n)
            print(f"{name:20} {degrees:4} deg {good}/{n}", flush=True)
        panel.plot(ANGLES, shares, "o-", label=name)
    panel.set(title="starts that succeed", xlabel="degrees off", ylim=(-0.05, 1.05))
    panel.legend(fontsize=7)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("output")
    output = parser.parse_args().output
    source, target, truth = scene()
    figure, panels = pyplot.subplots(1, 4, figsize=(15, 3.8), layout="constrained")
    before_and_after(panels, source, target)
    with jax.enable_x64(True):
        convergence(panels[2], source, target, truth)
    basin(panels[3], source, target, truth)
    figure.savefig(output, dpi=110)


if __name__ == "__main__":
    main()
