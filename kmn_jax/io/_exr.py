"""Reading the depth channel of EXR files."""

from __future__ import annotations

import io

import numpy as np

from kmn_jax.errors import InputError
from kmn_jax.io._apart import decoded_apart
from kmn_jax.limits import most_bytes

_DEPTH_NAMES = ("z", "depth")  # of a channel among others
_PROGRAM = """
import sys
import numpy as np
import OpenEXR
source, target, most, most_bytes = sys.argv[1:]
taken = 0  # by what is decoded, and by what is made of it
with OpenEXR.File(source, header_only=True) as file:
    announced = len(file.parts)
    for part in file.parts:
        low, high = (np.asarray(corner, dtype=float) for corner in part.header["dataWindow"])
        if np.prod(high - low + 1) > int(most):
            sys.exit(f"it announces more than {most} pixels")
        taken += 8 * np.prod(high - low + 1) * len(part.header["channels"])
        if taken > int(most_bytes):
            sys.exit(f"its channels take more than {most_bytes} bytes")
found, windows = [], []
with OpenEXR.File(source, separate_channels=True) as file:
    if not 0 < announced == len(file.parts):
        sys.exit("a part cannot be decoded")  # which is missing, without an exception
    for part in file.parts:
        for name, channel in part.channels.items():
            found.append((name, channel.pixels))
            windows.append([part.header["dataWindow"], part.header["displayWindow"]])
pixels = {f"p{i}": found[i][1] for i in range(len(found)) if found[i][1].dtype != object}
with open(target, "wb") as file:
    np.savez(file, names=np.array([name for name, _ in found], dtype=str), windows=np.array(windows), **pixels)
"""


def parse_exr(content: bytes, most: int) -> np.ndarray:
    """Return the depth channel of an EXR file's content, zero where its window is smaller than the image.

    Raises InputError, without the file's name, for more than `most` pixels, several channels of which not one is called
    Z or depth, and damaged content.
    """
    if content[:4] != b"\x76\x2f\x31\x01":
        raise InputError("it is not an EXR file")
    with np.load(io.BytesIO(decoded_apart(content, _PROGRAM, "OpenEXR", str(most), str(most_bytes())))) as file:
        found = dict(file)
    names = [str(name) for name in found["names"]]
    chosen = [i for i, name in enumerate(names) if name.rpartition(".")[2].lower() in _DEPTH_NAMES]
    if len(names) == 1:
        chosen = [0]
    if len(chosen) != 1 or f"p{chosen[0]}" not in found:
        shown = ", ".join(names)[:80] or "none that can be read"
        raise InputError(f"its channels are {shown}: save the depth alone, or as one channel called Z")
    pixels, ((low, high), (start, end)) = found[f"p{chosen[0]}"], found["windows"][chosen[0]].astype(np.int64)
    if pixels.shape != tuple((high - low + 1)[::-1]):
        raise InputError(f"its channel {names[chosen[0]]} is subsampled: save it in full")
    first, last = np.maximum(low, start), np.minimum(high, end)
    if (last < first).any() or int(np.prod(end - start + 1)) > most:
        raise InputError("its data window does not lie in its display window: save it with one window")
    image = np.zeros((end - start + 1)[::-1], dtype=pixels.dtype)
    (left, top), (right, bottom) = first - start, last - start + 1
    inner = first - low
    image[top:bottom, left:right] = pixels[inner[1] :, inner[0] :][: bottom - top, : right - left]
    return image
