"""What a file may ask of time and memory: as much as its size warrants, and never more than this.

A small file may claim to hold any number of points, or unpack to any size. What its readers do
with such a claim is decided here, before anything is set aside for it.
"""

from __future__ import annotations

from wlplan.errors import InputError

MOST_UNPACKED = 2 << 30
"""Most bytes that a file may unpack to, however small it is."""

# Points that any file may hold, and how many more a byte of it may stand for: the best that is
# known of compressed surveys is some points a byte.
_FREE_POINTS, _POINTS_A_BYTE = 20_000_000, 4


def check_unpacked(size: int) -> None:
    """Refuses what would fill the memory.

    Args:
        size: Bytes that a part of a file says it unpacks to.

    Raises:
        InputError: If they are too many, or less than none.
    """
    if not 0 <= size <= MOST_UNPACKED:
        raise InputError(
            f"unpacks to {size / 2**30:.3g} GiB, and at most {MOST_UNPACKED / 2**30:g} are taken: "
            f"export the part around the pile."
        )


def check_points(count: int, size: int) -> None:
    """Refuses a number of points that a file cannot hold.

    Args:
        count: Points that it says it holds.
        size: Its size in bytes.

    Raises:
        InputError: If they are too many, or less than none.
    """
    if not 0 <= count <= max(_FREE_POINTS, _POINTS_A_BYTE * size):
        raise InputError(
            f"says it holds {count} points in {size} bytes: it is damaged; copy or export it again."
        )
