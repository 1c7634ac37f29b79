"""The one signature of pile state predictors. Paper, section 4.5."""

from __future__ import annotations

from typing import ClassVar, Protocol, runtime_checkable

from jaxtyping import Array, Float

from wlplan.types import LocalHeightmap


@runtime_checkable
class PileStatePredictor(Protocol):
    """φ: how a loading changes the local heightmap.

    Attributes:
        conserves_volume: Whether exactly the volume that it is given leaves the map. If not, it
            ignores volume and floor, and what leaves is its own prediction.
    """

    conserves_volume: ClassVar[bool]

    def __call__(
        self,
        local: LocalHeightmap,
        action: Float[Array, "4"],
        volume: Float[Array, ""],
        ground: Float[Array, "52 52"],
    ) -> Float[Array, "52 52"]:
        """The change of the local heightmap by a loading [m].

        Args:
            local: Local heightmap of 52 × 52 cells.
            action: Parameters of the bucket-filling controller.
            volume: Volume that leaves the pile [m³].
            ground: Floor under the pile over the reference of the local heightmap [m].

        Raises:
            InputError: If the map has another number of cells, or cells of another size.
        """
