"""Parsing Wavefront OBJ files: vertices and faces, and nothing else."""

from __future__ import annotations

from array import array
from itertools import pairwise

import numpy as np
from jaxtyping import Float64, Int64

from kmn_jax.errors import InputError


def parse_obj(content: bytes) -> tuple[Float64[np.ndarray, "v 3"], Int64[np.ndarray, "t 3"]]:
    """Return the vertices and triangles of an OBJ file's content; polygons become fans, groups are joined.

    Raises InputError, without the file's name, that names the first line which cannot be understood.
    """
    coordinates, triangles = array("d"), array("q")
    for number, line in enumerate(content.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ").splitlines(), start=1):
        words = line.partition(b"#")[0].split()
        kind = words[0] if words else b""
        try:
            if kind == b"v":
                x, y, z = words[1:4]
                coordinates.extend((float(x), float(y), float(z)))
            elif kind == b"f":
                corners = [int(word.partition(b"/")[0]) for word in words[1:]]
                if len(corners) < 3 or 0 in corners:
                    raise ValueError
                # Indices count from 1; negative ones count back from the last vertex so far.
                first, *rest = (i - 1 if i > 0 else len(coordinates) // 3 + i for i in corners)
                for second, third in pairwise(rest):
                    triangles.extend((first, second, third))
        except (ValueError, OverflowError):
            shown = line.strip()[:60].decode("latin-1")
            raise InputError(f"line {number} is not a {'vertex' if kind == b'v' else 'face'}: {shown!r}") from None
    return np.array(coordinates, np.float64).reshape(-1, 3), np.array(triangles, np.int64).reshape(-1, 3)
