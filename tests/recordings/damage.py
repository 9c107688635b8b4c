"""Damage to files, by seeds: bytes, numbers in text, trees of JSON, and what a hostile file might hold.

Each damage has a rule: "refuse" must not be read at all, "notice" must not be read with another content,
"free" may be read as something else, since nothing in the file says what it was.
"""

from __future__ import annotations

import gzip
import io
import json
import random
import re
import struct
import zipfile
import zlib
from collections.abc import Callable
from itertools import pairwise
from typing import Any

from tests.recordings.hdf5_damage import edited
from tests.recordings.whole_files import Whole

NUMBER = re.compile(rb"-?\d+(\.\d+)?([eE][-+]?\d+)?")
WORDS = [b"nan", b"inf", b"-1", b"0", b"1e999", b"1e300", b"99999999999999999999", b"x", b"", b"1_0", b"-0.0"]
ODD: list[Any] = [
    None,
    True,
    [],
    {},
    "",
    "\x1b[31mred",
    "[bold]",
    -1,
    0,
    1e300,
    10**30,
    [[[]]],
    [1, "a"],
    {"a": 1},
]
RAW = ["NaN", "Infinity", "1e999", "9" * 6000, "[" * 100_000, '{"a":' * 100_000, '"\\ud800"', "[1,]", "nul"]


def flipped(data: bytes, rng: random.Random) -> bytes:
    """One to eight bytes changed."""
    changed = bytearray(data)
    for _ in range(rng.choice([1, 1, 2, 8])):
        changed[rng.randrange(len(changed))] ^= rng.choice([1 << rng.randrange(8), rng.randrange(1, 256)])
    return bytes(changed)


def cut(data: bytes, rng: random.Random) -> bytes:
    """The beginning of it."""
    return data[: rng.randrange(len(data))]


def blanked(data: bytes, rng: random.Random) -> bytes:
    """A stretch of zeros, of random bytes, or of what lies elsewhere."""
    start, length = rng.randrange(len(data)), rng.choice([4, 16, 64, 512])
    other = rng.randrange(len(data))
    middle = rng.choice([bytes(length), rng.randbytes(length), data[other : other + length]])
    return data[:start] + middle[: len(data) - start] + data[start + length :]


def spliced(data: bytes, rng: random.Random) -> bytes:
    """A stretch put in, or left out."""
    start, length = rng.randrange(len(data)), rng.choice([1, 8, 100])
    if rng.random() < 0.5:
        return data[:start] + data[start + length :]
    return data[:start] + rng.randbytes(length) + data[start:]


BYTES = [flipped, flipped, flipped, cut, blanked, spliced]


def numbered(data: bytes, rng: random.Random) -> bytes:
    """A number in text made another, or none."""
    found = list(NUMBER.finditer(data))
    if not found:
        return flipped(data, rng)
    place = rng.choice(found)
    return data[: place.start()] + rng.choice(WORDS) + data[place.end() :]


def json_tree(data: bytes, rng: random.Random) -> bytes:
    """A value of a tree replaced, left out or doubled, or text that is no JSON put in its place."""
    lines = data.decode().splitlines(keepends=True)
    whole = len(lines) > 1 and lines[0].startswith("[")
    number = rng.randrange(len(lines)) if whole else 0
    tree = json.loads(lines[number] if whole else data)
    places: list[tuple[Any, Any]] = []

    def visit(node: Any) -> None:
        for key in list(node if isinstance(node, dict) else range(len(node))):
            places.append((node, key))
            if isinstance(node[key], dict | list):
                visit(node[key])

    visit(tree)
    node, key = rng.choice(places)
    raw, doubled = rng.choice(RAW), json.dumps(key)
    deed = rng.randrange(5)
    if deed == 0:
        del node[key]
    elif deed in (1, 2):
        node[key] = rng.choice(ODD)
    elif deed == 3:
        node[key] = "RAW"
    text = json.dumps(tree)
    if deed == 3:
        text = text.replace('"RAW"', raw)
    if deed == 4:
        text = (
            text.replace(f"{doubled}:", f"{doubled}: 5, {doubled}:") if isinstance(key, str) else f"[{text}]"
        )
    if whole:
        lines[number] = text + "\n"
        text = "".join(lines)
    return text.encode()


