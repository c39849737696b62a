"""Static sizes: few distinct capacities, so that similar inputs share one program."""

import math

_STEPS_PER_OCTAVE = 4
_SMALLEST = 16


def bucket(n: int) -> int:
    """The capacity for `n` items: the next of 16, 20, 23, 27, 32, ... (steps of 2^1/4).

    At most 19 % is wasted, and inputs of similar size do not compile anew.
    """
    if n <= _SMALLEST:
        return _SMALLEST
    step = math.ceil(_STEPS_PER_OCTAVE * math.log2(n) - 1e-9)
    return max(n, math.ceil(2 ** (step / _STEPS_PER_OCTAVE)))
