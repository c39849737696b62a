"""The fields that are hardest to mesh."""

import numpy as np

SHAPE = (9, 7, 11)


def noise(seed=0, shape=SHAPE, dtype=np.float32):
    return np.random.default_rng(seed).standard_normal(shape).astype(dtype)


def ties(seed=0, shape=SHAPE):
    return np.random.default_rng(seed).integers(-1, 2, shape).astype(np.float32)


def sheets():
    """Walls thinner than a cell, in a general position."""
    x = np.moveaxis(np.indices(SHAPE).astype(np.float32), 0, -1)
    across = x @ np.array([0.31, 0.57, 0.43], np.float32)
    return np.abs(across - np.round(across / 2.5) * 2.5) - 0.2


def blocks(cells):
    """All sign patterns of a block of nodes, with outside nodes around each."""
    n = int(np.prod(cells))
    side = 2 ** (n // 2)
    values = np.ones((side * (cells[0] + 2), side * (cells[1] + 2), cells[2] + 2))
    where = np.arange(n).reshape(cells)
    for pattern in range(2**n):
        x = (cells[0] + 2) * (pattern // side) + 1
        y = (cells[1] + 2) * (pattern % side) + 1
        block = np.where(pattern >> where & 1, -0.7, 0.4)
        values[x : x + cells[0], y : y + cells[1], 1 : 1 + cells[2]] = block
    return values.astype(np.float32)
