"""Bodies combined: union, intersection, difference, what lies in one of both."""

from collections.abc import Callable

import jax.numpy as jnp

from ._field import AbstractField, claims, claims_of_all


class Union(AbstractField):
    """min(a, b): the points of either body.

    Exact outside where both are exact distances, a lower bound inside.
    """

    first: Callable
    second: Callable

    def evaluate(self, point):
        return jnp.minimum(self.first(point), self.second(point))

    def claims(self):
        a, b = claims_of_all(self.first, self.second)
        return a.union(b)


class Intersection(AbstractField):
    """max(a, b): the points common to both bodies.

    Exact inside where both are exact distances, a lower bound outside.
    """

    first: Callable
    second: Callable

    def evaluate(self, point):
        return jnp.maximum(self.first(point), self.second(point))

    def claims(self):
        a, b = claims_of_all(self.first, self.second)
        return a.intersection(b)


class Difference(AbstractField):
    """max(a, -b): the points of the first body that are not in the second.

    Exact inside where a is exact inside and b outside; a lower bound outside.
    """

    first: Callable
    second: Callable

    def evaluate(self, point):
        return jnp.maximum(self.first(point), -self.second(point))

    def claims(self):
        a, b = claims_of_all(self.first, self.second)
        return a.intersection(b.complement())


class Xor(AbstractField):
    """max(min(a, b), -max(a, b)): the points that lie in one of the bodies only.

    A lower bound. |f| = min(|a|, |b|): the exact distance where both are, and their
    surfaces share no face.
    """

    first: Callable
    second: Callable

    def evaluate(self, point):
        a, b = self.first(point), self.second(point)
        return jnp.maximum(jnp.minimum(a, b), -jnp.maximum(a, b))

    def claims(self):
        a, b = claims_of_all(self.first, self.second)
        both = a.union(b).intersection(a.intersection(b).complement())
        # The plain rule would not see that nothing of it lies outside of the union.
        return both.weakened(inside=a.inside.hull(b.inside))


class Complement(AbstractField):
    """-a: everything else. As exact as its part."""

    body: Callable

    def evaluate(self, point):
        return -self.body(point)

    def claims(self):
        return claims(self.body).complement()
