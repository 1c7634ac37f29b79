"""Processes are killed at random moments, and what they were at ends with the same bytes."""

import itertools
import json
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from faults import Tree, tree

pytestmark = pytest.mark.slow

# How often what writes without a pause is killed; the others as often as `--kills` says.
KILLS_OF_WRITERS = 60

# Replaces a file and a folder, and adds to another, over and over.
WRITER = """
import itertools, sys
from pathlib import Path
from wlplan.io.files import atomic_folder, write_text_atomic
here = Path(sys.argv[1])
for n in itertools.count():
    write_text_atomic(here / "file", f"{n} " * 20_000)
    for existing in ("replace", "add"):
        with atomic_folder(here / existing, existing=existing) as new:
            for name in "abc":
                write_text_atomic(new / name, f"{n} " * 2_000)
    print(n, flush=True)
"""

COLLECTOR = """
import sys
from wlplan import cli
from wlplan.dataset import collecting, layout, episode, store, worker_pool
for part in (layout, episode, worker_pool, collecting, store):
    part.LOADS = 3
layout._BATCH = 2
store.command = lambda: "wlplan collect"
print("begun", flush=True)
sys.exit(cli.main(["collect", "--cycles", "120", "--seed", "7", "--quiet", "--out", sys.argv[1]]))
"""

TRAINER = """
import sys
sys.path[:0] = sys.argv[2:]
from test_training import LIGHT, synthetic
from wlplan.training import fitting, train
fitting._SAVE_EVERY = 0.0
data = synthetic()
print("begun", flush=True)
train(LIGHT, data, out=sys.argv[1])
"""


def start(program: str, *words: object) -> subprocess.Popen[str]:
    """A process that says a line when it has begun."""
    process = subprocess.Popen(
        [sys.executable, "-c", program, *map(str, words)], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline()
    return process


def kill_after(process: subprocess.Popen[str], seconds: float) -> bool:
    """Kills a process after a while; whether it had not ended by itself."""
    time.sleep(seconds)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    return process.returncode == -signal.SIGKILL


def test_what_a_killed_process_was_writing_is_whole(tmp_path: Path) -> None:
    """A file, and a folder that is replaced; of one that is added to, each file."""
    moments = random.Random(0)
    for _ in range(KILLS_OF_WRITERS):
        assert kill_after(start(WRITER, tmp_path), moments.uniform(0.0, 0.1))
        words = (tmp_path / "file").read_text().split()
        assert len(words) == 20_000
        assert len(set(words)) == 1
        for name in ("replace", "add"):
            found = {path.name: path.read_text().split() for path in visible(tmp_path / name)}
            assert sorted(found) == ["a", "b", "c"]
            assert all(len(words) == 2_000 and len(set(words)) == 1 for words in found.values())
            if name == "replace" and sys.platform == "linux":
                assert len({words[0] for words in found.values()}) == 1


def visible(folder: Path) -> list[Path]:
    """What is in a folder and not hidden."""
    return [path for path in folder.iterdir() if not path.name.startswith(".")]


def check_ends_alike(
    program: str, tmp_path: Path, name: str, kills: int, same: Callable[[Path], object], *words: str
) -> None:
    """Runs whole, and in another folder killed `kills` times before it runs to its end."""
    whole, cut = tmp_path / "whole" / name, tmp_path / "cut" / name
    for path in (whole, cut):
        path.parent.mkdir()
    begin = time.monotonic()
    process = start(program, whole, *words)
    process.communicate()
    assert process.returncode == 0
    length = time.monotonic() - begin
    moments = random.Random(1)
    killed, ends = 0, 0
    for attempt in itertools.count():
        assert attempt < 4 * kills
        if killed == kills:
            break
        # What it can have done by then it keeps, so each has less to do than the one before.
        if kill_after(start(program, cut, *words), moments.uniform(0.0, 0.8 * length)):
            killed += 1
        else:
            # It got through, and that is the same: once more from the start.
            assert same(cut) == same(whole)
            ends += 1
            for path in sorted(cut.parent.rglob("*"), reverse=True):
                path.rmdir() if path.is_dir() else path.unlink()
    process = start(program, cut, *words)
    process.communicate()
    assert process.returncode == 0
    assert same(cut) == same(whole)
    # For docs/reliability.md, see there.
    print(f"kills: {killed}, and {ends + 1} runs that got to their end")


@pytest.fixture
def kills(request: pytest.FixtureRequest) -> int:
    """How often a process is killed."""
    asked: int = request.config.getoption("--kills")
    return asked


def test_a_collection_killed_again_and_again_ends_with_the_same_bytes(
    tmp_path: Path, kills: int
) -> None:
    def same(path: Path) -> Tree:
        assert sorted(entry.name for entry in path.parent.iterdir()) == [path.name]
        return tree(path)

    check_ends_alike(COLLECTOR, tmp_path, "data.zarr", kills, same)


def test_a_training_killed_again_and_again_ends_with_the_same_weights(
    tmp_path: Path, kills: int
) -> None:
    """Files of the weights carry random names: what they load as is compared, bit by bit."""
    import jax
    import numpy as np

    from wlplan.models.storage import load_model

    def same(path: Path) -> tuple[list[bytes], dict[str, object]]:
        assert [entry.name for entry in visible(path.parent)] == [path.name]
        leaves = [np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(load_model(path))]
        description = json.loads((path / "model.json").read_text())
        return leaves, {name: description[name] for name in ("training", "held_out")}

    words = [str(Path(__file__).parent)]
    check_ends_alike(TRAINER, tmp_path, "m", kills, same, *words)
