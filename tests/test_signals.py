"""A process that is told to end: the best plan so far is written, one line says so, code 130."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from cones import wide_cone

from wlplan.io import write_pile

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(os.name != "posix", reason="signals are of POSIX"),
]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_best_plan_so_far_is_written(tmp_path: Path, number: signal.Signals) -> None:
    write_pile(tmp_path / "pile.npz", wide_cone())
    kept = tmp_path / "kept"
    environment = {
        **os.environ,
        "PYTHONPATH": f"{Path(__file__).parent}",
        "WLPLAN_CACHE": f"{kept}",
    }
    environment.pop("JAX_COMPILATION_CACHE_DIR")
    words = "-m wlplan plan pile.npz --loads 2 --world cones:bowl_world --no-referee"
    words += " --planner waiting:Waits --out out"
    process = subprocess.Popen(
        [sys.executable, *words.split()],
        cwd=tmp_path,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "searching\n"
    process.send_signal(number)
    said, told = process.communicate()
    assert process.returncode == 130, told
    assert "ended early, by hand" in told
    assert "Traceback" not in told
    assert len(json.loads((tmp_path / "out" / "plan.json").read_text())["loads"]) == 2
    assert "t/h" in said
    # What was compiled is not in doubt: the process came to its end.
    assert [path for path in kept.glob("*/running/*") if path.is_file()] == []
