"""Subdivision curves and surfaces as sparse linear operators."""

from ._creases import AbstractDecay as AbstractDecay
from ._creases import ChaikinDecay as ChaikinDecay
from ._creases import Creases as Creases
from ._creases import UniformDecay as UniformDecay
from ._limit import Limit as Limit
from ._limit import limit as limit
from ._operator import Refinement as Refinement
from ._schemes import AbstractLoopWeights as AbstractLoopWeights
from ._schemes import AbstractScheme as AbstractScheme
from ._schemes import Bilinear as Bilinear
from ._schemes import CatmullClark as CatmullClark
from ._schemes import Loop as Loop
from ._schemes import Midpoint as Midpoint
from ._schemes import Original as Original
from ._schemes import Warren as Warren
from ._subdivide import Subdivided as Subdivided
from ._subdivide import SubdivisionPlan as SubdivisionPlan
from ._subdivide import plan_subdivision as plan_subdivision
from ._subdivide import subdivide as subdivide
