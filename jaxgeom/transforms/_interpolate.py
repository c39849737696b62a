"""The straight path between two transforms."""

from jaxtyping import Array, Float

from .._core import GeometryError, message
from ._transforms import AbstractTransform


def interpolate(
    a: AbstractTransform, b: AbstractTransform, t: Float[Array, ""] | float
) -> AbstractTransform:
    """The transform at time t on the geodesic from `a` (t = 0) to `b` (t = 1).

    a exp(t log(a^-1 b)): a screw motion at constant speed for `Rigid`, with a scale
    that grows exponentially for `Similarity`. It does not depend on the coordinates:
    interpolate(c a, c b, t) = c interpolate(a, b, t). Any t is allowed; outside [0, 1]
    the motion goes on. For `Affine` the logarithm is computed on the host (see
    `Affine.log`). Raises `GeometryError` for transforms of two kinds.
    """
    if type(a) is not type(b):
        raise GeometryError(
            message(
                "both transforms must be of one kind",
                f"{type(a).__name__} and {type(b).__name__}",
                "Turn both into Affine with Affine.of.",
            )
        )
    return a @ type(a).exp(t * (a.inverse() @ b).log())
