"""Compressed parts of files, unpacked as far as the limit of a file allows and no further."""

from __future__ import annotations

import bz2
import importlib
import io
from typing import Any

from wlplan.io.limits import MOST_UNPACKED, check_unpacked

# Most that LZ4 saves: a byte stands for 255 at most.
_MOST_BY_LZ4 = 255


class Unpacker:
    """Unpacks the parts of one file, which share what it may unpack to.

    Args:
        size: Of the file [byte].
    """

    def __init__(self, size: int):
        # Recordings are long: all of one may be looked through, a part after the other.
        self._room = max(MOST_UNPACKED, _MOST_BY_LZ4 * size)

    def bz2(self, content: bytes) -> bytes:
        """What bzip2 has packed."""
        return self._read(bz2.open(io.BytesIO(content)))

    def lz4(self, content: bytes) -> bytes:
        """What LZ4 has packed as a frame."""
        try:
            library = importlib.import_module("lz4.frame")
        except ImportError:
            # The library that takes its place from Python 3.14 on has no limit to give.
            check_unpacked(_MOST_BY_LZ4 * len(content))
            return bytes(importlib.import_module("safelz4.frame").decompress(content))
        return self._read(library.open(io.BytesIO(content)))

    def zstd(self, content: bytes) -> bytes:
        """What Zstandard has packed."""
        for name in ("compression.zstd", "backports.zstd"):
            try:
                library = importlib.import_module(name)
            except ImportError:
                continue
            return self._read(library.open(io.BytesIO(content), "rb"))
        reader = importlib.import_module("zstandard").ZstdDecompressor()
        return self._read(reader.stream_reader(io.BytesIO(content)))

    def _read(self, stream: Any) -> bytes:
        most = min(self._room, MOST_UNPACKED)
        parts, size = [], 0
        # A reader may set aside all that it is asked for.
        while size <= most and (part := stream.read(1 << 20)):
            parts.append(part)
            size += len(part)
        check_unpacked(size if size <= most else MOST_UNPACKED + size)
        self._room -= size
        return b"".join(parts)
