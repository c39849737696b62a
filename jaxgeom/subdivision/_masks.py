"""Limit masks: left eigenvectors of one level on the neighborhood of a vertex (host).

The neighborhood of a vertex P: its neighbors Q_0, Q_1, ... along edges, counter-
clockwise, and for quadrilaterals the corner F_i opposite to P between Q_i and Q_i+1.
"""

import abc

import equinox as eqx
import numpy as np

from ._schemes import AbstractLoopWeights


class AbstractMasks(eqx.Module):
    """The masks of one scheme; those of a border and a crease are a cubic spline's."""

    @abc.abstractmethod
    def smooth(self, n):
        """The weights of P, each Q and each F in the limit; n edges, no crease."""

    @abc.abstractmethod
    def ring(self, n):
        """The weight of Q_i in the tangent, times cos(2 pi i / n), that of F being 1.

        F_i has cos(2 pi i / n) + cos(2 pi (i + 1) / n); likewise with sines.
        """

    @abc.abstractmethod
    def across(self, k, i):
        """The tangent away from a crease, over k faces: P, Q_0 = Q_k, Q_i, F_i."""

    @abc.abstractmethod
    def dart(self, n):
        """One level around the end of a crease along Q_0: rows and columns P, Q, F."""

    @abc.abstractmethod
    def tip(self, corner):
        """The corner of the next level at the same vertex in the same face."""

    @property
    @abc.abstractmethod
    def has_faces(self) -> bool:
        """Whether F has weights."""

    @abc.abstractmethod
    def takes(self, sizes) -> bool:
        """Whether the masks hold for faces of these numbers of corners."""


class LoopMasks(AbstractMasks):
    """Loop's scheme. F has no weight."""

    weights: AbstractLoopWeights

    def smooth(self, n):
        """1 - n w, w, 0 with w = 1 / (n + 3 / (8 beta))."""
        w = 1 / (n + 3 / (8 * self.weights(n)))
        return 1 - n * w, w, np.zeros_like(w)

    def ring(self, n):
        """1; without F."""
        return np.ones(np.shape(n))

    def across(self, k, i):
        """sin(i pi / k) for Q_i; the rest makes it an eigenvector, sum zero."""
        angle = np.pi / k
        half = np.where(k == 1, 1, 1 / np.tan(angle / 2))
        end = -half * np.cos(angle) / (1 + 2 * np.cos(angle))
        own = -half / (1 + 2 * np.cos(angle))
        end, own = np.where(k == 1, 1, end), np.where(k == 1, -2, own)
        return own, end, np.sin(i * angle), np.zeros(np.shape(i))

    def dart(self, n):
        """Rows P, Q_0 (a middle), Q_1, ..."""
        beta = float(self.weights(np.float64(n)))
        a = np.zeros((n + 1, n + 1))
        a[0] = [1 - n * beta, *[beta] * n]
        a[1, [0, 1]] = 0.5
        for i in range(1, n):
            a[1 + i, [0, 1 + i]] = 3 / 8
            for other in (i - 1, i + 1):
                a[1 + i, 1 + other % n] += 1 / 8
        return a

    def tip(self, corner):
        """Corner 0 of the child at the corner."""
        return 3 * (corner + corner // 3)

    @property
    def has_faces(self):
        """No."""
        return False

    def takes(self, sizes):
        """Always: there are only triangles."""
        return True


class CatmullClarkMasks(AbstractMasks):
    """Catmull and Clark's scheme on quadrilaterals."""

    def smooth(self, n):
        """n^2, 4, 1 over n (n + 5)."""
        total = n * (n + 5.0)
        return n**2 / total, 4 / total, 1 / total

    def ring(self, n):
        """1 + cos a + cos(a / 2) sqrt(2 (9 + cos a)) with a = 2 pi / n."""
        a = 2 * np.pi / n
        return 1 + np.cos(a) + np.cos(a / 2) * np.sqrt(2 * (9 + np.cos(a)))

    def across(self, k, i):
        """As in a ring of 2 k faces; the rest makes it an eigenvector, sum zero."""
        angle = np.pi / k
        edge, half = self.ring(2 * k), 1 / np.tan(angle / 2)
        end = ((4 + edge) * np.sin(angle) - 2 * (edge + 2) * half) / edge
        own = -2 * end - (edge + 2) * half
        end, own = np.where(k == 1, 1, end), np.where(k == 1, -2, own)
        face = np.sin(i * angle) + np.sin((i + 1) * angle)
        return own, end, edge * np.sin(i * angle), np.where(k == 1, 0, face)

    def dart(self, n):
        """Rows P, Q_0 (a middle), Q_1, ..., F_0, ..."""
        a = np.zeros((2 * n + 1, 2 * n + 1))
        faces = a[n + 1 :]
        for i in range(n):
            faces[i, [0, 1 + i, n + 1 + i]] += 1 / 4
            faces[i, 1 + (i + 1) % n] += 1 / 4
        a[0, 0] = (n - 2) / n
        a[0, 1 : n + 1] = 1 / n**2
        a[0] += faces.sum(axis=0) / n**2
        a[1, [0, 1]] = 0.5
        for i in range(1, n):
            a[1 + i] = (faces[i] + faces[i - 1]) / 4
            a[1 + i, [0, 1 + i]] += 1 / 4
        return a

    def tip(self, corner):
        """Corner 0 of the child at the corner."""
        return 4 * corner

    @property
    def has_faces(self):
        """Yes."""
        return True

    def takes(self, sizes):
        """Only quadrilaterals."""
        return bool(np.all(sizes == 4))


def dart_masks(masks: AbstractMasks, n: int):
    """The limit and the tangent along the crease at its end: two rows P, Q, F.

    The left eigenvectors, symmetric about the crease, of the two largest eigenvalues.
    The other tangent has the sines of a smooth vertex, for which Q_0 has no weight.
    """
    a = masks.dart(n)
    i = np.arange(n)
    order = np.concatenate([[0], 1 + -i % n, n + n - i])[: len(a)]
    symmetric = (a + a[:, order]) / 2
    values, vectors = np.linalg.eig(symmetric.T)
    largest = np.argsort(-values.real)[:2]
    position, tangent = vectors[:, largest].real.T
    position = position / position.sum()
    sign = np.sign(tangent[1 : n + 1] @ np.cos(2 * np.pi * i / n))
    return position, sign * tangent
