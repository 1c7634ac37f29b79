"""Kinds of values that options take: what each looks like, and what is no such value."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import click

from wlplan.constants import ACTION_HIGH, ACTION_LOW
from wlplan.errors import InputError
from wlplan.plugins import is_reference


class Numbers(click.ParamType):  # type: ignore[type-arg]
    """Finite numbers with commas between them.

    Args:
        form: Names of the numbers, as help and complaints show them.
        least: How many of them have to be given.
    """

    def __init__(self, form: str, least: int):
        self.name = form
        self._form = form
        self._counts = range(least, form.count(",") + 2)

    def get_metavar(self, param: click.Parameter, ctx: click.Context | None = None) -> str:
        """What stands for the value in the help."""
        return self._form

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, ...]:
        """The numbers of a text; numbers themselves are let pass, as click asks for."""
        if isinstance(value, tuple):
            return value
        try:
            numbers = tuple(float(part) for part in str(value).split(","))
        except ValueError:
            numbers = ()
        if len(numbers) not in self._counts or not all(math.isfinite(n) for n in numbers):
            self.fail(f"{value!r} is not of the form {self._form}, with finite numbers", param, ctx)
        return numbers


class ActionNumbers(Numbers):
    """The four parameters of the bucket-filling controller, inside their box."""

    def __init__(self) -> None:
        super().__init__("DELTA_BM,K_BM,DELTA_BK,K_BK", 4)

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, ...]:
        """The four parameters of a text."""
        numbers = super().convert(value, param, ctx)
        for name, number, low, high in zip(
            self.name.lower().split(","), numbers, ACTION_LOW, ACTION_HIGH, strict=True
        ):
            if not low <= number <= high:
                self.fail(
                    f"{name} is {number:g}, outside its range {low:g} to {high:g}", param, ctx
                )
        return numbers


class WholeNumbers(click.ParamType):  # type: ignore[type-arg]
    """Whole numbers with commas between them.

    Args:
        least: Least of each.
        most: Most of each.
        entries: How many of them may be given at most.
    """

    name = "N[,N...]"

    def __init__(self, least: int, most: int, entries: int):
        self._least, self._most, self._entries = least, most, entries

    def get_metavar(self, param: click.Parameter, ctx: click.Context | None = None) -> str:
        """What stands for the value in the help."""
        return self.name

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[int, ...]:
        """The numbers of a text; numbers themselves are let pass, as click asks for."""
        if isinstance(value, tuple):
            return value
        parts = str(value).split(",")
        if not all(re.fullmatch("[0-9]{1,9}", part) for part in parts):
            self.fail(f"{value!r} is not of the form {self.name}", param, ctx)
        if len(parts) > self._entries:
            self.fail(f"{value!r} holds more than {self._entries} numbers", param, ctx)
        numbers = tuple(map(int, parts))
        if not self._least <= min(numbers) <= max(numbers) <= self._most:
            self.fail(f"{value!r} holds a number outside {self._least} to {self._most}", param, ctx)
        return numbers


class ShardNumber(click.ParamType):  # type: ignore[type-arg]
    """Which part of a whole, counted from 1, and how many parts there are."""

    name = "I/N"

    def get_metavar(self, param: click.Parameter, ctx: click.Context | None = None) -> str:
        """What stands for the value in the help."""
        return self.name

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[int, int]:
        """Both numbers of a text; numbers themselves are let pass, as click asks for."""
        if isinstance(value, tuple):
            return value
        found = re.fullmatch("([0-9]{1,9})/([0-9]{1,9})", str(value))
        number, count = map(int, found.groups()) if found else (0, 0)
        if not 1 <= number <= count:
            self.fail(f"{value!r} is not of the form I/N with 1 <= I <= N", param, ctx)
        return number, count


class NameOrReference(click.ParamType):  # type: ignore[type-arg]
    """A name that the package knows, or `package.module:Name` of what somebody else wrote.

    Args:
        what: What is named, in words.
        names: Names that the package knows.
    """

    name = "NAME|MODULE:NAME"

    def __init__(self, what: str, names: Iterable[str]):
        self._what, self._names = what, tuple(names)

    def get_metavar(self, param: click.Parameter, ctx: click.Context | None = None) -> str:
        """What stands for the value in the help."""
        return self.name

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """The text, if it can be one of them."""
        text = str(value)
        if text not in self._names and not is_reference(text):
            self.fail(
                f"{text!r} is no {self._what}: choose one of {', '.join(self._names)}, or name "
                f"your own as package.module:Name",
                param,
                ctx,
            )
        return text


class LevelOrFile(click.ParamType):  # type: ignore[type-arg]
    """A height, or a file of heights of a kind that can be read."""

    name = "LEVEL|FILE"

    def get_metavar(self, param: click.Parameter, ctx: click.Context | None = None) -> str:
        """What stands for the value in the help."""
        return self.name

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float | str:
        """The level [m], or the name of the file."""
        from wlplan.io.readers import find_reader

        text = str(value)
        try:
            level = float(text)
        except ValueError:
            if not os.path.isfile(text):
                self.fail(f"{text!r} is neither a level in metres nor a file", param, ctx)
            try:
                find_reader(Path(text))
            except InputError as error:
                self.fail(str(error), param, ctx)
            return text
        if not math.isfinite(level):
            self.fail(f"{text!r} is no finite level", param, ctx)
        return level


class PlaceOrAuto(Numbers):
    """A place, or a word for leaving it to the planner."""

    def __init__(self) -> None:
        super().__init__("|".join(("X,Y[,HEADING_DEG]", *LEFT_TO_THE_PLANNER)), 2)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The numbers of a text, or the word itself."""
        return value if value in LEFT_TO_THE_PLANNER else super().convert(value, param, ctx)


LEFT_TO_THE_PLANNER = ("auto", "each")
"""What stands for trucks that the planner places: all in one place, or each in its own."""


class FiniteRange(click.FloatRange):
    """A number in a range; NaN is in none."""

    name = "number"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The number of a text."""
        number = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value!r} is not a finite number", param, ctx)
        return number
