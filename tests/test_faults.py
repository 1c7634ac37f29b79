"""Whatever is written is whole or not there, whichever operation on files fails, and when."""

import contextlib
import dataclasses
import itertools
import os
import shutil
import subprocess
import sys
import types
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import FrameType
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from cones import SITE
from faults import (
    ERROR,
    INTERRUPT_AFTER,
    KINDS,
    READ_ONLY,
    Ended,
    Fault,
    Kind,
    Tree,
    check_all_or_nothing,
    for_every_fault,
    tree,
)
from flax import nnx
from test_cli import FakeWorld, fake_play
from test_store_machine import CYCLES, stand_ins

from experiments._common.results import write_result
from wlplan import cli
from wlplan.cli.progress import Stopwatch
from wlplan.dataset import collect, collecting, store
from wlplan.dataset.layout import Layout
from wlplan.dataset.variables import VARIABLES
from wlplan.errors import InputError
from wlplan.io import files, read_pile, read_plan, write_pile, write_plan, write_text_atomic
from wlplan.io.files import MADE_BY, atomic_folder
from wlplan.models.normaliser import Normaliser
from wlplan.models.psi_low import LowPerformanceModel, PsiLow
from wlplan.models.storage import load_model, save_model
from wlplan.planning import piles
from wlplan.planning import plan as planner
from wlplan.portable import export
from wlplan.portable.function import Port, PortableFunction
from wlplan.report import diggability_page, making, pictures
from wlplan.report import figures as plots
from wlplan.report.document import plan_document
from wlplan.studies import diggability as studies
from wlplan.studies.diggability import DiggabilityMap, Foreseen
from wlplan.studies.gradcheck import Component, GradientCheck
from wlplan.terrain.seed_piles import seed_pile
from wlplan.terrain.toe import edge_poses, toe_contour
from wlplan.training.fitting import SavedState
from wlplan.types import Performance
from wlplan.worlds import shipped as worlds

# A file that was just opened as Ctrl-C came is closed when Python forgets it.
pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")


