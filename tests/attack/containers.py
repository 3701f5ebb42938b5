"""Damage inside of containers that stay whole: lengths and checksums fit, so that what lies deeper is reached."""

from __future__ import annotations

import io
import struct
import zipfile
import zlib
from random import Random

from tests.attack.mutations import mutated_bytes, mutated_numbers, mutated_tree

_TIME = (2000, 1, 1, 0, 0, 0)


def glb_bytes(tree: bytes, rest: bytes) -> bytes:
    """Return a GLB file of a JSON text and what follows its chunk."""
    text = tree + b" " * (-len(tree) % 4)
    chunks = len(text).to_bytes(4, "little") + b"JSON" + text + rest
    return b"glTF" + (2).to_bytes(4, "little") + (12 + len(chunks)).to_bytes(4, "little") + chunks


def mutated_glb(content: bytes, random: Random) -> bytes:
    """Damage a value of a GLB file's JSON."""
    end = 20 + int.from_bytes(content[12:16], "little")
    return glb_bytes(mutated_tree(content[20:end], random), content[end:])


def mutated_tensors(content: bytes, random: Random) -> bytes:
    """Damage the header of a safetensors file, or the JSON that is a text in it, or its numbers."""
    end = 8 + int.from_bytes(content[:8], "little")
    header, data = content[8:end], content[end:]
    if random.random() < 0.4 and data:
        return content[:end] + mutated_floats(data, random)
    header = mutated_tree(header, random) if random.random() < 0.6 else mutated_numbers(header, random)
    return len(header).to_bytes(8, "little") + header + data


def mutated_floats(content: bytes, random: Random) -> bytes:
    """Overwrite some float32 values, wherever they are, with NaN, infinity, or what is huge, tiny or negative."""
    values = [struct.pack("<f", value) for value in (float("nan"), float("inf"), 3e38, -1e30, 1e-44, 0.0, -1.0)]
    for _ in range(random.choice((1, 1, 3, 20))):
        start = 4 * random.randrange(max(1, len(content) // 4))
        content = content[:start] + random.choice(values) + content[start + 4 :]
    return content


def zip_members(content: bytes) -> dict[str, bytes]:
    """Return what a zip file holds by name."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def zip_bytes(members: dict[str, bytes], packed: bool) -> bytes:
    """Return a zip file, the same bytes whenever it is made."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED if packed else zipfile.ZIP_STORED) as archive:
        for name, member in members.items():
            archive.writestr(zipfile.ZipInfo(name, _TIME), member, archive.compression)
    return file.getvalue()


def mutated_zip(content: bytes, random: Random) -> bytes:
    """Damage, drop, rename or exchange a member of a zip file."""
    members = zip_members(content)
    name = random.choice(list(members))
    match random.choice(("member", "member", "member", "numbers", "drop", "rename", "other")):
        case "member":
            members[name] = mutated_bytes(members[name], random)
        case "numbers":
            members[name] = mutated_numbers(members[name], random, 200)
        case "drop":
            del members[name]
        case "rename":
            members[random.choice(("", "../a", "a" * 1000, name.upper()))] = members.pop(name)
        case "other":
            members[name] = members[random.choice(list(members))]
    with zipfile.ZipFile(io.BytesIO(content)) as archive:  # what is compressed is refused by some readers at once
        packed = archive.infolist()[0].compress_type == zipfile.ZIP_DEFLATED
    return zip_bytes(members, packed)


def mutated_png(content: bytes, random: Random) -> bytes:
    """Damage a chunk of a PNG file, and give it the checksum that it then has."""
    chunks, place = [], 8
    while place + 12 <= len(content):
        length = int.from_bytes(content[place : place + 4], "big")
        chunks.append((content[place + 4 : place + 8], content[place + 8 : place + 8 + length]))
        place += 12 + length
    index = random.randrange(len(chunks))
    kind, data = chunks[index]
    match random.choice(("data", "data", "data", "drop", "repeat", "kind")):
        case "data" if kind == b"IDAT" and random.random() < 0.7:
            data = zlib.compress(mutated_bytes(zlib.decompress(data), random))
            chunks[index] = (kind, data)
        case "data":
            chunks[index] = (kind, mutated_bytes(data, random))
        case "drop":
            del chunks[index]
        case "repeat":
            chunks.insert(index, chunks[index])
        case "kind":
            chunks[index] = (random.choice((b"tRNS", b"PLTE", b"acTL", b"zTXt", b"iCCP", b"IEND")), data)
    return content[:8] + b"".join(png_chunk(*chunk) for chunk in chunks)


def png_chunk(kind: bytes, data: bytes) -> bytes:
    """Return a chunk of a PNG file."""
    return len(data).to_bytes(4, "big") + kind + data + zlib.crc32(kind + data).to_bytes(4, "big")
