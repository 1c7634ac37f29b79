"""What a plan is worth: named, weighted terms of each loading, and constraints."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from wlplan.errors import InputError
from wlplan.planning.loading import Loading
from wlplan.planning.objectives import OBJECTIVES
from wlplan.planning.terms import TERMS, Term


@dataclasses.dataclass(frozen=True)
class Constraint:
    """A term that says by how much a loading violates something; 0 or less where it does not.

    A violation costs `penalty` times itself. It is reported besides, in the term's own unit.
    """

    violation: Term
    # Cost of one unit of violation; a typical loading costs 4.
    penalty: float = 10.0


class Objective:
    """Cost of a loading, to be made small: the sum of weighted terms. A plan costs the sum of all.

    Args:
        terms: Name -> weight of a term of `TERMS`; or a function of a loading, which counts once;
            or a pair of weight and function; or a `Constraint`. In the order of the sum.

    Raises:
        InputError: If there are none, a name is unknown, or a weight is not finite.
    """

    def __init__(self, terms: Mapping[str, Any]):
        if not isinstance(terms, Mapping) or not terms:
            raise InputError(
                f"an objective is made of named terms, such as {{'mass': 2.0, 'time': 1.0}}, not "
                f"of {terms!r}."
            )
        self._terms = tuple((name, *_term(name, value)) for name, value in terms.items())

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the terms."""
        return tuple(name for name, _, _ in self._terms)

    @property
    def constraints(self) -> tuple[str, ...]:
        """Names of the terms that are constraints."""
        return tuple(name for name, _, term in self._terms if isinstance(term, Constraint))

    @property
    def needs(self) -> dict[str, str]:
        """What the world has to know for each term that needs more of it than the outcome.

        Names of terms -> names in `wlplan.worlds.capabilities.FORESIGHT`.
        """
        found: dict[str, str] = {}
        for name, _, term in self._terms:
            needs = getattr(_function(term), "needs", {})
            found |= {name: needs} if isinstance(needs, str) else needs
        return found

    @property
    def asks_world(self) -> bool:
        """Whether a term may look at the world: one that does, or a function of a user's."""
        return any(_asks_world(_function(term)) for _, _, term in self._terms)

    def values(self, loading: Loading) -> dict[str, Float[Array, ""]]:
        """Each term of a loading without its weight; of a constraint the violation, never < 0.

        Raises:
            InputError: If a term is no scalar.
        """
        return {name: _value(name, term, loading) for name, _, term in self._terms}

    def cost(self, values: Mapping[str, Float[Array, "*n"]]) -> Float[Array, "*n"]:
        """Cost of the terms of a loading, or of those of several."""
        total, *more = (weight * values[name] for name, weight, _ in self._terms)
        for part in more:
            total = total + part
        return total

    def __call__(self, loading: Loading) -> Float[Array, ""]:
        """Cost of a loading [1]."""
        return self.cost(self.values(loading))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Objective) and self._terms == other._terms

    def __hash__(self) -> int:
        return hash(self._terms)

    def __repr__(self) -> str:
        parts = ", ".join(f"{name!r}: ({weight:g}, {term!r})" for name, weight, term in self._terms)
        return f"Objective({{{parts}}})"


def _term(name: str, value: Any) -> tuple[float, Term | Constraint]:
    """Weight and function of a term as users write it."""
    weight, term = 1.0, value
    if isinstance(value, Constraint):
        weight = value.penalty
    elif isinstance(value, tuple | list) and len(value) == 2:
        weight, term = value if callable(value[1]) else value[::-1]
    elif not callable(value):
        if name not in TERMS:
            raise InputError(
                f"unknown term {name!r} of an objective: choose one of {', '.join(TERMS)}, or give "
                f"a function of a loading."
            )
        weight, term = value, TERMS[name]
    is_number = isinstance(weight, int | float) and not isinstance(weight, bool)
    if not is_number or not math.isfinite(weight) or not callable(_function(term)):
        raise InputError(
            f"the term {name!r} of an objective is {value!r}: give a weight, a function of a "
            f"loading, or a pair of both."
        )
    return float(weight), term


def _function(term: Any) -> Any:
    return term.violation if isinstance(term, Constraint) else term


def _asks_world(function: Any) -> bool:
    if isinstance(function, Objective):
        return function.asks_world
    return hasattr(function, "needs") or function not in TERMS.values()


def _value(name: str, term: Term | Constraint, loading: Loading) -> Array:
    value = jnp.asarray(_function(term)(loading))
    if value.shape != ():
        raise InputError(
            f"the term {name!r} of the objective has shape {value.shape} for one loading: it has "
            f"to be one number."
        )
    return jax.nn.relu(value) if isinstance(term, Constraint) else value


def objective_of(value: str | Objective | Mapping[str, Any] | Callable[..., Any]) -> Objective:
    """The objective that is meant by a name, a mapping of terms, or a function of a loading.

    Raises:
        InputError: If it is none of them.
    """
    if isinstance(value, Objective):
        return value
    if isinstance(value, str):
        if value not in OBJECTIVES:
            raise InputError(f"unknown objective {value!r}: choose one of {', '.join(OBJECTIVES)}.")
        return Objective(OBJECTIVES[value])
    if isinstance(value, Mapping):
        return Objective(value)
    if callable(value):
        return Objective({getattr(value, "__name__", type(value).__name__): value})
    raise InputError(
        f"the objective is of type {type(value).__name__}: give a name, an Objective, or a "
        f"function of a loading."
    )