def ended(call: Callable[[], object]) -> Callable[[], Ended]:
    """How a call of Python ends, as the command line would say it."""

    def run() -> Ended:
        try:
            call()
        except (InputError, OSError) as error:
            return 2, f"error: {error}\n"
        except KeyboardInterrupt:
            return 130, "error: interrupted\n"
        return 0, ""

    return run


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder whose files may fail."""
    (tmp_path / "watched").mkdir()
    return tmp_path / "watched"


# --- what everything is written with


def write_file(folder: Path) -> None:
    write_text_atomic(folder / "a", "new")


def write_into(folder: Path, existing: Any) -> None:
    with atomic_folder(folder / "above" / "out", existing=existing) as new:
        for name in "abc":
            write_text_atomic(new / name, "new")


def fill(folder: Path) -> None:
    """What is there before: a file of its own, one that is to be replaced, a folder."""
    (folder / "above" / "out").mkdir(parents=True)
    for path in (folder / "a", folder / "above" / "out" / "a", folder / "above" / "out" / "z"):
        path.write_text("old")


WRITERS: Mapping[str, tuple[bool, Callable[[Path], None]]] = {
    "a new file": (False, write_file),
    "a file": (True, write_file),
    "a new folder": (False, lambda folder: write_into(folder, "refuse")),
    "a new folder to add to": (False, lambda folder: write_into(folder, "add")),
    "a folder added to": (True, lambda folder: write_into(folder, "add")),
    "a folder replaced": (True, lambda folder: write_into(folder, "replace")),
}
each_writer = pytest.mark.parametrize("name", WRITERS)


@pytest.fixture(params=[True, False], ids=["one step", "two steps"])
def exchanges(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """With folders that can change places in one step, and without."""
    if not request.param:
        monkeypatch.setattr(files, "_exchange", lambda *_: False)


@each_writer
@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
@pytest.mark.usefixtures("exchanges")
def test_all_is_old_or_all_is_new(folder: Path, name: str, kind: Kind) -> None:
    filled, write = WRITERS[name]
    if filled:
        fill(folder)
    check_all_or_nothing(folder, kind, ended(lambda: write(folder)))


@each_writer
def test_on_a_disk_that_stays_read_only_each_file_is_whole(folder: Path, name: str) -> None:
    """Nothing can be undone there: files may be old and new side by side, and hidden ones stay."""
    filled, write = WRITERS[name]
    if filled:
        fill(folder)

    found: list[tuple[Fault, dict[str, bytes | None]]] = []

    def keep(fault: Fault, _: Ended, left: Tree) -> None:
        found.append((fault, shown(left)))

    run = ended(lambda: write(folder))
    count, before, after = for_every_fault(folder, READ_ONLY, run, keep)
    assert count > 0
    old, new = shown(before), shown(after)
    for fault, seen in found:
        assert set(old) & set(new) <= set(seen), fault.struck
        assert all(
            content in (old.get(name, new.get(name)), new.get(name, old.get(name)))
            for name, content in seen.items()
        ), fault.struck


def shown(found: Tree) -> dict[str, bytes | None]:
    """What is not hidden, without permissions."""
    return {
        name: content
        for name, (_, content) in found.items()
        if not any(part.startswith(".") for part in Path(name).parts)
    }


@each_writer
def test_ctrl_c_at_any_line_leaves_all_old_or_all_new(folder: Path, name: str) -> None:
    """At most a hidden folder stays, where it comes between two statements of the tidying up."""
    filled, write = WRITERS[name]
    states: list[Tree] = []
    for number in itertools.count(1):
        shutil.rmtree(folder)
        folder.mkdir()
        if filled:
            fill(folder)
        before = tree(folder)
        with contextlib.suppress(KeyboardInterrupt), interrupted_at_line(number) as lines:
            write(folder)
        left = tree(folder)
        if lines[0] < number:
            after = left
            break
        states.append(left)
    print(f"lines: {len(states)}")
    assert len(states) > 10
    assert all(shown(left) in (shown(before), shown(after)) for left in states)
    assert sum(left not in (before, after) for left in states) <= 1


@contextlib.contextmanager
def interrupted_at_line(number: int) -> Iterator[list[int]]:
    """Ctrl-C before line number `number` that runs of `wlplan/io/files.py`; yields the count."""
    seen = [0]

    def trace(frame: FrameType, event: str, _: object) -> Any:
        if frame.f_code.co_filename != files.__file__:
            return None
        if event == "line":
            seen[0] += 1
            if seen[0] == number:
                raise KeyboardInterrupt
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        yield seen
    finally:
        sys.settrace(before)


def test_the_law_can_fail(folder: Path) -> None:
    """A file written where it belongs is seen half; one that is left behind is seen too."""

    def plain() -> None:
        with open(folder / "a", "w") as file:
            file.write("new" * 1000)

    def untidy() -> None:
        (folder / "a.tmp").write_text("new")
        os.replace(folder / "a.tmp", folder / "a")

    for write in (plain, untidy):
        with pytest.raises(AssertionError, match="neither old nor new"):
            check_all_or_nothing(folder, ERROR, ended(write))


# --- functions of Python


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_piles_and_plans_are_whole(folder: Path, kind: Kind) -> None:
    pile = seed_pile("conical", slope=0.5, height=1.0)
    load = {
        **dict.fromkeys(("x", "y", "heading"), 0.0),
        "action": dict.fromkeys(("delta_bm", "k_bm", "delta_bk", "k_bk"), 0.5),
    }
    document = {"format": "wlplan.plan/1", "loads": [load]}
    for name, write in (
        ("pile.npz", lambda: write_pile(folder / "pile.npz", pile)),
        ("plan.json", lambda: write_plan(folder / "plan.json", document)),
    ):
        check_all_or_nothing(folder, kind, ended(write))
        (folder / name).write_text("old")
        check_all_or_nothing(folder, kind, ended(write))


# --- commands

Command = Callable[..., Callable[[], Ended]]


@pytest.fixture
def scan(tmp_path: Path) -> Path:
    """A pile file, beside the folder whose files fail."""
    path = tmp_path / "scan.npz"
    write_pile(path, seed_pile("conical", slope=0.5, height=1.0, seed=1))
    return path


@pytest.fixture
def command(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Command:
    """The command line with these words; what takes long is a stand-in, what writes is real."""
    # Wall clocks would differ from run to run.
    monkeypatch.setattr(Stopwatch, "text", lambda _: "1.0 s")
    monkeypatch.setattr(worlds, "load_world", lambda *_, **__: FakeWorld(1.0))
    monkeypatch.setattr(planner, "play", fake_play)
    monkeypatch.setattr(piles, "heights_after", lambda *_: None)
    monkeypatch.setattr(plots, "png_bytes", lambda *_, **__: f"PNG {MADE_BY}".encode())
    monkeypatch.setattr(pictures, "galleries_of", lambda *_, **__: [])
    for name in (one for one in plots.__all__ if one.endswith("_figure")):
        monkeypatch.setattr(plots, name, lambda *_, **__: None)

    def words_of(*words: object) -> Callable[[], Ended]:
        def run() -> Ended:
            capsys.readouterr()
            code = cli.main([*map(str, words), "--quiet"])
            return code, capsys.readouterr().err

        return run

    return words_of


@pytest.fixture
def plan_file(tmp_path: Path, scan: Path) -> Path:
    """A plan for the pile."""
    poses = edge_poses(toe_contour(read_pile(scan)), 2)
    loads = [
        {
            **{name: float(getattr(poses, name)[n]) for name in ("x", "y", "heading")},
            "action": dict.fromkeys(("delta_bm", "k_bm", "delta_bk", "k_bk"), 0.5),
        }
        for n in range(2)
    ]
    path = tmp_path / "given.json"
    write_plan(path, {"format": "wlplan.plan/1", "loads": loads})
    return path


def old_files(folder: Path, *names: str) -> Path:
    """A folder with older files of ours, and one of somebody else."""
    folder.mkdir()
    for name in names:
        (folder / name).write_text('{"format": "wlplan.old/1"}')
    (folder / "notes.txt").write_text("theirs")
    return folder


# Commands take a second each: the other kinds are tested above.
each_kind = pytest.mark.parametrize("kind", [ERROR, INTERRUPT_AFTER], ids=lambda kind: kind.name)


@pytest.mark.slow
@each_kind
def test_simulate_writes_all_or_nothing(
    folder: Path, command: Command, scan: Path, plan_file: Path, kind: Kind
) -> None:
    out = old_files(folder / "out", "plan.json", "totals.png", "report.html")
    run = command("simulate", scan, plan_file, "--out", out, "--also", "geojson")
    check_all_or_nothing(folder, kind, run)


@pytest.mark.slow
@each_kind
def test_plan_writes_all_or_nothing(
    folder: Path,
    command: Command,
    scan: Path,
    plan_file: Path,
    kind: Kind,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    given, pile, site = read_plan(plan_file)[0], read_pile(scan), SITE
    played = fake_play(FakeWorld(1.0), pile, given, site)
    document = plan_document(pile, played, site=site, predicted=played.rollout.performance)
    document |= {"pile": {"file": "scan.npz"}, "notes": []}
    made = making.MadePlan(document, pile, played, played, site, FakeWorld(1.0), {})

    def make_plan(*_: object, timed: Any, **__: object) -> making.MadePlan:
        with timed("planning"):
            return made

    monkeypatch.setattr(making, "make_plan", make_plan)
    monkeypatch.setattr(making.MadePlan, "heights", None)
    check_all_or_nothing(folder, kind, command("plan", scan, "--out", folder / "new", "--json"))


@each_kind
def test_bench_writes_all_or_nothing(
    folder: Path, command: Command, kind: Kind, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "wlplan.studies.bench.run_bench", lambda *_, **__: {"format": "wlplan.bench/1"}
    )
    out = old_files(folder / "out", "bench.json")
    check_all_or_nothing(folder, kind, command("bench", "--out", out, "--json"))


@pytest.mark.slow
@each_kind
def test_gradcheck_writes_all_or_nothing(
    folder: Path, command: Command, scan: Path, kind: Kind, monkeypatch: pytest.MonkeyPatch
) -> None:
    component = Component(1, "x", 1.0, 1.0, 0.0, 1e-6, "ok")
    check = GradientCheck(1.0, 1e-6, 1e-4, (component,))
    monkeypatch.setattr("wlplan.studies.gradcheck.check_gradient", lambda *_, **__: check)
    out = old_files(folder / "out", "gradcheck.json")
    run = command("gradcheck", scan, "--loads", 1, "--out", out, "--json")
    check_all_or_nothing(folder, kind, run)


@pytest.mark.slow
@each_kind
def test_diggability_writes_all_or_nothing(
    folder: Path, command: Command, scan: Path, kind: Kind, monkeypatch: pytest.MonkeyPatch
) -> None:
    poses = edge_poses(toe_contour(read_pile(scan)), 3)
    values = np.arange(1.0, 4.0)
    found = DiggabilityMap(poses, Performance(values, values, values))
    monkeypatch.setattr(studies, "diggability_map", lambda *_, **__: found)
    monkeypatch.setattr(studies, "foreseen_on_map", lambda *_: Foreseen(None, None))
    monkeypatch.setattr(diggability_page, "render_map", lambda *_, **__: f"<p>{MADE_BY}</p>")
    monkeypatch.setattr(diggability_page, "map_figure", lambda *_, **__: None)
    out = old_files(folder / "out", "report.html", "diggability.json")
    run = command("diggability", scan, "--locations", 3, "--out", out, "--json")
    check_all_or_nothing(folder, kind, run)


@pytest.mark.slow
@each_kind
def test_an_export_is_whole(folder: Path, kind: Kind, monkeypatch: pytest.MonkeyPatch) -> None:
    numbers = np.ones((2, 3), np.float32)
    port = Port("x", "any", "1", shape=(3,), dtype="float32")
    function = PortableFunction("f", "a test", lambda x: x, (port,), (port,), (numbers,), {})
    portable = types.SimpleNamespace(
        ENDING="bin",
        LIBRARIES=(),
        content=lambda _: b"content" * 1000,
        outputs=lambda *_: (numbers,),
        facts=lambda *_: {},
    )
    monkeypatch.setattr(export, "_format", lambda _: portable)
    monkeypatch.setattr(export, "_outputs", lambda _: (numbers,))
    run = ended(lambda: export.export(function, folder / "out"))
    check_all_or_nothing(folder, kind, run)
    with contextlib.suppress(InputError):
        run()
    function = dataclasses.replace(function, meaning="another")
    check_all_or_nothing(folder, kind, ended(lambda: export.export(function, folder / "out")))


@pytest.fixture(scope="module")
def model() -> LowPerformanceModel:
    """A model that knows nothing."""
    network = PsiLow((4,), rngs=nnx.Rngs(0))
    graph, params = nnx.split(network)
    inputs, outputs = (Normaliser.of(np.eye(n, dtype=np.float32)) for n in (8, 3))
    return LowPerformanceModel(params, inputs, outputs, graph)


@pytest.mark.slow
@each_kind
@pytest.mark.parametrize("is_there", [False, True])
def test_a_model_is_whole(
    folder: Path, model: LowPerformanceModel, kind: Kind, is_there: bool
) -> None:
    """Its files carry random names, so new ones are told by what they load as."""
    if is_there:
        save_model(folder / "m", model, {"held_out": {"old": 1}})
    state = SavedState(folder / ".m.training.npz", {})

    def save() -> None:
        save_model(folder / "m", model, {})
        state.remove()

    found: list[tuple[Fault, Ended, Tree]] = []

    def keep(fault: Fault, end: Ended, left: Tree) -> None:
        found.append((fault, end, left))
        if left != before:
            # Loading checks every byte.
            load_model(folder / "m")
            assert sorted(path.name for path in folder.iterdir()) == ["m"]
            assert "old" not in (folder / "m" / "model.json").read_text()

    before = tree(folder)
    count, *_ = for_every_fault(folder, kind, ended(save), keep, same=loads)
    assert count > 0
    assert {end[0] for _, end, _ in found} <= {0, 2, 130}


def loads(left: Tree) -> list[str]:
    """What is comparable of a folder with a model: the names that are not random."""
    return [name for name in left if name.count("/") < 2]


@pytest.mark.slow
@each_kind
def test_a_collection_goes_on_after_any_fault(
    folder: Path, command: Command, kind: Kind, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What it leaves can be continued by the same command, and ends with the same bytes."""
    few = {name: VARIABLES[name] for name in ("mass", "rollout")}
    monkeypatch.setattr(store, "VARIABLES", few)
    monkeypatch.setattr(store, "command", lambda: "wlplan collect")

    def batches(layout: Layout, start: int, *_: object) -> Iterator[dict[str, np.ndarray]]:
        for first in range(start, layout.size, layout.batch_cycles):
            count = min(layout.batch_cycles, layout.size - first)
            numbers = np.arange(first, first + count)
            yield {name: numbers.astype(v.dtype) for name, v in few.items()}

    monkeypatch.setattr(collecting, "collect_batches", batches)
    monkeypatch.setattr("wlplan.dataset.layout._BATCH", 1)
    # A lock that is not signed yet when Ctrl-C comes is taken over, but only after a while.
    monkeypatch.setattr(store, "_SIGNING_TIME", 0.0)
    run = command("collect", "--cycles", 60, "--out", folder / "data.zarr")
    wanted = 130 if kind is INTERRUPT_AFTER else 2
    rows: list[tuple[Fault, Ended, Tree]] = []

    def go_on(fault: Fault, end: Ended, left: Tree) -> None:
        assert end[0] in (wanted, 0), (fault.struck, end)
        assert end[0] == 0 or end[1].count("\n") == 1, end
        locks = [content for name, (_, content) in left.items() if name.endswith(".lock")]
        assert locks in ([], [b""]), fault.struck
        assert not locks or kind is INTERRUPT_AFTER, fault.struck
        assert run() == (0, "")
        rows.append((fault, end, tree(folder)))

    count, _, after = for_every_fault(folder, kind, run, go_on)
    assert count > 0
    for fault, _, left in rows:
        assert left == after, (fault.struck, sorted(set(left) ^ set(after)))


