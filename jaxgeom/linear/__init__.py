"""The linear layer of all grid methods: interpolation, stencils, solvers."""

from ._cg import LinearSolution as LinearSolution
from ._cg import conjugate_gradients as conjugate_gradients
from ._cg import iterate as iterate
from ._cosine import CosineTransform as CosineTransform
from ._cosine import cosine_solve as cosine_solve
from ._interpolation import interpolate as interpolate
from ._interpolation import splat as splat
from ._interpolation import splat_gradient as splat_gradient
from ._multigrid import Multigrid as Multigrid
from ._nystrom import Nystrom as Nystrom
from ._slab_solvers import SlabCosine as SlabCosine
from ._slab_solvers import SlabMultigrid as SlabMultigrid
from ._slab_solvers import solve_in_slabs as solve_in_slabs
from ._stencils import laplacian as laplacian
from ._stencils import laplacian_diagonal as laplacian_diagonal
from ._stencils import smooth as smooth
from ._transfer import coarse_shape as coarse_shape
from ._transfer import prolong as prolong
from ._transfer import restrict as restrict
