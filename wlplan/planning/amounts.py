"""How much is to be loaded: a number of loads, tonnes, trucks, or all there is.

An amount follows what is done, load by load, and says when a truck leaves and when the job is
done. Its numbers are leaves, so that what is compiled for 24 t serves 30 t.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple, no_type_check

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from wlplan.constants import KG_PER_TONNE
from wlplan.errors import InputError
from wlplan.site.site import Site

MISFIT_COST = 10.0
"""Cost of a tonne that a truck carries too much or too little; a typical loading costs 2 to 4."""

# The same of a tonne beyond the most that a truck may ever carry.
_OVERLOAD_COST = 100.0
# Smallest load that a bucket can be made to take, as a part of a typical one. Estimate.
_SMALLEST = 0.35
# Passes that are considered to fill what is left of a truck.
_PASSES = 16


@no_type_check
class Done(struct.PyTreeNode):
    """What of a job is done."""

    loads: Int[Array, "*n"]
    mass: Float[Array, "*n"]  # of all of them [tonne]
    trucks: Int[Array, "*n"]  # that have left
    aboard: Float[Array, "*n"]  # of the one that is there [tonne]


def nothing_done(dtype: Any) -> Done:
    """Before the first load."""
    none, nothing = jnp.zeros((), jnp.int32), jnp.zeros((), dtype)
    return Done(none, nothing, none, nothing)


class Outlook(NamedTuple):
    """What the next loads will be like, as far as one knows."""

    cost: Float[Array, ""]  # of the load that costs least a tonne
    mass: Float[Array, ""]  # of it [tonne]
    full_cost: Float[Array, ""]  # of the fullest load that is worth it
    full_mass: Float[Array, ""]  # of it [tonne]
    # What a tonne that is left counts; 0: loads are counted. So one finds these two loads.
    price: Float[Array, ""]


class Step(NamedTuple):
    """What a load comes to, beside what it yields."""

    done: Done
    wait: Float[Array, ""]  # until the next truck is there [s]
    misfit: Float[Array, ""]  # what the truck that leaves carries too much or too little [tonne]
    cost: Float[Array, ""]  # of that


@no_type_check
class Amount(struct.PyTreeNode):
    """A number of loads; the other amounts differ in what they override."""

    def rows(self, typical: float) -> int:
        """Rows of a plan: the most loads that it takes.

        Args:
            typical: Load of a typical bucket [tonne].
        """
        raise NotImplementedError

    def is_done(self, done: Done) -> Bool[Array, ""]:
        """Whether no further load is wanted."""
        raise NotImplementedError

    def step(self, done: Done, mass: Float[Array, ""], leaves: Bool[Array, ""] | None) -> Step:
        """One load more.

        Args:
            done: Before it.
            mass: Of the load [tonne].
            leaves: Whether the truck leaves after it; None: as the amount has it.
        """
        del leaves
        nothing = jnp.zeros_like(mass)
        one = done.replace(loads=done.loads + 1, mass=done.mass + mass, aboard=done.aboard + mass)
        return Step(one, nothing, nothing, nothing)

    def missing(self, done: Done) -> Float[Array, ""]:
        """What is not done when a plan ends [tonne]."""
        return jnp.zeros_like(done.mass)

    def to_go(self, done: Done, outlook: Outlook) -> Float[Array, ""]:
        """Cost of what is left, with loads as they are now; comparable at one point of a job."""
        del outlook
        return jnp.zeros_like(done.mass)

    def should_leave(self, done: Done, outlook: Outlook) -> Bool[Array, ""]:
        """Whether a truck with what it has aboard had better leave."""
        del done, outlook
        return jnp.zeros((), bool)


@no_type_check
class Loads(Amount):
    """So many loads, whatever they hold."""

    count: int = struct.field(pytree_node=False)

    def rows(self, typical: float) -> int:
        """The loads."""
        del typical
        return self.count

    def is_done(self, done: Done) -> Bool[Array, ""]:
        """Once all are made."""
        return done.loads >= self.count


@no_type_check
class Tonnes(Amount):
    """As many loads as it takes to move so much."""

    mass: Float[Array, ""]  # [tonne]

    def rows(self, typical: float) -> int:
        """A third more than with typical loads."""
        return max(1, math.ceil(1.33 * float(self.mass) / typical))

    def is_done(self, done: Done) -> Bool[Array, ""]:
        """Once it is moved."""
        return done.mass >= self.mass

    def missing(self, done: Done) -> Float[Array, ""]:
        """What is not moved yet [tonne]."""
        return jnp.maximum(self.mass - done.mass, 0.0)

    def to_go(self, done: Done, outlook: Outlook) -> Float[Array, ""]:
        """By the tonne, and at the end by the bucket: the last is made whatever it holds."""
        rest = self.mass - done.mass
        by_bucket = _by_passes(rest, 3, outlook).min()
        by_tonne = outlook.cost / outlook.mass * rest
        by_load = jnp.where(rest > 2.0 * outlook.mass, by_tonne, by_bucket)
        return jnp.where(outlook.price > 0.0, outlook.price * rest, by_load)


@no_type_check
class Trucks(Amount):
    """So many trucks, each filled with whole buckets to its payload."""

    count: Int[Array, ""]
    payload: Float[Array, ""]  # [tonne]
    # How long the loader stands still between two trucks [s].
    exchange: Float[Array, ""] = 30.0  # type: ignore[assignment]
    # By how much the load may be off, and what it must never be over, as parts of the payload.
    # Practice: 10-10-20 rules of truck makers, and site rules that are tighter on average loads.
    tolerance: Float[Array, ""] = 0.05  # type: ignore[assignment]
    limit: Float[Array, ""] = 1.10  # type: ignore[assignment]

    def rows(self, typical: float) -> int:
        """For each truck two passes more than with typical loads."""
        return int(self.count) * (math.ceil(float(self.payload) / typical) + 2)

    def is_done(self, done: Done) -> Bool[Array, ""]:
        """Once all have left."""
        return done.trucks >= self.count

    def step(self, done: Done, mass: Float[Array, ""], leaves: Bool[Array, ""] | None) -> Step:
        """A truck leaves once it is full, if nobody says otherwise."""
        aboard = done.aboard + mass
        if leaves is None:
            leaves = aboard >= (1.0 - self.tolerance) * self.payload
        misfit, cost = self._misfit(aboard)
        nothing = jnp.zeros_like(mass)
        trucks = done.trucks + leaves
        after = Done(done.loads + 1, done.mass + mass, trucks, jnp.where(leaves, 0.0, aboard))
        another = leaves & (trucks < self.count)
        return Step(
            after,
            jnp.where(another, self.exchange, nothing),
            jnp.where(leaves, misfit, nothing),
            jnp.where(leaves, cost, nothing),
        )

    def missing(self, done: Done) -> Float[Array, ""]:
        """What the trucks that did not leave lack [tonne]."""
        left = jnp.maximum(self.count - done.trucks, 0)
        return jnp.maximum(left * self.payload - done.aboard, 0.0)

    def to_go(self, done: Done, outlook: Outlook) -> Float[Array, ""]:
        """By the bucket, in as many passes as suit what is left of this truck."""
        by_tonne = outlook.price * (self.payload - done.aboard)
        return jnp.where(outlook.price > 0.0, by_tonne, self._by_passes(done, outlook).min())

    def should_leave(self, done: Done, outlook: Outlook) -> Bool[Array, ""]:
        """If no further pass makes it better."""
        return (done.aboard > 0.0) & (self._by_passes(done, outlook).argmin() == 0)

    def _misfit(self, aboard: Array) -> tuple[Array, Array]:
        """What a load is off by, beyond the tolerance [tonne], and the cost of it."""
        off = jnp.maximum(abs(aboard - self.payload) - self.tolerance * self.payload, 0.0)
        over = jnp.maximum(aboard - self.limit * self.payload, 0.0)
        return off, MISFIT_COST * off + _OVERLOAD_COST * over

    def _by_passes(self, done: Done, outlook: Outlook) -> Array:
        """Cost of filling the truck with 0, 1, 2... passes more."""
        rest, slack = self.payload - done.aboard, self.tolerance * self.payload
        passes = jnp.arange(_PASSES, dtype=rest.dtype)
        over = jnp.maximum(passes * _SMALLEST * outlook.mass - rest - slack, 0.0)
        beyond = jnp.maximum(done.aboard - self.limit * self.payload, 0.0)
        fill = _by_passes(rest - slack, _PASSES, outlook)
        return fill + MISFIT_COST * over + _OVERLOAD_COST * beyond


def _by_passes(rest: Array, count: int, outlook: Outlook) -> Array:
    """Cost of moving so much [tonne] with 0, 1, 2... loads, fuller ones where it takes them."""
    passes = jnp.arange(count, dtype=rest.dtype)
    short = jnp.maximum(rest - passes * outlook.mass, 0.0)
    room = jnp.maximum(outlook.full_mass - outlook.mass, 1e-3)
    fuller = jnp.minimum(short, passes * room)
    dearer = jnp.maximum(outlook.full_cost - outlook.cost, 0.0) / room
    return passes * outlook.cost + dearer * fuller + MISFIT_COST * (short - fuller)


def typical_load(site: Site) -> float:
    """A full bucket [tonne]."""
    soil = site.soil
    volume = site.machine.bucket_heaped * soil.fill_factor
    return volume * soil.density / KG_PER_TONNE


def check_amount(amount: Amount) -> None:
    """Refuses an amount that makes no sense.

    Raises:
        InputError: If a number of it is not positive, or there is too much of it.
    """
    if isinstance(amount, Loads):
        if amount.count < 1:
            raise InputError(f"{amount.count} loads were asked for: ask for at least 1.")
        return
    numbers = {name: float(getattr(amount, name)) for name in amount.__dataclass_fields__}
    for name, value in numbers.items():
        if not 0.0 < value < 1e9 and not (name in ("exchange", "tolerance") and value == 0.0):
            raise InputError(f"{name} is {value:g}: it has to be positive.")