@pytest.mark.slow
def test_a_merge_writes_all_or_nothing(folder: Path, command: Command, tmp_path: Path) -> None:
    """The shards stay as they are, and the same command then joins them."""
    with stand_ins():
        for number in (1, 2):
            collect(tmp_path / f"{number}.zarr", cycles=CYCLES, shard=(number, 2))
        shards = [tree(tmp_path / f"{number}.zarr") for number in (1, 2)]
        words = ("collect", "--merge", tmp_path / "2.zarr", tmp_path / "1.zarr")
        check_all_or_nothing(folder, ERROR, command(*words, "--out", folder / "data.zarr"))
        assert shards == [tree(tmp_path / f"{number}.zarr") for number in (1, 2)]


@pytest.mark.slow
@each_kind
def test_export_writes_all_or_nothing(
    folder: Path, command: Command, scan: Path, kind: Kind, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By its command: what is exported is a stand-in, what is written is real."""

    def write(_: object, place: Path, **__: object) -> list[object]:
        with atomic_folder(place) as new:
            for name in ("export.json", "check.npz"):
                write_text_atomic(new / name, "{}")
        return []

    monkeypatch.setattr(export, "export", write)
    monkeypatch.setattr("wlplan.portable.functions.portable", lambda *_: None)
    words = ("export", "world", scan, "--out", folder / "out", "--json")
    check_all_or_nothing(folder, kind, command(*words))


@pytest.mark.slow
@each_kind
def test_train_writes_all_or_nothing(
    folder: Path,
    command: Command,
    model: LowPerformanceModel,
    tmp_path: Path,
    kind: Kind,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """By its command, with a stand-in for the training: the model is there whole, or not at all."""

    def train(*_: object, out: str, **__: object) -> tuple[object, object]:
        save_model(out, model, {})
        return model, types.SimpleNamespace(as_dict=dict)

    monkeypatch.setattr("wlplan.dataset.open_dataset", lambda _: None)
    monkeypatch.setattr("wlplan.training.train", train)
    (tmp_path / "data.zarr").mkdir()
    run = command(
        *("train", "psi-low", "--data", tmp_path / "data.zarr", "--out", folder / "m", "--json")
    )
    found: list[tuple[Fault, Ended, Tree]] = []
    count, *_ = for_every_fault(folder, kind, run, lambda *row: found.append(row), same=loads)
    assert count > 0
    for fault, (code, said), left in found:
        assert code in (0, 2, 130), (fault.struck, said)
        assert code == 0 or said.count("\n") == 1, said
        assert set(left) == set() or "m/model.json" in left, (fault.struck, sorted(left))


@each_kind
def test_results_of_experiments_are_whole(folder: Path, kind: Kind) -> None:
    def write() -> None:
        write_result("automaton", "smoke", {"rows": [1, 2]}, folder)

    (folder / "automaton.json").write_text("old")
    check_all_or_nothing(folder, kind, ended(write))


# --- disks, and several writers


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 300 kB."""
    place = tmp_path / "disk"
    place.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=300k", "tmpfs", str(place)]
    if shutil.which("mount") is None or subprocess.run(mount, capture_output=True).returncode:
        pytest.skip("only root may mount a small disk")
    yield place
    subprocess.run(["umount", "-l", str(place)], check=True)


def test_a_full_disk_is_one_line_and_leaves_what_was_there(
    small_disk: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Also where the bytes are written by libraries that are no Python: the weights of a model."""
    (small_disk / "theirs").write_bytes(b"x" * 200_000)
    write_text_atomic(small_disk / "a", "old")
    before = tree(small_disk)
    graph, params = nnx.split(PsiLow((200, 200), rngs=nnx.Rngs(0)))
    inputs, outputs = (Normaliser.of(np.eye(n, dtype=np.float32)) for n in (8, 3))
    large = LowPerformanceModel(params, inputs, outputs, graph)
    random = np.random.default_rng(0).normal(size=(300, 300)).astype(np.float32)
    pile = seed_pile("conical", slope=0.5, height=1.0)
    pile = pile.replace(height=jnp.asarray(random), ground=None)
    writers: tuple[Callable[[], None], ...] = (
        lambda: write_text_atomic(small_disk / "a", "new" * 100_000),
        lambda: write_pile(small_disk / "pile.npz", pile),
        lambda: save_model(small_disk / "above" / "m", large, {}),
    )
    for write in writers:
        with pytest.raises(InputError, match="No space left on device") as refused:
            write()
        assert "\n" not in str(refused.value)
        assert tree(small_disk) == before
    assert capfd.readouterr() == ("", "")


def test_a_disk_that_is_read_only_is_one_line(
    small_disk: Path, command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "wlplan.studies.bench.run_bench", lambda *_, **__: {"format": "wlplan.bench/1"}
    )
    out = old_files(small_disk / "out", "bench.json")
    before = tree(small_disk)
    subprocess.run(["mount", "-o", "remount,ro", str(small_disk)], check=True)
    code, said = command("bench", "--out", out, "--json")()
    assert code == 2
    assert said == f"error: {out}: cannot be written (Read-only file system): choose another " + (
        "folder.\n"
    )
    assert tree(small_disk) == before


# Writes its own letter into a file and into two folders, over and over.
_TWO = """
import sys
from pathlib import Path
from wlplan.io.files import atomic_folder, write_text_atomic
here, letter = Path(sys.argv[1]), sys.argv[2]
for n in range(int(sys.argv[3])):
    write_text_atomic(here / "file", letter * 100_000)
    for existing in ("replace", "add"):
        with atomic_folder(here / existing, existing=existing) as new:
            for name in "abc":
                write_text_atomic(new / name, letter * 10_000)
"""


def test_of_two_writers_at_once_neither_breaks_the_other(tmp_path: Path) -> None:
    """Each file is one writer's at every moment; a folder that is replaced is so at the end."""
    for existing in ("replace", "add"):
        with atomic_folder(tmp_path / existing) as new:
            for name in "abc":
                write_text_atomic(new / name, "A" * 10_000)
    write_text_atomic(tmp_path / "file", "A" * 100_000)
    writers = [
        subprocess.Popen([sys.executable, "-c", _TWO, str(tmp_path), letter, "100"])
        for letter in "AB"
    ]
    looks = 0
    while any(writer.poll() is None for writer in writers):
        for path in (tmp_path / "file", tmp_path / "add" / "b", tmp_path / "replace" / "c"):
            text = path.read_text()
            assert len(text) in (10_000, 100_000)
            assert text in ("A" * len(text), "B" * len(text))
            looks += 1
    assert looks > 100
    assert [writer.returncode for writer in writers] == [0, 0]
    assert sorted(tree(tmp_path)) == sorted(
        ["file", *(["add", "replace"]), *(f"{f}/{n}" for f in ("add", "replace") for n in "abc")]
    )
    assert len({(tmp_path / "replace" / name).read_text() for name in "abc"}) == 1
