"""From a sampled field to a mesh: one signature, one result for all extractors."""

from ._ambiguity import AbstractFaceRule as AbstractFaceRule
from ._ambiguity import AsymptoticDecider as AsymptoticDecider
from ._ambiguity import SeparateInside as SeparateInside
from ._brick_cubes import count_on_bricks as count_on_bricks
from ._brick_cubes import marching_cubes_on_bricks as marching_cubes_on_bricks
from ._classify import Counts as Counts
from ._dual_contouring import DualContouring as DualContouring
from ._dual_contouring import dual_contouring as dual_contouring
from ._dual_marching_cubes import DualMarchingCubes as DualMarchingCubes
from ._dual_marching_cubes import dual_marching_cubes as dual_marching_cubes
from ._extract import extract as extract
from ._extract import pad_outside as pad_outside
from ._extraction import Capacity as Capacity
from ._extraction import Extraction as Extraction
from ._marching_cubes import MarchingCubes as MarchingCubes
from ._marching_cubes import count as count
from ._marching_cubes import marching_cubes as marching_cubes
from ._placement import AbstractPlacement as AbstractPlacement
from ._placement import Cubic as Cubic
from ._placement import Linear as Linear
