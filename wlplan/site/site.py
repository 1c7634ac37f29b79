"""A site: who digs, what is dug, and what stands around the pile."""

from __future__ import annotations

from typing import no_type_check

from flax import struct
from jaxtyping import Array, Bool, Int

from wlplan.site.frame import LOCAL, Frame
from wlplan.site.machine import WA320, WheelLoader
from wlplan.site.polygon import Polygon
from wlplan.site.receiver import Receiver, receiver_for
from wlplan.site.soil import GRAVEL, Soil


@no_type_check
class Site(struct.PyTreeNode):
    """What a job takes for given, one value from the command line down to transport and toe."""

    machine: WheelLoader = struct.field(pytree_node=False, default=WA320)
    soil: Soil = struct.field(pytree_node=False, default=GRAVEL)
    receiver: Receiver | None = None  # None: a place beside whatever pile there is
    keep_out: Bool[Array, "nx ny"] | None = None  # cells of the pile's grid closed to traffic
    truck_area: tuple[Polygon, ...] | None = None  # a truck stands inside one; None: anywhere
    frame: Frame = struct.field(pytree_node=False, default=LOCAL)  # that everything here is in

    @property
    def placed_receiver(self) -> Receiver:
        """The receiver of a site that is beside a pile."""
        assert self.receiver is not None, "a site has its receiver once it is beside a pile"
        return self.receiver

    def of_truck(self, truck: Int[Array, ""] | int | None) -> Site:
        """The site as loads of a truck, counted from 0, have it: with the receiver of that one."""
        if truck is None:
            return self
        site: Site = self.replace(receiver=receiver_for(self.placed_receiver, truck))
        return site