def png(width: int, height: int, depth: int, colour: int, line: int) -> bytes:
    """A PNG of zeros, of few bytes however large it claims to be."""

    def chunk(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    squeezer = zlib.compressobj(9)
    rows = b"".join(squeezer.compress(bytes(line + 1)) for _ in range(height)) + squeezer.flush()
    header = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


def _laughs(data: bytes) -> bytes:
    entities = '<!ENTITY a "ha">'
    for inner, outer in pairwise("abcdefghij"):
        entities += f'<!ENTITY {outer} "{f"&{inner};" * 10}">'
    return data.replace(b"<robot", f"<!DOCTYPE robot [{entities}]><robot".encode()).replace(
        b"</robot>", b'<link name="x">&j;</link></robot>'
    )


def _foreign(data: bytes) -> bytes:
    doctype = b'<!DOCTYPE robot [<!ENTITY e SYSTEM "file:///etc/hostname">]><robot'
    return data.replace(b"<robot", doctype).replace(b'name="arm"', b'name="&e;"', 1)


def _archive(data: bytes) -> bytes:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("ring.stl", bytes(80) + struct.pack("<I", 2_000_000) + bytes(100_000_000))
    return packed.getvalue()


HOSTILE: dict[str, list[tuple[str, Callable[[bytes], bytes]]]] = {
    "urdf": [
        ("entities that expand", _laughs),
        ("an external entity", _foreign),
        (
            "nested elements",
            lambda data: data.replace(b"</robot>", b"<a>" * 20000 + b"</a>" * 20000 + b"</robot>"),
        ),
    ],
    "mesh": [
        ("an archive", _archive),
        ("compressed", lambda data: gzip.compress(data)),
        ("a material", lambda data: b"mtllib /etc/hostname\n" * 3 + b"v nan 0 0\nf 1 2 9\n"),
        (
            "a count of PLY",
            lambda data: (
                b"ply\nformat binary_little_endian 1.0\nelement vertex 2000000000\n"
                b"property float x\nproperty float y\nproperty float z\nelement face 1\n"
                b"property list uchar int vertex_indices\nend_header\n" + bytes(200)
            ),
        ),
        (
            "a count of text",
            lambda data: (
                b"ply\nformat ascii 1.0\nelement vertex 900000000\nproperty float x\nend_header\n0 0 0\n"
            ),
        ),
        ("a count of STL", lambda data: bytes(80) + struct.pack("<I", 4_000_000_000) + bytes(500)),
        ("no bytes", lambda data: b""),
        ("many bodies", lambda data: b"v 0 0 0\nv 1 0 0\nv 0 1 0\n" + b"o a\nusemtl b\nf 1 2 3\n" * 50_000),
        ("many solids", lambda data: b"solid a\nendsolid a\n" * 50_000),
    ],
    "png": [
        ("a bomb", lambda data: png(30000, 12000, 1, 0, 3750)),
        ("a large claim", lambda data: png(40000, 40000, 16, 0, 20)),
        ("another mode", lambda data: png(64, 48, 1, 0, 8)),
        ("another size", lambda data: png(63, 47, 16, 0, 126)),
        ("PostScript", lambda data: b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 10 10\nshowpage\n"),
    ],
    "json": [
        ("nesting", lambda data: b"[" * 200_000),
        ("no text", lambda data: b"\xff\xfe" + data),
        ("nothing", lambda data: b""),
        ("empty lists", lambda data: b"[" + b"[]," * 400_000 + b"[]]"),
    ],
    "numbers": [
        ("a long number", lambda data: b"9" * 100_000 + b" " + data),
        ("no numbers", lambda data: b"\x00" * 50),
    ],
    "npz": [("an archive", _archive), ("nothing", lambda data: b"")],
}
MUST = {
    "entities that expand",
    "an external entity",
    "an archive",
    "compressed",
    "PostScript",
    "a large claim",
}


def damaged(whole: Whole, rng: random.Random) -> tuple[str, str]:
    """Damage a file in its place.

    Returns:
        The damage in words, and its rule: "refuse", "notice" or "free".
    """
    path = whole.damaged_path
    if whole.form == "hdf5" and rng.random() < 0.6:
        what, rule = edited(path, rng)
        return what, "notice" if rule == "free" and whole.checked == "all" else rule
    data = path.read_bytes()
    rule = "notice" if whole.checked else "free"
    hostile = HOSTILE.get(whole.form, [])
    if hostile and rng.random() < 0.25:
        what, make = rng.choice(hostile)
        path.write_bytes(make(data))
        return what, "refuse" if what in MUST else rule if whole.form == "npz" else "free"
    text = {"json": [json_tree] * 2, "urdf": [numbered] * 2, "numbers": [numbered], "mesh": [numbered]}
    deeds = [*BYTES, *text.get(whole.form, []) * 4]
    if whole.form == "mesh" and b"\0" in data:
        deeds = BYTES
    deed = rng.choice(deeds)
    path.write_bytes(deed(data, rng))
    return deed.__name__, rule
