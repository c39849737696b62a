"""From oriented points to a scalar field whose level set is the surface."""

from ._boundary import Dirichlet as Dirichlet
from ._boundary import Envelope as Envelope
from ._boundary import Neumann as Neumann
from ._density import SampleGeometry as SampleGeometry
from ._density import sample_geometry as sample_geometry
from ._poisson import Poisson as Poisson
from ._poisson import ScreenedPoisson as ScreenedPoisson
from ._poisson import poisson as poisson
from ._poisson import screened_poisson as screened_poisson
from ._solution import FieldSolution as FieldSolution
from ._solution import PoissonStats as PoissonStats
from ._spread import spread as spread
