"""How the cost at fixed pairs is made smaller: one step of an alignment."""

from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, PyTree

from .._core import GeometryError, message
from ..transforms import Affine, Rigid, Similarity, procrustes
from ._models import RigidModel, SimilarityModel
from ._objectives import PointToPoint
from ._problem import Problem

_MOST_DAMPING = 1e6


class Step(eqx.Module):
    """A move of the source about the center of the target, and what is remembered.

    `stuck` where no move was found although the cost could be much lower.
    """

    transform: Rigid | Similarity | Affine
    memory: PyTree
    stuck: Bool[Array, ""]


class AbstractSolver(eqx.Module):
    """The choice of a solver for the problem between two searches for pairs."""

    @abstractmethod
    def start(self, size: int, dtype) -> PyTree:
        """What the first step remembers, for steps of `size` coordinates."""

    @abstractmethod
    def step(self, problem: Problem, memory: PyTree) -> Step:
        """The move that makes the cost at the given pairs smaller."""

    @abstractmethod
    def validate(self, objective, model) -> None:
        """Raise `GeometryError` for what the solver cannot do."""


class GaussNewton(AbstractSolver):
    """(H + damping diag H) z = -g with the weights rho' of the robust kernel.

    H = sum w J^T J is summed as one product of an array [k+1, n] with its transpose,
    and solved by Cholesky.
    """

    damping: float = 1e-6

    def start(self, size, dtype):
        return None

    def validate(self, objective, model):
        pass

    def step(self, problem, memory):
        z = _damped(problem.normal_equations(), self.damping)
        return _step(problem, z, memory)


class LevenbergMarquardt(AbstractSolver):
    """Gauss-Newton steps whose damping grows until the cost at the pairs falls.

    A step that raises the cost is not taken, and the next one is damped `factor` times
    more; after a good one the damping falls as much, not below `least`.
    """

    least: float = 1e-6
    factor: float = 10.0

    def start(self, size, dtype):
        return jnp.asarray(self.least, dtype)

    def validate(self, objective, model):
        pass

    def step(self, problem, memory):
        equations = problem.normal_equations()

        def attempt(carry):
            _, damping, _ = carry
            z = _damped(equations, damping)
            worse = ~(problem.energy(z) <= equations.energy * (1 + _slack(z)))
            return z, jnp.where(worse, self.factor * damping, damping), worse

        going = lambda carry: carry[2] & (carry[1] < _MOST_DAMPING)
        zero = jnp.zeros_like(equations.gradient)
        z, damping, worse = jax.lax.while_loop(
            going, attempt, (zero, memory, jnp.asarray(True))
        )
        z = jnp.where(worse, 0, z)
        damping = jnp.maximum(damping / self.factor, self.least)
        return _step(problem, z, damping)


class Alternation(AbstractSolver):
    """The closed-form Procrustes fit to the pairs, with the weights rho'.

    For `PointToPoint` and rigid or similarity models without locked directions.
    """

    def start(self, size, dtype):
        return None

    def validate(self, objective, model):
        free = model.basis is None and model.prior is None
        kind = isinstance(model, RigidModel | SimilarityModel)
        if not (isinstance(objective, PointToPoint) and free and kind):
            raise GeometryError(
                message(
                    "Alternation fits points to points with a free rigid or "
                    "similarity model",
                    f"{type(objective).__name__} with {type(model).__name__}",
                    "Use GaussNewton or LevenbergMarquardt.",
                )
            )

    def step(self, problem, memory):
        zero = jnp.zeros(problem.size, problem.points.dtype)
        weights = problem.robust_weights(problem.residuals(zero))
        fit = procrustes(
            problem.points.T,
            problem.there.T,
            weights,
            scaling=isinstance(problem.model, SimilarityModel),
        )
        return Step(fit.transform, memory, jnp.asarray(False))


class LeastSquares(AbstractSolver):
    """Any least-squares solver of optimistix on the rows sqrt(w rho(s) / s) r.

    Such as `optimistix.Dogleg(rtol=1e-6, atol=1e-6)`.
    """

    solver: optx.AbstractLeastSquaresSolver
    max_steps: int = 8

    def start(self, size, dtype):
        return None

    def validate(self, objective, model):
        pass

    def step(self, problem, memory):
        zero = jnp.zeros(problem.size, problem.points.dtype)
        found = optx.least_squares(
            lambda z, problem: problem.rescaled(z),
            *(self.solver, zero, problem),
            max_steps=self.max_steps,
            throw=False,
        )
        return _unless_worse(problem, found.value, memory)


class Minimise(AbstractSolver):
    """Any minimiser of optimistix on the cost, in units of the cost at the start.

    Such as `optimistix.BFGS(rtol=1e-6, atol=1e-6)` or `optimistix.GradientDescent`.
    """

    solver: optx.AbstractMinimiser
    max_steps: int = 32

    def start(self, size, dtype):
        return None

    def validate(self, objective, model):
        pass

    def step(self, problem, memory):
        zero = jnp.zeros(problem.size, problem.points.dtype)
        # The trace of H makes steps of order one out of slopes in any unit.
        unit = jnp.trace(problem.normal_equations().matrix) / problem.size
        unit = jnp.where(unit > 0, unit, 1)
        found = optx.minimise(
            lambda z, problem: problem.energy(z) / unit,
            *(self.solver, zero, problem),
            max_steps=self.max_steps,
            throw=False,
        )
        return _unless_worse(problem, found.value, memory)


def _step(problem, z, memory, stuck=False) -> Step:
    move = problem.model.exp(problem.tangent.basis @ z)
    return Step(move, memory, jnp.asarray(stuck))


def _unless_worse(problem, z, memory) -> Step:
    """A solver cut short may end anywhere: only a move that lowers the cost is made.

    It is stuck where there is none, but Gauss-Newton would go farther than the rounding
    of the cost can hide.
    """
    zero = jnp.zeros_like(z)
    better = problem.energy(z) < problem.energy(zero)
    ahead = _damped(problem.normal_equations(), jnp.finfo(z.dtype).eps)
    far = jnp.max(jnp.abs(ahead)) > 4 * jnp.finfo(z.dtype).eps ** (1 / 2)
    return _step(problem, jnp.where(better, z, zero), memory, ~better & far)


def _slack(z):
    """The relative rounding of a sum over all pairs."""
    return 64 * jnp.finfo(z.dtype).eps


def _damped(equations, damping):
    """The damped step; directions that no pair speaks of stay still."""
    diagonal = jnp.diagonal(equations.matrix)
    peak = jnp.max(diagonal)
    eps = jnp.finfo(diagonal.dtype).eps
    # Below rounding a pivot could turn negative.
    floor = jnp.where(peak > 0, 16 * eps * peak, 1)
    lifted = equations.matrix + jnp.diag(damping * diagonal + floor)
    factor = jax.scipy.linalg.cho_factor(lifted, lower=True)
    z = -jax.scipy.linalg.cho_solve(factor, equations.gradient)
    return jnp.where(jnp.all(jnp.isfinite(z)), z, 0)
