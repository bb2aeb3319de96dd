"""What a file looks like, by its first bytes, for messages about files of an unknown kind."""

from __future__ import annotations

import re

HEAD = 4096
"""Bytes of a file that tell what it looks like."""

_SIGNATURES = (
    (b"\x89HDF\r\n\x1a\n", "HDF5"),
    (b"MATLAB ", "a MATLAB file"),
    (b"PAR1", "Parquet"),
    (b"ARROW1", "an Arrow file"),
    (b"SQLite format 3\0", "an SQLite database"),
    (b"\x89MCAP0\r\n", "MCAP"),
    (b"#ROSBAG V", "a bag of ROS 1"),
    (b"\x93NUMPY", "one NumPy array (.npy)"),
    (b"ULog\x01\x12\x35", "a ULog of PX4"),
    (b"\xa3\x95\x80\x80", "a DataFlash log of ArduPilot"),
    (b"RRF", "a recording of Rerun"),
    (b"LOGG", "Vector BLF"),
    (b"MDF     ", "MDF"),
    (b"\x1f\x8b", "gzip"),
    (b"\x28\xb5\x2f\xfd", "Zstandard"),
    (b"BZh", "bzip2"),
    (b"\xfd7zXZ\0", "xz"),
    (b"7z\xbc\xaf\x27\x1c", "a 7-Zip archive"),
    (b"\x89PNG\r\n\x1a\n", "a PNG image"),
    (b"\xff\xd8\xff", "a JPEG image"),
    (b"GIF8", "a GIF image"),
    (b"II*\0", "a TIFF image"),
    (b"MM\0*", "a TIFF image"),
    (b"%PDF-", "PDF"),
    (b"\x1aE\xdf\xa3", "a Matroska or WebM video"),
    (b"OggS", "Ogg media"),
    (b"\x7fELF", "a program (ELF)"),
    (b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1", "an old file of Microsoft Office"),
    (b"\xd4\xc3\xb2\xa1", "a capture of packets (pcap)"),
    (b"\x0a\x0d\x0d\x0a", "a capture of packets (pcapng)"),
)
"""First bytes of kinds of files. Sources: the formats' specifications, and ``magic`` of file(1)."""

_ZIPS = (
    (b"xl/", "an Excel workbook"),
    (b"word/", "a Word document"),
    (b"mimetypeapplication/vnd.oasis.opendocument", "an OpenDocument file"),
    (b".npy", "a zip of NumPy arrays (.npz)"),
    (b"data.pkl", "a file of PyTorch"),
)
"""What the first entries of a zip are named."""

_TEXTS = (
    (re.compile(r"\s*(<\?xml|<!DOCTYPE html|<html)", re.IGNORECASE), "XML or HTML"),
    (re.compile(r"\s*[{\[]\s*(\"|\{|\[|-?\d|\]|\})"), "JSON"),
    (re.compile(r"---\r?\n|\s*[A-Za-z_][\w -]*:(\s|$)"), "YAML"),
)
"""How texts of some kinds begin."""

_RIFF = {b"WAVE": "WAVE audio", b"AVI ": "an AVI video", b"WEBP": "a WebP image"}
_PICKLE = re.compile(rb"\x80[\x02-\x05]")
_TAR = slice(257, 262)
_MOST_OF_LINE = 40
_DELIMITERS = ",;\t"
_LEAST_LINES = 2


def looks_like(head: bytes) -> str:
    """Return what a file looks like, as in ``x.h5: it looks like HDF5``.

    Args:
        head: Its first bytes, :data:`HEAD` of them or more.
    """
    if not head.strip():
        return "is empty"
    begin = head[:8].hex(" ")
    return f"looks like {_binary(head) or _text(head) or f'binary data (it begins with {begin})'}"


def has_signature(head: bytes) -> bool:
    """Return whether first bytes are those of one kind of file, which no text begins with."""
    return bool(_binary(head))


def _binary(head: bytes) -> str:
    for signature, kind in _SIGNATURES:
        if head.startswith(signature):
            return kind
    if head.startswith(b"PK\x03\x04"):
        return next((kind for part, kind in _ZIPS if part in head[:HEAD]), "a zip archive")
    if head.startswith(b"RIFF"):
        return _RIFF.get(head[8:12], "a RIFF file")
    if head[4:8] == b"ftyp":
        return "an MP4 video"
    if head[_TAR] == b"ustar":
        return "a tar archive"
    return "a Python pickle" if _PICKLE.match(head) else ""


def _text(head: bytes) -> str:
    """Return the kind of a text; empty if the bytes are none."""
    try:
        text = head[: head.rfind(b"\n") + 1 or None].decode("utf-8-sig")
    except UnicodeDecodeError:
        return ""
    lines = [line for line in text.splitlines() if line.strip()]
    if not lines or re.search(r"[\x00-\x08\x0e-\x1f]", text):
        return ""
    for pattern, kind in _TEXTS:
        if pattern.match(text):
            return kind
    first = lines[0].strip()
    shown = repr(first if len(first) <= _MOST_OF_LINE else f"{first[:_MOST_OF_LINE]}...")
    return f"{'a table of text' if _is_table(lines) else 'text'} (its first line is {shown})"


def _is_table(lines: list[str]) -> bool:
    """Return whether one delimiter occurs equally often in all lines, at least once."""
    whole = lines[:-1] if len(lines) > _LEAST_LINES else lines
    counts = [{line.strip().count(delimiter) for line in whole} for delimiter in _DELIMITERS]
    return len(whole) >= _LEAST_LINES and any(len(count) == 1 and max(count) for count in counts)
