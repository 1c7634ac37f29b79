"""`python -m experiments`: the list of experiments; with a name, that one; with "all", all."""

from __future__ import annotations

import argparse
import difflib
import runpy
import sys

from experiments._common import catalogue, everything
from experiments._common.places import say


def main(arguments: list[str]) -> int:
    """Lists the experiments, or runs what is named first with the words behind it."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments",
        description="Lists the experiments, or runs one of them, or all.",
    )
    parser.add_argument("name", nargs="?", help="of one, which then takes the other words; or all")
    parser.add_argument("words", nargs=argparse.REMAINDER, help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    found = catalogue.experiments()
    if options.name is None:
        print(catalogue.table(found))
        print(f"\nCollects data, and has options of its own: {', '.join(catalogue.recipes())}")
        return 0
    if options.name == "all":
        return everything.main(options.words)
    names = [*(one.name for one in found), *catalogue.recipes()]
    if options.name not in names:
        near = difflib.get_close_matches(options.name, [*names, "all"], n=1)
        hint = f"did you mean {near[0]}?" if near else "`python -m experiments` lists them."
        say(f"error: There is no experiment {options.name!r}: {hint}")
        return 2
    sys.argv[1:] = options.words
    runpy.run_module(f"experiments.{options.name}", run_name="__main__", alter_sys=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
