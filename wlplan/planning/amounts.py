"""How much is to be loaded: a number of loads, tonnes, trucks, or all there is.

An amount follows what is done, load by load, and says when a truck leaves and when the job is
done. Its numbers are leaves, so that what is compiled for 24 t serves 30 t.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any, ClassVar, NamedTuple, no_type_check

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from wlplan.constants import KG_PER_TONNE
from wlplan.errors import InputError
from wlplan.site.site import Site
from wlplan.site.soil import Soil
from wlplan.types import Pile

MISFIT_COST = 10.0
"""Cost of a tonne that a truck carries too much or too little; a typical loading costs 2 to 4."""

# The same of a tonne beyond the most that a truck may ever carry.
_OVERLOAD_COST = 100.0
# Smallest load that a bucket can be made to take, as a part of a typical one. Estimate.
_SMALLEST = 0.35
# Loads that are planned as one, about, and rows of such a plan: a third more.
_LOADS_AT_ONCE, _ROWS = 12, 16
# What is spared of later loads counts so much more than it is worth: full buckets come first, and
# the last one fits what the scale says by then.
_FULL_FIRST = 1.25
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


class Made(NamedTuple):
    """What was made so far, on the host."""

    loads: int = 0
    mass: float = 0.0  # [tonne]
    trucks: int = 0  # that have left


class Outlook(NamedTuple):
    """What the next loads will be like, as far as one knows."""

    cost: Float[Array, ""]  # of the load that costs least a tonne
    mass: Float[Array, ""]  # of it [tonne]
    full_cost: Float[Array, ""]  # of the fullest load that is worth it
    full_mass: Float[Array, ""]  # of it [tonne]
    spare: Float[Array, ""]  # what a tonne less in a load saves
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
    """How much is to be loaded; kinds of amounts override what differs."""

    # What a plan is to minimise if nobody says.
    objective: ClassVar[str] = "delivery"

    def of(self, pile: Pile, soil: Soil) -> Amount:
        """The amount for a pile, where it depends on it."""
        del pile, soil
        return self

    def part(self, made: Made, typical: float) -> tuple[Amount, int] | None:
        """What is to be planned next as one, and rows of a plan for it: the most loads it takes.

        Args:
            made: What was made so far.
            typical: Load of a typical bucket [tonne].

        Returns:
            None when nothing is left. By default all is one part.
        """
        del typical
        return None if made.loads else (self, _ROWS)

    def least_load(self) -> float | Array:
        """Least load that is made [tonne].

        If it is above 0, each heap that holds so much is dug, and not the largest alone.
        """
        return 0.0

    def shortfall(self, mass: Float[Array, ""]) -> Float[Array, ""]:
        """What a load [tonne] below the least counts beside its cost, where loads compare."""
        return jnp.zeros_like(mass)

    def is_done(self, done: Done) -> Bool[Array, ""]:
        """Whether no further load is wanted; by default a plan ends with its rows."""
        del done
        return jnp.zeros((), bool)

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

    def rest(self, done: Done) -> Float[Array, ""]:
        """What a plan that ends here costs beside its loads."""
        return MISFIT_COST * self.missing(done)

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

    objective: ClassVar[str] = "efficiency"
    count: int | Array

    def part(self, made: Made, typical: float) -> tuple[Amount, int] | None:
        """All of them, or of many about a dozen."""
        del typical
        count, left = int(self.count), int(self.count) - made.loads
        if left <= 0:
            return None
        if count <= _ROWS:
            return self, count
        rows = math.ceil(count / math.ceil(count / _LOADS_AT_ONCE))
        return SomeLoads(min(left, rows)), rows

    def is_done(self, done: Done) -> Bool[Array, ""]:
        """Once all are made."""
        return done.loads >= self.count


@no_type_check
class SomeLoads(Amount):
    """A part of many `Loads`, of as many rows as the others; of the last not all need be made."""

    count: int | Array

    def is_done(self, done: Done) -> Bool[Array, ""]:
        """Once all are made."""
        return done.loads >= self.count


@no_type_check
class Tonnes(Amount):
    """As many loads as it takes to move so much."""

    mass: float | Array  # [tonne]
    # Whether this is part of more, and what a tonne of that costs.
    follows: bool | Array = False
    price: float | Array = 0.0

    def part(self, made: Made, typical: float) -> tuple[Amount, int] | None:
        """A dozen loads."""
        left, at_once = float(self.mass) - made.mass, _LOADS_AT_ONCE * typical
        if left <= 0.0:
            return None
        # The last part is no small rest.
        follows = left > 1.25 * at_once
        mass = at_once if follows else left
        return self.replace(mass=mass, follows=follows), _ROWS

    def is_done(self, done: Done) -> Bool[Array, ""]:
        """Once it is moved."""
        return done.mass >= self.mass

    def missing(self, done: Done) -> Float[Array, ""]:
        """What is not moved yet [tonne]."""
        return jnp.maximum(self.mass - done.mass, 0.0)

    def rest(self, done: Done) -> Float[Array, ""]:
        """Of a part: what is done too little or too much is done more or less in the next."""
        return self._rest(done, self.follows)

    def _rest(self, done: Done, follows: Bool[Array, ""] | bool) -> Float[Array, ""]:
        next_part = self.price * (self.mass - done.mass)
        return jnp.where(follows, next_part, MISFIT_COST * self.missing(done))

    def to_go(self, done: Done, outlook: Outlook) -> Float[Array, ""]:
        """By the tonne, and at the end by the bucket: the last is made whatever it holds."""
        rest = self.mass - done.mass
        by_bucket = _by_passes(rest, 3, outlook).min()
        by_tonne = outlook.cost / outlook.mass * rest
        many = self.follows | (rest > 2.0 * outlook.mass)
        by_load = jnp.where(many, by_tonne, by_bucket)
        return jnp.where(outlook.price > 0.0, outlook.price * rest, by_load)


@no_type_check
class Empty(Amount):
    """All of a pile but a part of its volume, as long as loads are worth it."""

    remaining: float | Array = 0.02  # of the volume
    # Least load that is made [tonne]. Estimate: what is less takes longer to fetch than to leave.
    least: float | Array = 0.8

    def of(self, pile: Pile, soil: Soil) -> Amount:
        """The mass by the volume of the pile."""
        above = np.maximum(np.asarray(pile.height - pile.floor, np.float64), 0.0)
        mass = float(above.sum()) * pile.cell_size**2 * soil.density / KG_PER_TONNE
        return Emptying(mass=(1.0 - float(self.remaining)) * mass, least=float(self.least))


@no_type_check
class Emptying(Tonnes):
    """`Empty` of a pile that is known."""

    least: float | Array = 0.8

    def part(self, made: Made, typical: float) -> tuple[Amount, int] | None:
        """A dozen loads, counted by the tonne: the end is where loads are not worth it."""
        found = super().part(made, typical)
        return found and (found[0].replace(follows=True), found[1])

    def least_load(self) -> float | Array:
        """As of `Empty`."""
        return self.least

    def shortfall(self, mass: Float[Array, ""]) -> Float[Array, ""]:
        """Of what it lacks of the least.

        By the price of a tonne alone the end of a pile would be a load of next to nothing, which
        is not made, with loads that are worth it beside it.
        """
        return MISFIT_COST * jnp.maximum(self.least - mass, 0.0)

    def rest(self, done: Done) -> Float[Array, ""]:
        """As of `Tonnes`, but nothing follows a plan that ends early: no load was worth it.

        By the price of a tonne alone such a plan would be better than one that goes on, since the
        last tonnes are the dearest.
        """
        to_the_end = (done.mass >= self.mass) | (done.loads >= _ROWS)
        return self._rest(done, self.follows & to_the_end)


@no_type_check
class Trucks(Amount):
    """So many trucks, each filled with whole buckets to its payload."""

    count: int | Array
    payload: float | Array  # [tonne]
    # How long the loader stands still between two trucks [s].
    exchange: float | Array = 30.0
    # By how much the load may be off, and what it must never be over, as parts of the payload:
    # the rules of many sites. Truck makers let one load in ten be over 110 %.
    tolerance: float | Array = 0.05
    limit: float | Array = 1.10
    # Trucks that come after these.
    follows: int | Array = 0

    def part(self, made: Made, typical: float) -> tuple[Amount, int] | None:
        """As many trucks as a dozen loads fill, at least one."""
        passes = self._typical_passes(typical)
        rows = max(_ROWS, passes + _ROWS - _LOADS_AT_ONCE)
        return self._next(made, max(1, _LOADS_AT_ONCE // passes), rows)

    def next_truck(self, made: Made, typical: float) -> tuple[Amount, int] | None:
        """The next truck alone, as `part`."""
        return self._next(made, 1, self._typical_passes(typical) + _ROWS - _LOADS_AT_ONCE)

    def _typical_passes(self, typical: float) -> int:
        return math.ceil(float(self.payload) / typical)

    def _next(self, made: Made, at_once: int, rows: int) -> tuple[Amount, int] | None:
        left = int(self.count) - made.trucks
        if left <= 0:
            return None
        # The wait for the truck after the last of this part is part of it.
        return self.replace(count=min(at_once, left), follows=int(at_once < left)), rows

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
        another = leaves & (trucks < self.count + self.follows)
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
    spared = jnp.clip(passes * outlook.mass - rest, 0.0, passes * (1.0 - _SMALLEST) * outlook.mass)
    loads = passes * outlook.cost - _FULL_FIRST * outlook.spare * spared
    return loads + dearer * fuller + MISFIT_COST * (short - fuller)


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
        if int(amount.count) < 1:
            raise InputError(f"{amount.count} loads were asked for: ask for at least 1.")
        return
    numbers = {
        field.name: float(getattr(amount, field.name)) for field in dataclasses.fields(amount)
    }
    if isinstance(amount, Empty):
        if not 0.0 <= numbers["remaining"] < 1.0:
            raise InputError(f"{numbers['remaining']:g} of the pile is to remain: give a part.")
        return
    for name, value in numbers.items():
        may_be_nothing = name in ("exchange", "tolerance", "follows", "price")
        if not (0.0 < value < 1e9 or (may_be_nothing and value == 0.0)):
            raise InputError(f"the {name} of an amount is {value:g}: it has to be positive.")
    if isinstance(amount, Trucks) and numbers["limit"] < 1.0 + numbers["tolerance"]:
        raise InputError("trucks may be over their payload by less than the tolerance allows.")


AMOUNTS: dict[str, tuple[type[Amount], tuple[str, ...]]] = {
    "loads": (Loads, ("count",)),
    "tonnes": (Tonnes, ("mass",)),
    "trucks": (Trucks, ("count", "payload", "exchange", "tolerance", "limit")),
    "empty": (Empty, ("remaining", "least")),
}
"""Amounts by the name that plan.json has for them, and what each is given by."""


def amount_fields(amount: Amount) -> dict[str, Any]:
    """What plan.json says about an amount, as `amount_recorded` reads it."""
    for name, (kind, given) in AMOUNTS.items():
        if type(amount) is kind:
            return {"amount": name} | {
                key: np.asarray(getattr(amount, key)).item() for key in given
            }
    return {"amount": type(amount).__name__}


def amount_recorded(record: object) -> Amount | None:
    """The amount that a plan.json records; None if it records none that can be read.

    Raises:
        InputError: If it makes no sense.
    """
    name = record.get("amount") if isinstance(record, dict) else None
    if not isinstance(record, dict) or not isinstance(name, str) or name not in AMOUNTS:
        return None
    kind, given = AMOUNTS[name]
    numbers = {name: record[name] for name in given if name in record}
    if not all(isinstance(v, int | float) and not isinstance(v, bool) for v in numbers.values()):
        return None
    try:
        amount = kind(**numbers)
    except TypeError:
        return None
    check_amount(amount)
    return amount
