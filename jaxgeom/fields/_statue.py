"""The statue: a pretty body of blended primitives for demonstrations and tests."""

import math

from ..transforms import rotation_exp
from ._field import AbstractField
from ._parameters import vector
from ._primitives import Capsule, Cylinder, Ellipsoid, Sphere, Torus


def demo_statue() -> AbstractField:
    """A robed figure on a pedestal, a ring in one hand and an orb in the other.

    One connected body of genus 1 (the ring), 14 primitives, within [-1, 1]^3; z is up
    and it faces -y. A lower bound of the distance.
    """
    figure = _robe().blend(_head(), 0.08).blend(_arms(), 0.1)
    return _pedestal().blend(figure, 0.1)


def _pedestal():
    foot = Cylinder(0.46, 0.03, (0, 0, -0.91)).offset(0.03)
    plinth = Cylinder(0.33, 0.05, (0, 0, -0.80)).offset(0.02)
    return foot.blend(plinth, 0.04)


def _robe():
    skirt = Ellipsoid((0.28, 0.24, 0.48), (0, 0, -0.44))
    torso = Ellipsoid((0.165, 0.13, 0.27), (0, 0, 0.13))
    shoulders = Capsule((-0.17, 0, 0.27), (0.17, 0, 0.27), 0.07)
    return skirt.blend(torso, 0.12).blend(shoulders, 0.15)


def _head():
    neck = Capsule((0, 0, 0.30), (0, -0.01, 0.46), 0.055)
    head = Ellipsoid((0.105, 0.12, 0.14), (0, -0.02, 0.58))
    bun = Sphere(0.07, (0, 0.11, 0.65))
    return neck.blend(head, 0.08).blend(bun, 0.05)


def _arms():
    upper = Capsule((0.19, 0, 0.27), (0.40, -0.06, 0.30), 0.06)
    lower = Capsule((0.40, -0.06, 0.30), (0.42, -0.12, 0.57), 0.048)
    upright = rotation_exp(vector("turn")((math.pi / 2, 0, 0)))
    ring = Torus(0.15, 0.036).rotate(upright).translate((0.42, -0.13, 0.76))
    raised = upper.blend(lower, 0.08).blend(ring, 0.06)
    hanging = Capsule((-0.20, 0, 0.26), (-0.37, -0.05, 0.03), 0.06)
    forearm = Capsule((-0.37, -0.05, 0.03), (-0.40, -0.28, 0.05), 0.048)
    orb = Sphere(0.095, (-0.40, -0.34, 0.13))
    held = hanging.blend(forearm, 0.08).blend(orb, 0.04)
    return raised | held
