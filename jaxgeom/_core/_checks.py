"""One clear error for bad input: what must hold, what was given, what to do."""


class GeometryError(ValueError):
    """The data cannot be processed; the message says what must hold and what to do."""


def message(must: str, given: str, fix: str) -> str:
    """The three-part text of every error of the package."""
    return f"{must}; given: {given}. {fix}"


def check_shape(name: str, array, shape: tuple[int | None, ...]) -> None:
    """Raise `GeometryError` unless `array` has `shape` (None matches any size)."""
    given = tuple(array.shape)
    fits = len(given) == len(shape) and all(
        want is None or want == got for want, got in zip(shape, given, strict=True)
    )
    if not fits:
        want = "[" + ", ".join("n" if s is None else str(s) for s in shape) + "]"
        raise GeometryError(
            message(
                f"{name} must have shape {want}",
                f"shape {given}",
                "Pass one object at a time and batch with jax.vmap.",
            )
        )
