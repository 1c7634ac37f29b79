"""The options that say how much is to be loaded."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any

import click

from wlplan.cli.values import FiniteRange
from wlplan.constants import (
    DEFAULT_LOADS,
    EXCHANGES,
    MOST_LOADS,
    MOST_REMAINING,
    MOST_TONNES,
    MOST_TRUCKS,
    PAYLOADS,
)

if TYPE_CHECKING:
    from wlplan.planning.amounts import Amount


def amount_options(command: Any) -> Any:
    """A decorator: the options, as one argument `amount`, a function that makes it."""

    @functools.wraps(command)
    def gathered(
        *,
        loads: int | None,
        tonnes: float | None,
        trucks: int | None,
        payload: float | None,
        exchange: float | None,
        empty: bool,
        remaining: float | None,
        **others: Any,
    ) -> Any:
        given = {"--loads": loads, "--tonnes": tonnes, "--trucks": trucks, "--empty": empty or None}
        named = [name for name, value in given.items() if value is not None]
        if len(named) > 1:
            raise click.UsageError(f"{' and '.join(named)} do not go together: give one of them.")
        if (trucks is None) != (payload is None):
            raise click.UsageError("--trucks K and --payload T go together: give both.")
        if exchange is not None and trucks is None:
            raise click.UsageError("--exchange goes with --trucks.")
        if remaining is not None and not empty:
            raise click.UsageError("--remaining goes with --empty.")

        def amount() -> Amount:
            from wlplan.planning.amounts import Empty, Loads, Tonnes, Trucks

            if tonnes is not None:
                return Tonnes(tonnes)
            if trucks is not None and payload is not None:
                filled = Trucks(trucks, payload)
                return filled if exchange is None else filled.replace(exchange=exchange)
            if empty:
                return Empty() if remaining is None else Empty(remaining / 100.0)
            return Loads(DEFAULT_LOADS if loads is None else loads)

        return command(amount=amount, **others)

    found: Any = gathered
    for option in reversed(_OPTIONS):
        found = option(found)
    return found


_OPTIONS = (
    click.option(
        "--loads",
        type=click.IntRange(1, MOST_LOADS),
        default=None,
        help=f"Number of bucket loads. Default: {DEFAULT_LOADS}, if no other amount is given.",
    ),
    click.option(
        "--tonnes",
        type=FiniteRange(0.0, MOST_TONNES, min_open=True),
        default=None,
        help="Tonnes to be loaded, in as many loads as it takes.",
    ),
    click.option(
        "--trucks",
        type=click.IntRange(1, MOST_TRUCKS),
        default=None,
        help="Number of trucks to be filled, each with whole buckets to its --payload.",
    ),
    click.option(
        "--payload",
        type=FiniteRange(*PAYLOADS),
        default=None,
        help="Payload of a truck [t]: it is met to 5 % where that can be done, and never "
        "exceeded by more than 10 %.",
    ),
    click.option(
        "--exchange",
        type=FiniteRange(*EXCHANGES),
        default=None,
        help="How long the loader waits from one truck to the next [s]. Default: 30.",
    ),
    click.option(
        "--empty",
        is_flag=True,
        help="Load all of the pile, as long as loads are worth it.",
    ),
    click.option(
        "--remaining",
        type=FiniteRange(0.0, MOST_REMAINING),
        default=None,
        help="With --empty: part of the volume that may remain [%]. Default: 2.",
    ),
)
