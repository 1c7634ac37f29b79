"""Files and folders with something wrong: edits that hypothesis draws, and makes smaller."""

from __future__ import annotations

import math
import struct
from typing import NamedTuple

from hypothesis import strategies as st


class Edit(NamedTuple):
    """A change of a file.

    Attributes:
        kind: "cut" there, "double" from there on, "put" bytes over what is there, "digit" for a
            letter of text.
        where: Part of the file's length before it.
        head: Whether that is of its first 600 bytes only, where sizes and counts stand.
        value: What is put.
    """

    kind: str
    where: float
    head: bool
    value: bytes


# Sizes and counts that are full, empty, negative or no numbers are the worst.
_NUMBERS = [0, 1, 2**31 - 1, 2**31, 2**32 - 1]
_FLOATS = [math.nan, math.inf, -math.inf, 1e38, -0.0, 1e-40]
_BYTES = [
    *(struct.pack(f"{order}I", number) for order in "<>" for number in _NUMBERS),
    *(struct.pack("<f", number) for number in _FLOATS),
    *(struct.pack("<d", number) for number in (math.nan, math.inf, 1e300, -1e9)),
    *(struct.pack("<Q", number) for number in (2**63, 2**64 - 1, 10**12)),
    bytes(64),
]
_LETTERS = [bytes([letter]) for letter in b'0123456789-.e, \n\t"[]{}:;']
_WORDS = [b"nan", b"-inf", b"1e999", b"99999999999", b"null", b"\xff\xfe", b"\0"]


def edits() -> st.SearchStrategy[list[Edit]]:
    """One to three changes of a file."""
    put = st.sampled_from(_BYTES) | st.binary(min_size=1, max_size=4)
    where, head = st.floats(0.0, 1.0, exclude_max=True), st.booleans()
    some = st.one_of(
        st.builds(Edit, st.sampled_from(["cut", "double"]), where, st.just(False), st.just(b"")),
        st.builds(Edit, st.just("put"), where, head, put),
        st.builds(Edit, st.just("digit"), where, head, st.sampled_from([*_LETTERS, *_WORDS])),
    )
    return st.lists(some, min_size=1, max_size=3)


def edited(content: bytes, changes: list[Edit]) -> bytes:
    """A file after changes, one after the other."""
    for kind, where, head, value in changes:
        size = min(len(content), 600) if head else len(content)
        at = int(where * size)
        if kind == "cut":
            content = content[:at]
        elif kind == "double":
            content = content + content[at:]
        else:
            if kind == "digit":  # text stays text
                while at < len(content) and content[at] not in b"0123456789.-":
                    at += 1
            content = content[:at] + value + content[at + len(value) :]
    return content
