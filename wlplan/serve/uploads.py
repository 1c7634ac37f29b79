"""Scans that requests bring: bytes, which are a file only while they are read.

The file is the only one in a private folder that goes when it was read, and its name is ours: of
the name that came with it only the ending counts, one of a fixed list. The readers of those open no
other file than the one that they are given.
"""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import hashlib
import json
import re
import tempfile
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from wlplan.errors import InputError
from wlplan.serve.answers import Refused

ENDINGS = (
    *(".npz", ".tif", ".tiff", ".asc", ".las", ".laz", ".ply", ".pcd", ".e57", ".xyz", ".csv"),
    *(".txt", ".obj", ".stl", ".bag", ".mcap", ".db3"),
)
"""Endings of what is taken."""

BUNDLED = "bundled"
"""Stands for the pile that ships with the package."""

# Scans that are kept, and most bytes of all of them, in parts of the most of one request.
_KEPT, _MOST = 4, 2
_LONGEST_NAME = 100


@dataclasses.dataclass(frozen=True)
class Upload:
    """A scan that was sent.

    Attributes:
        name: Of its file, as it is shown: printable, without folders.
        ending: One of `ENDINGS`.
        content: Its bytes.
        id: Under which it is asked for again.
    """

    name: str
    ending: str
    content: bytes
    id: str

    @contextlib.contextmanager
    def on_disk(self, areas: Mapping[str, Any]) -> Iterator[tuple[Path, dict[str, str]]]:
        """The scan as a file, with files of areas beside it, for the time of a block.

        Complaints in the block name the scan as it is shown, and no folder of this machine.

        Args:
            areas: GeoJSON by the name of the argument of `wlplan.io.read_scan`.

        Yields:
            Path of the scan, and paths of the areas by the same names.
        """
        with tempfile.TemporaryDirectory(prefix="wlplan-") as name:
            folder = Path(name)
            path = folder / f"scan{self.ending}"
            path.write_bytes(self.content)
            files = {of: folder / area_file(of) for of in areas}
            for of, file in files.items():
                file.write_text(json.dumps(areas[of]))
            try:
                yield path, {of: str(file) for of, file in files.items()}
            except InputError as error:
                raise InputError(self.shown(str(error), folder)) from error

    def shown(self, text: str, folder: Path) -> str:
        """A text about the file on disk, as one about what was sent."""
        scan = str(folder / f"scan{self.ending}")
        return text.replace(scan, self.name).replace(f"{folder}/", "")


def area_file(name: str) -> str:
    """What a file of areas is called beside a plan: `keep_out` is `keep-out.geojson`."""
    return f"{name.replace('_', '-')}.geojson"


class Uploads:
    """The last scans that were sent.

    Args:
        most: Bytes of the largest request.
    """

    def __init__(self, most: int):
        self._kept: collections.OrderedDict[str, Upload] = collections.OrderedDict()
        self._most, self._lock = _MOST * most, threading.Lock()

    def add(self, name: str, content: bytes) -> Upload:
        """Keeps a scan; the oldest go.

        Args:
            name: Of its file, whatever it is.
            content: Its bytes.

        Raises:
            InputError: If its ending is none of `ENDINGS`, or it is empty.
        """
        shown = shown_name(name)
        ending = Path(shown).suffix.lower()
        if ending not in ENDINGS:
            raise InputError(
                f"{shown or 'the scan'}: unknown kind of pile file {ending!r}: the name has to end "
                f"in one of {', '.join(ENDINGS)}."
            )
        if not content:
            raise InputError(f"{shown}: is empty: send the bytes of the scan.")
        upload = Upload(shown, ending, content, _id_of(shown, content))
        with self._lock:
            self._kept[upload.id] = upload
            self._kept.move_to_end(upload.id)
            while len(self._kept) > _KEPT or self._size() > self._most:
                self._kept.popitem(last=False)
        return upload

    def find(self, name: str) -> Upload:
        """The scan of a name.

        Raises:
            Refused: If it is not kept any more.
        """
        if name == BUNDLED:
            return _bundled()
        with self._lock:
            if name not in self._kept:
                raise Refused(404, "there is no such scan any more: send it again.")
            self._kept.move_to_end(name)
            return self._kept[name]

    def _size(self) -> int:
        return sum(len(upload.content) for upload in self._kept.values())


def shown_name(name: str) -> str:
    """The name of a file as it may be shown: its last part, printable, not too long."""
    last = re.split(r"[/\\]", name)[-1]
    printable = "".join(letter for letter in last if letter.isprintable()).strip()
    return printable[-_LONGEST_NAME:]


def _bundled() -> Upload:
    from wlplan.io.bundled import bundled_pile_path

    path = bundled_pile_path()
    content = path.read_bytes()
    return Upload(f"{BUNDLED} ({path.name})", path.suffix, content, BUNDLED)


def _id_of(name: str, content: bytes) -> str:
    """The same scan is kept once."""
    return hashlib.sha256(name.encode() + b"\0" + content).hexdigest()[:20]
