"""Searches for faults for as long as one likes: `make fuzz SECONDS=600`.

Runs the laws that hypothesis checks with random examples, many more than the tests have, until the
time is up. What it finds is printed as the smallest example; a file that breaks a reader is kept in
out/fuzz, to be named after what is wrong with it and added to tests/corpus/scans.
"""

from __future__ import annotations

import argparse
import itertools
import os
import subprocess
import sys
import time
from pathlib import Path

HERE = Path(__file__).parent
LAWS = ("readers_fuzz", "options_fuzz", "store_machine", "numerics")


def main() -> int:
    """Searches; returns 1 if something was found."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=600.0, help="how long to search")
    end = time.monotonic() + parser.parse_args().seconds
    found = 0
    for times, law in zip(itertools.count(2), itertools.cycle(LAWS), strict=False):
        left = end - time.monotonic()
        if left <= 0.0:
            break
        words = ["-n", "0", "-q", "-m", "slow or not slow", f"tests/test_{law}.py"]
        print(f"{left:5.0f} s left: {law}, {times} times the examples", flush=True)
        process = subprocess.Popen(
            [sys.executable, "-m", "pytest", *words],
            cwd=HERE.parent,
            env={**os.environ, "WLPLAN_FUZZ": str(times)},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        try:
            said, _ = process.communicate(timeout=left)
        except subprocess.TimeoutExpired:
            # Nothing was found so far, or pytest would be making it smaller.
            process.terminate()
            process.communicate()
            break
        if process.returncode != 0:
            found += 1
            print(said)
    files = sorted(path.name for path in (HERE.parent / "out" / "fuzz").glob("found*"))
    for name in files:
        print(f"out/fuzz/{name}: name it after what is wrong, and add it to tests/corpus/scans")
    print("found nothing" if not found else f"{found} runs found something, see above")
    return min(found, 1)


if __name__ == "__main__":
    sys.exit(main())
