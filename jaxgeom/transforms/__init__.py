"""Maps of space as pytrees that compose with `@`, and the best one between points."""

from ._generalized import GeneralizedFit as GeneralizedFit
from ._generalized import generalized_procrustes as generalized_procrustes
from ._interpolate import interpolate as interpolate
from ._polar import nearest_rotation as nearest_rotation
from ._procrustes import ProcrustesFit as ProcrustesFit
from ._procrustes import procrustes as procrustes
from ._rotations import rotation_exp as rotation_exp
from ._rotations import rotation_log as rotation_log
from ._transforms import Affine as Affine
from ._transforms import Rigid as Rigid
from ._transforms import Similarity as Similarity
