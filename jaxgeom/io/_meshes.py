"""OBJ, OFF and STL files, read without merging, reordering or losing anything.

trimesh 5.2 reads a cut STL file as a mesh of no faces, drops the normals of OBJ files,
and loses the last faces of a cut OFF file: hence these readers.
"""

import re

import numpy as np

from ._columns import COLOR, NORMAL, POSITION, Contents, block
from ._errors import cut_short, damaged
from ._polygons import fan, merge_equal
from ._tables import not_numbers, parse_table

_PREFIX, _HEAD = 84, 80
_FACET = np.dtype(
    [("normal", "<f4", (3,)), ("corners", "<f4", (3, 3)), ("attribute", "<u2")]
)
_CORNER = re.compile(rb"\bvertex\s+(\S+)\s+(\S+)\s+(\S+)")


# --- STL ----------------------------------------------------------------------------


def read_stl(data: bytes, name: str) -> Contents:
    """A binary or text STL file; corners at exactly equal places are one vertex."""
    count = int.from_bytes(data[_HEAD:_PREFIX], "little")
    exact = len(data) == _PREFIX + count * _FACET.itemsize
    if data.lstrip()[:5].lower() == b"solid" and not (exact and count):
        corners = _text_corners(data.lower(), name)
    else:
        got = max(len(data) - _PREFIX, 0) // _FACET.itemsize
        if len(data) < _PREFIX:
            raise damaged(name, "STL", f"{len(data)} bytes, the header has {_PREFIX}")
        if got < count:
            raise cut_short(name, "STL", "triangles", count, got)
        corners = np.frombuffer(data, _FACET, count, _PREFIX)["corners"]
    points, index = merge_equal(corners.reshape(-1, 3))
    columns = dict(zip(POSITION, points.T, strict=True))
    return Contents(columns, index.reshape(-1, 3))


def write_stl(contents: Contents) -> bytes:
    """A binary STL file."""
    corners = block(contents.columns, POSITION)[contents.faces].astype(np.float32)
    rows = np.zeros(len(corners), _FACET)
    rows["corners"] = corners
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    rows["normal"] = _unit(cross)
    head = b"written by jaxgeom".ljust(_HEAD, b" ")
    return head + len(rows).to_bytes(4, "little") + rows.tobytes()


def _text_corners(text, name):
    words = _CORNER.findall(text)
    facets = text.count(b"endfacet")
    if len(words) != 3 * facets or b"endsolid" not in text:
        given = f"{len(words)} corners in {facets} complete facets, or no 'endsolid'"
        raise damaged(name, "STL", given)
    try:
        return np.array([[float(w) for w in row] for row in words]).reshape(-1, 3, 3)
    except ValueError as error:
        raise damaged(name, "STL", str(error)) from error


# --- OFF ----------------------------------------------------------------------------


def read_off(data: bytes, name: str) -> Contents:
    """An OFF, COFF, NOFF or CNOFF file; polygons become triangles."""
    numbered = enumerate(data.splitlines(), 1)
    rows = [(number, line.split(b"#")[0].strip()) for number, line in numbered]
    rows = [(number, line) for number, line in rows if line]
    kind = re.match(rb"(ST)?(C?)(N?)OFF\b[ \t]*(BINARY)?", rows[0][1] if rows else b"")
    if kind is None or kind.group(4):
        raise damaged(name, "OFF", "a first line other than OFF, COFF, NOFF or CNOFF")
    rest = rows[0][1][kind.end() :].strip()
    rows = [(rows[0][0], rest), *rows[1:]] if rest else rows[1:]
    num_vertices, num_faces = _counts(rows, name)
    vertices = rows[1 : 1 + num_vertices]
    faces = rows[1 + num_vertices : 1 + num_vertices + num_faces]
    if len(vertices) < num_vertices:
        raise cut_short(name, "OFF", "vertices", num_vertices, len(vertices))
    if len(faces) < num_faces:
        raise cut_short(name, "OFF", "faces", num_faces, len(faces))
    table = parse_table([row for _, row in vertices], name, [n for n, _ in vertices])
    names = [*POSITION, *(NORMAL if kind.group(3) else ())]
    names += COLOR if kind.group(2) else ()
    if vertices and table.shape[1] < len(names):
        text = vertices[0][1].decode("latin-1")
        raise not_numbers(name, vertices[0][0], text, f"{len(names)} numbers")
    columns = dict(zip(names, table.T, strict=False))
    return Contents(columns, _off_faces(faces, name))


def write_off(contents: Contents) -> bytes:
    """An OFF file of positions and faces."""
    points = block(contents.columns, POSITION)
    head = f"OFF\n{len(points)} {len(contents.faces)} 0\n"
    return head.encode() + _lines("", points) + _lines("3 ", contents.faces)


def _counts(rows, name):
    words = rows[0][1].split() if rows else []
    try:
        counts = int(words[0]), int(words[1])
        if min(counts) < 0:
            raise ValueError("a negative count")
    except (ValueError, IndexError) as error:
        raise damaged(name, "OFF", "no counts of vertices and faces") from error
    return counts


