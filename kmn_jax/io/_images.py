"""Reading image files as they were stored, their size known to be bearable before they are decoded."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Shaped

from kmn_jax.errors import InputError
from kmn_jax.io._silence import silence, silence_stderr
from kmn_jax.limits import check_elements

_TILE_WIDTH, _TILE_LENGTH = 322, 323  # tags of TIFF files


class ImageHeader(NamedTuple):
    """What an image file says of itself; `mode` and `kind` are what Pillow calls its pixels and its format."""

    mode: str
    kind: str | None
    width: int
    height: int


def image_header(source: Path | bytes, formats: tuple[str, ...] | None = None) -> ImageHeader:
    """Read what an image file or its content announces, of one of some formats if they are given.

    Raises InputError, without the file's name, if it is none, or has more pixels than the budget.
    """
    with _opened(source, formats) as image:
        return ImageHeader(image.mode, image.format, image.width, image.height)


def read_image(content: bytes, formats: tuple[str, ...] | None = None) -> tuple[ImageHeader, Shaped[np.ndarray, "..."]]:
    """Read what `image_header` reads, and the values as they are stored."""
    with _opened(content, formats) as image:
        # libtiff prints what it dislikes, and all but raw pixels are decoded by it.
        by_libtiff = image.format == "TIFF" and image.info.get("compression", "raw") != "raw"
        with silence_stderr() if by_libtiff else contextlib.nullcontext():
            values = np.asarray(image)
        return ImageHeader(image.mode, image.format, image.width, image.height), values


@contextlib.contextmanager
def _opened(source: Path | bytes, formats: tuple[str, ...] | None) -> Iterator[Any]:
    from PIL import Image

    try:
        file = source if isinstance(source, Path) else io.BytesIO(source)
        with silence("PIL.TiffImagePlugin"), Image.open(file, "r", formats) as image:
            check_elements(image.width * image.height, "pixels")
            tags = getattr(image, "tag_v2", None) or {}
            check_elements(int(tags.get(_TILE_WIDTH, 0)) * int(tags.get(_TILE_LENGTH, 0)), "pixels in a tile")
            yield image
    except InputError:
        raise
    except Exception as error:  # each decoder has errors of its own
        raise InputError(f"it is not a readable image ({type(error).__name__})") from None
