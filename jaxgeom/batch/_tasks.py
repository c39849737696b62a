"""What is done with the scans of a batch, and how one ends."""

from abc import ABC, abstractmethod
from collections.abc import Hashable

import equinox as eqx
import numpy as np

from .._core import RESULTS, name_of
from ..shapes import PointCloud, stack
from ._manifest import Scan


class Outcome(eqx.Module):
    """How a scan ended: a status of `STATES`, a code for programs, a text for people,
    and what is known of the result as JSON."""

    status: str = eqx.field(static=True)
    code: str = eqx.field(static=True)
    text: str = eqx.field(static=True, default="")
    facts: dict = eqx.field(static=True, default_factory=dict)


class AbstractTask(ABC):
    """A kind of work on scans; what it needs again, such as a target, it keeps."""

    @abstractmethod
    def input_hash(self, scan: Scan) -> str:
        """The hash of all that the result depends on. Raises `Refused`."""

    @abstractmethod
    def read(self, scan: Scan) -> tuple[Hashable, eqx.Module]:
        """What scans must share to be worked on in one call, and what one needs.

        The key has a `size`, to which its scans are padded. Raises `Refused`.
        """

    @abstractmethod
    def most(self, key, chunk: int) -> int:
        """How many scans of a key may be worked on at once, at most `chunk`."""

    @abstractmethod
    def program(self, key) -> Hashable:
        """What decides, beside the number of scans, which program a chunk needs."""

    @abstractmethod
    def solve(self, key, scans: list[Scan], works: list, room: int, out) -> list:
        """The outcome of each scan of a chunk, in calls for `room` scans.

        Results that are no part of a state are files under `out`, written whole.
        """


def padded_batch(clouds: list[PointCloud], room: int, size: int) -> PointCloud:
    """A batch of `room` clouds of `size` points; those that are missing are empty."""
    empty = np.zeros(len(clouds[0].points), bool)
    empty = eqx.tree_at(lambda cloud: cloud.mask, clouds[0], empty)
    return stack([*clouds, *[empty] * (room - len(clouds))], capacity=size)


def size_bucket(n: int) -> int:
    """The size that scans of `n` points are padded to: powers of two from 256.

    Steps are coarser than those of `bucket`, since a batch compiles for each of them.
    """
    return max(256, 1 << (n - 1).bit_length())


def verdict(result) -> Outcome:
    """The outcome by a status of the host; what did not settle can still be used."""
    code = name_of(result)
    # A result of numbers, as arrays on the host leave it, does not tell its text.
    text = RESULTS[getattr(RESULTS, code)]
    if code == "successful":
        return Outcome("ok", code)
    return Outcome("warning" if code == "not_converged" else "failed", code, text)
