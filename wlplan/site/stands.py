"""The different places of trucks, by who stands there; without JAX."""

from __future__ import annotations

from collections.abc import Hashable, Sequence


def stands(places: Sequence[Hashable]) -> list[tuple[str, int]]:
    """Who stands at each of the different places, in words, and the first of these trucks.

    Trucks are named by numbers from 1 on where there is more than one place.

    Args:
        places: Of each truck in turn; one, if it is that of all.
    """
    trucks_at: dict[Hashable, list[int]] = {}
    for number, place in enumerate(places):
        trucks_at.setdefault(place, []).append(number)
    if len(trucks_at) == 1:
        return [("truck", 0)]
    return [
        (f"truck{'s'[: len(numbers) > 1]} {', '.join(str(n + 1) for n in numbers)}", numbers[0])
        for numbers in trucks_at.values()
    ]
