"""From oriented points to a scalar field whose level set is the surface."""

from ._boundary import Dirichlet as Dirichlet
from ._boundary import Envelope as Envelope
from ._boundary import Neumann as Neumann
from ._density import SampleGeometry as SampleGeometry
from ._density import sample_geometry as sample_geometry
from ._kernels import AbstractKernel as AbstractKernel
from ._kernels import Matern as Matern
from ._kernels import SquaredExponential as SquaredExponential
from ._poisson import Poisson as Poisson
from ._poisson import ScreenedPoisson as ScreenedPoisson
from ._poisson import poisson as poisson
from ._poisson import screened_poisson as screened_poisson
from ._solution import FieldSolution as FieldSolution
from ._solution import PoissonStats as PoissonStats
from ._spread import spread as spread
from ._ssd import SSD as SSD
from ._stochastic import Posterior as Posterior
from ._stochastic import StochasticPoisson as StochasticPoisson
from ._stochastic import probability_hit as probability_hit
from ._stochastic import stochastic_poisson as stochastic_poisson
from ._stochastic import view_score as view_score
from ._support import face_probability as face_probability
from ._wavelet import Wavelet as Wavelet
