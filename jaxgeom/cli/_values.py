"""What options may be: functions for `type=` that say what must hold."""

import argparse


def distance(text):
    """A length, or a share of a size as the negative of a percentage."""
    percent = text.endswith("%")
    value = positive(text.rstrip("%"))
    return -value / 100 if percent else value


def bounds(text):
    """Six numbers, low and high of each axis."""
    try:
        values = [float(x) for x in text.split(",")]
    except ValueError:
        values = []
    ends = zip(values[::2], values[1::2], strict=False)
    if len(values) != 6 or not all(-1e12 < a < b < 1e12 for a, b in ends):
        raise argparse.ArgumentTypeError(
            f"must be six numbers xmin,xmax,... with each min below its max, given "
            f"{text!r}"
        )
    return values


def number(kind, low, high, what):
    """A function that reads a number from low to high, described by `what`."""

    def parse(text):
        try:
            value = kind(text)
        except ValueError:
            value = None
        if value is None or not low <= value <= high:
            raise argparse.ArgumentTypeError(f"must be {what}, given {text!r}")
        return value

    return parse


chunk = number(int, 1, 4096, "a whole number from 1 to 4096")
resolution = number(int, 8, 4096, "a whole number from 8 to 4096")
mesh_resolution = number(int, 8, 1024, "a whole number from 8 to 1024")
finite = number(float, -1e12, 1e12, "a number")
depth = number(int, 3, 12, "a whole number from 3 to 12")
nonnegative = number(float, 0.0, 1e9, "a number of at least 0")
positive = number(float, 1e-12, 1e12, "a number above 0")
scale = number(float, 1.01, 10.0, "a number from 1.01 to 10")
