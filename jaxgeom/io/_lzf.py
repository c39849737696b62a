"""LZF, the compression of binary PCD files (Lehmann, liblzf)."""

from ._errors import FileError, damaged

_LITERALS = 32
_LONG = 7


def decompress(data: bytes, size: int, name: str) -> bytes:
    """The `size` bytes that the LZF stream `data` stands for; raises `FileError`."""
    out = bytearray()
    position = 0
    try:
        while position < len(data):
            control = data[position]
            position += 1
            if control < _LITERALS:
                end = position + control + 1
                if end > len(data):
                    raise IndexError("literals beyond the end")
                out += data[position:end]
                position = end
                continue
            length = control >> 5
            if length == _LONG:
                length += data[position]
                position += 1
            back = ((control & 31) << 8) + data[position] + 1
            position += 1
            _repeat(out, back, length + 2)
    except IndexError as error:
        raise _broken(name, str(error)) from error
    if len(out) != size:
        raise _broken(name, f"{len(out)} bytes where {size} are promised")
    return bytes(out)


def _repeat(out, back, length):
    """Append `length` bytes that start `back` bytes before the end of `out`."""
    start = len(out) - back
    if start < 0:
        raise IndexError("a reference before the beginning")
    # A reference may run into the bytes it appends: they repeat with period `back`.
    piece = bytes(out[start : start + length])
    out += (piece * (length // len(piece) + 1))[:length]


def _broken(name, given) -> FileError:
    return damaged(name, "compressed PCD", given)
