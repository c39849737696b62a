"""Faces with any number of corners, as triangles."""

import numpy as np


def fan(sizes: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Triangles (first, i, i + 1) of each polygon, in the order of the file.

    `sizes` [p] are the corner counts; `corners` holds the polygons one after another.
    Polygons of fewer than three corners give no triangle.
    """
    sizes = np.asarray(sizes, np.int64)
    first = np.cumsum(sizes) - sizes
    count = np.maximum(sizes - 2, 0)
    polygon = np.repeat(np.arange(len(sizes)), count)
    step = np.arange(len(polygon)) - np.repeat(np.cumsum(count) - count, count)
    start = first[polygon]
    picks = np.stack([start, start + step + 1, start + step + 2], axis=1)
    return np.asarray(corners, np.int64)[picks]


def merge_equal(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The distinct rows in order of appearance, and the row of each input."""
    # -0.0 and 0.0 are one place but two bit patterns.
    _, first, inverse = np.unique(
        points + 0.0, axis=0, return_index=True, return_inverse=True
    )
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return points[first[order]], rank[inverse.reshape(-1)]
