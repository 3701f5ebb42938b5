"""TensorBoard event files, as far as scalars need them: TFRecord framing around a few fields of two messages.

The format is tensorflow/core/util/event.proto and lib/io/record_writer.cc; the packages that write it bring
TensorFlow, PyTorch or a pinned protobuf along.
"""

from __future__ import annotations

import os
import socket
import struct
import time
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType

_CASTAGNOLI = 0x82F63B78  # the polynomial of CRC-32C, bits reversed


class EventFile:
    """A new event file in a folder. Readers drop what older files of the folder have from `first_step` on."""

    def __init__(self, folder: str | Path, first_step: int = 0) -> None:
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        name = f"events.out.tfevents.{time.time_ns() // 10**9:010d}.{socket.gethostname()}.{os.getpid()}.{first_step}"
        self._file = (folder / name).open("wb")
        self._write(_text(3, b"brain.Event:2"), 0)
        self._write(_message(7, _integer(1, 1)), first_step)  # SessionLog.START

    def scalars(self, step: int, values: Mapping[str, float]) -> None:
        """Write values by tag."""
        summary = b"".join(
            _message(1, _text(1, tag.encode()) + struct.pack("<Bf", 2 << 3 | 5, value)) for tag, value in values.items()
        )
        self._write(_message(5, summary), step)
        self._file.flush()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __enter__(self) -> EventFile:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _write(self, content: bytes, step: int) -> None:
        event = struct.pack("<Bd", 1 << 3 | 1, time.time()) + _integer(2, step) + content
        length = struct.pack("<Q", len(event))
        self._file.write(length + _masked_checksum(length) + event + _masked_checksum(event))


def crc32c(content: bytes) -> int:
    """Return the CRC-32C of RFC 3720."""
    value = 0xFFFFFFFF
    for byte in content:
        value = _TABLE[(value ^ byte) & 0xFF] ^ value >> 8
    return value ^ 0xFFFFFFFF


def _table_entry(value: int) -> int:
    for _ in range(8):
        value = value >> 1 ^ (_CASTAGNOLI if value & 1 else 0)
    return value


_TABLE = [_table_entry(value) for value in range(256)]


def _masked_checksum(content: bytes) -> bytes:
    value = crc32c(content)
    return struct.pack("<I", ((value >> 15 | value << 17 & 0xFFFFFFFF) + 0xA282EAD8) & 0xFFFFFFFF)


def _varint(value: int) -> bytes:
    parts = []
    while value > 0x7F:
        parts.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*parts, value])


def _integer(field: int, value: int) -> bytes:
    return _varint(field << 3) + _varint(value)


def _text(field: int, value: bytes) -> bytes:
    return _varint(field << 3 | 2) + _varint(len(value)) + value


_message = _text  # both are lengths and bytes
