"""Unpacking LZF, the compression of PCD files."""

from __future__ import annotations


def unpack_lzf(packed: bytes, size: int) -> bytes:
    """Return the `size` bytes that were packed. Raises ValueError or IndexError if the data are not so many."""
    result, position, end, length = bytearray(), 0, len(packed), 0
    while position < end:
        control = packed[position]
        if control < 32:  # so many bytes plus one as they are
            stop = position + control + 2
            result += packed[position + 1 : stop]
            position, length = stop, len(result)
        else:  # a piece that came before
            count = control >> 5
            if count == 7:
                position += 1
                count += packed[position]
            start = length - ((control & 31) << 8) - packed[position + 1] - 1
            if start < 0:
                raise ValueError("the data are not LZF")
            count += 2
            stop = start + count
            if stop <= length:
                result += result[start:stop]
            else:  # it overlaps what it yields
                result += (result[start:] * (count // (length - start) + 1))[:count]
            position += 2
            length += count
        if length > size:
            break
    if length != size:
        raise ValueError(f"the data are not the LZF of {size} bytes")
    return bytes(result)
