"""Normals of point clouds: estimation, noise, orientation."""

from ._consistency import AbstractOrientation as AbstractOrientation
from ._consistency import LocalPlanes as LocalPlanes
from ._consistency import Oriented as Oriented
from ._consistency import WindingConsistency as WindingConsistency
from ._estimate import estimate as estimate
from ._estimate import plane_residual as plane_residual
from ._orient import orient_consistently as orient_consistently
from ._orient import orient_toward_viewpoint as orient_toward_viewpoint
