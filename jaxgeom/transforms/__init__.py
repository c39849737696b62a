"""Rigid, similarity and affine maps of space, as pytrees that compose with `@`."""

from ._rotations import rotation_exp as rotation_exp
from ._rotations import rotation_log as rotation_log
from ._transforms import Affine as Affine
from ._transforms import Rigid as Rigid
from ._transforms import Similarity as Similarity
