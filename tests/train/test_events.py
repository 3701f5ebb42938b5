from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

from kmn_jax.train._events import EventFile, crc32c


@pytest.mark.parametrize(
    ("content", "checksum"),
    [
        (b"", 0),
        (b"123456789", 0xE3069283),
        (bytes(32), 0x8A9136AA),
        (b"\xff" * 32, 0x62A8AB43),
        (bytes(range(32)), 0x46DD794E),
    ],
)
def test_checksums_are_those_of_rfc_3720(content: bytes, checksum: int) -> None:
    assert crc32c(content) == checksum


def event_class() -> type:
    """Return the message of tensorflow's event.proto, as far as scalars need it."""
    kinds = descriptor_pb2.FieldDescriptorProto
    file = descriptor_pb2.FileDescriptorProto(name="event.proto", package="tensorflow", syntax="proto3")
    messages = {
        "Value": [("tag", 1, kinds.TYPE_STRING, ""), ("simple_value", 2, kinds.TYPE_FLOAT, "")],
        "Summary": [("value", 1, kinds.TYPE_MESSAGE, ".tensorflow.Value")],
        "SessionLog": [("status", 1, kinds.TYPE_INT32, "")],
        "Event": [
            ("wall_time", 1, kinds.TYPE_DOUBLE, ""),
            ("step", 2, kinds.TYPE_INT64, ""),
            ("file_version", 3, kinds.TYPE_STRING, ""),
            ("summary", 5, kinds.TYPE_MESSAGE, ".tensorflow.Summary"),
            ("session_log", 7, kinds.TYPE_MESSAGE, ".tensorflow.SessionLog"),
        ],
    }
    for name, fields in messages.items():
        message = file.message_type.add(name=name)
        for field, number, kind, of in fields:
            label = kinds.LABEL_REPEATED if name == "Summary" else kinds.LABEL_OPTIONAL
            message.field.add(name=field, number=number, type=kind, type_name=of or None, label=label)
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("tensorflow.Event"))


def test_events_are_what_protobuf_reads(tmp_path: Path) -> None:
    with EventFile(tmp_path / "events", first_step=301) as file:
        file.scalars(320, {"train/loss": 1.5, "train/é": float("nan")})
        file.scalars(3_000_000_000, {"train/loss": -1e-30})
    (path,) = (tmp_path / "events").iterdir()
    assert path.name.startswith("events.out.tfevents.")
    content, events, event = path.read_bytes(), [], event_class()
    while content:
        (length,) = struct.unpack("<Q", content[:8])
        for start, size in ((0, 8), (12, length)):
            (masked,) = struct.unpack("<I", content[start + size :][:4])
            rotated = (masked - 0xA282EAD8) % 2**32
            assert (rotated << 15 | rotated >> 17) % 2**32 == crc32c(content[start : start + size])
        events.append(event.FromString(content[12 : 12 + length]))
        content = content[16 + length :]
    assert [event.step for event in events] == [0, 301, 320, 3_000_000_000]
    assert events[0].file_version == "brain.Event:2"
    assert events[1].session_log.status == 1  # START: readers drop later steps of older files
    assert [value.tag for value in events[2].summary.value] == ["train/loss", "train/é"]
    assert events[2].summary.value[0].simple_value == 1.5
    assert np.isnan(events[2].summary.value[1].simple_value)
    assert events[3].summary.value[0].simple_value == np.float32(-1e-30)
    assert events[3].wall_time > 1.7e9