def _off_faces(rows, name):
    sizes, corners = [], []
    for number, line in rows:
        try:
            words = line.split()
            size = int(words[0])
            polygon = [int(word) for word in words[1 : size + 1]]
            if size < 0 or len(polygon) < size:
                raise ValueError("too few corners")
        except ValueError as error:
            text = line.decode("latin-1")
            raise not_numbers(name, number, text, "a face: n i1 ... in") from error
        sizes.append(size)
        corners += polygon
    return fan(np.array(sizes, np.int64), _indices(corners))


# --- OBJ ----------------------------------------------------------------------------


def read_obj(data: bytes, name: str) -> Contents:
    """The vertices, normals, colors and faces of an OBJ file, or of its points alone.

    A vertex whose corners have different normals gets the direction of their sum.
    """
    vertices, normals, sizes, corners = [], [], [], []
    text = data.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ").decode("latin-1")
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split("#")[0].split()
        if not words or words[0] not in ("v", "vn", "f"):
            continue
        try:
            if words[0] == "f":
                counts = len(vertices), len(normals)
                corners += [_corner(word, counts) for word in words[1:]]
                sizes.append(len(words) - 1)
            else:
                (vertices if words[0] == "v" else normals).append(
                    [float(word) for word in words[1:]]
                )
            if len(words) < 4:
                raise ValueError("too few numbers")
        except ValueError as error:
            wanted = "three or more numbers after its letter"
            raise not_numbers(name, number, line.strip(), wanted) from error
    table = _even(vertices, name)
    columns = dict(zip(POSITION, table.T, strict=False))
    if table.shape[1] >= 6:
        columns |= zip(COLOR, table.T[3:6], strict=True)
    index = _indices(corners).reshape(-1, 2)
    directions = _even(normals, name)[:, :3] if normals else None
    if directions is not None:
        columns |= _obj_normals(len(table), directions, index, name)
    faces = fan(np.array(sizes, np.int64), index[:, 0]) if sizes else None
    return Contents(columns, faces)


def write_obj(contents: Contents) -> bytes:
    """An OBJ file of positions, colors, normals and faces."""
    columns = contents.columns
    points, normals = block(columns, POSITION), block(columns, NORMAL)
    colors = block(columns, COLOR)
    if colors is not None:
        points = np.concatenate([points, colors / 255], axis=1)
    out = b"# written by jaxgeom\n" + _lines("v ", points)
    index = contents.faces + 1
    if normals is None:
        return out + _lines("f ", index)
    rows = "\n".join(f"f {a}//{a} {b}//{b} {c}//{c}" for a, b, c in index.tolist())
    return out + _lines("vn ", normals) + (rows + "\n").encode()


def _corner(word, counts):
    """(vertex, normal) counted from 0; -1 where a corner has no normal."""
    parts = word.split("/")
    vertex = int(parts[0])
    normal = int(parts[2]) if len(parts) > 2 and parts[2] else 0
    if vertex == 0:
        raise ValueError("indices count from 1")
    vertex = vertex - 1 if vertex > 0 else counts[0] + vertex
    normal = counts[1] + normal if normal < 0 else normal - 1
    return vertex, normal


def _even(rows, name):
    widths = {len(row) for row in rows}
    if len(widths) > 1:
        given = f"lines of {min(widths)} and of {max(widths)} numbers of one kind"
        raise damaged(name, "OBJ", given)
    return np.array(rows, np.float64).reshape(len(rows), widths.pop() if widths else 3)


def _obj_normals(count, directions, index, name):
    vertex, normal = index[index[:, 1] >= 0].T
    if len(directions) == count and np.array_equal(vertex, normal):
        return dict(zip(NORMAL, directions.T, strict=True))
    if not len(normal):
        return {}
    if normal.max() >= len(directions) or vertex.min() < 0 or vertex.max() >= count:
        raise damaged(name, "OBJ", "faces that name vertices or normals out of range")
    total = np.zeros((count, 3))
    np.add.at(total, vertex, directions[normal])
    return dict(zip(NORMAL, _unit(total).T, strict=True))


def _unit(vectors):
    """Unit vectors; zero stays zero."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    zero = np.zeros_like(vectors)
    return np.divide(vectors, length, out=zero, where=length > 0)


def _indices(values):
    """int64; an index beyond every mesh becomes -1, which is reported later."""
    limit = 2**31
    flat = np.array(values, object).reshape(-1)
    return np.array([v if abs(v) < limit else -1 for v in flat.tolist()], np.int64)


def _lines(prefix, table):
    """The rows of a table as text, with as many digits as the numbers have."""
    number = "{:d}" if table.dtype.kind in "iu" else "{:.17g}"
    number = "{:.9g}" if table.dtype == np.float32 else number
    form = prefix + " ".join([number] * table.shape[1]) + "\n"
    return "".join(form.format(*row) for row in table.tolist()).encode()
