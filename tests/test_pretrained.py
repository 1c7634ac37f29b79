"""The weights that ship: there, small, loadable, and of today's simulator."""

import json
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from wlplan import cli
from wlplan.dataset import VARIABLES, Dataset, fingerprint, probes, probes_of, simulator_changes
from wlplan.errors import InputError
from wlplan.io.provenance import versions
from wlplan.models.storage import load_model, read_description
from wlplan.terrain.automaton import relax
from wlplan.terrain.seed_piles import SEED_PILES, seed_pile
from wlplan.terrain.toe import edge_poses, toe_contour
from wlplan.training import Settings, train_all, weights
from wlplan.types import action_from
from wlplan.worlds.learned import LearnedWorld
from wlplan.worlds.names import WORLDS, Learned
from wlplan.worlds.shipped import load_world, pretrained_path

LEARNED = {name: world for name, world in WORLDS.items() if isinstance(world, Learned)}
SHIPPED = sorted({kind for kinds in LEARNED.values() for kind in kinds if kind})
REBUILD = "make them again: `make weights`, or `wlplan train all --data DATA.zarr --out DIR`"


@pytest.fixture(scope="module")
def data() -> list[dict[str, Any]]:
    """What the models say of the data that they were trained on."""
    return [read_description(pretrained_path(kind), kind)["dataset"] for kind in SHIPPED]


def test_the_shipped_weights_are_of_todays_simulator(data: list[dict[str, Any]]) -> None:
    # All models share their data, but for rounding: other machines add up in another order.
    played = [
        (each["seeds"], each["cycles"], [name or "paper" for name in each["protocols"]])
        for each in data
    ]
    assert all(other == played[0] for other in played), REBUILD
    # Of the same bytes the cycles are played once.
    of_bytes = {tuple(each["fingerprints"]): each for each in data}
    for each in of_bytes.values():
        wrong = simulator_changes(each)
        assert not wrong, (
            f"the weights that ship were trained on cycles of another simulator than today's "
            f"({'; '.join(wrong[:3])}): {REBUILD}"
        )


def test_the_check_can_fail(data: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch) -> None:
    some = data[0]["probes"][:1]
    assert not simulator_changes({**data[0], "probes": some})
    for name in ("mass", "time", "work", "moved"):
        (found,) = simulator_changes(
            {**data[0], "probes": [{**some[0], name: 1.01 * some[0][name]}]}
        )
        assert name in found
    turned = [{**some[0], "characteristics": [v + 0.01 for v in some[0]["characteristics"]]}]
    assert simulator_changes({**data[0], "probes": turned})
    assert simulator_changes({**data[0], "probes": []}) == [
        "the data set had no cycles to compare with"
    ]
    soil = {**data[0]["soil"], "friction": 0.5, "stickiness": 1.0}
    changes = simulator_changes({**data[0], "probes": some, "soil": soil})
    assert [entry.split()[0] for entry in changes] == ["soil.friction", "soil.stickiness"]


def test_probes_are_of_every_seed_pile(data: list[dict[str, Any]]) -> None:
    rollouts = [probe["rollout"] for probe in data[0]["probes"]]
    assert sorted(set(rollouts)) == list(range(len(SEED_PILES)))
    assert len(rollouts) == probes._LOADS * len(SEED_PILES)


def test_data_of_ones_own_has_no_probes() -> None:
    columns = {name: np.zeros((7, *v.shape), v.dtype) for name, v in VARIABLES.items()}
    assert probes_of(Dataset(**columns, attributes={})) == []


def test_all_weights_together_are_small() -> None:
    files = [path for kind in SHIPPED for path in pretrained_path(kind).rglob("*")]
    assert sum(path.stat().st_size for path in files if path.is_file()) <= 25e6
    assert not [path for path in files if path.suffix in (".pkl", ".pickle")]


@pytest.mark.parametrize(
    "name",
    [
        "hybrid",
        *(pytest.param(name, marks=pytest.mark.slow) for name in LEARNED if name != "hybrid"),
    ],
)
def test_every_learned_world_is_there_and_loads_a_bucket(name: str) -> None:
    world = load_world(name)
    assert isinstance(world, LearnedWorld)
    pile = relax(seed_pile("conical", slope=np.radians(30.0), height=2.5))
    pose = jax.tree.map(lambda leaf: leaf[0], edge_poses(toe_contour(pile), 1))
    action = action_from(jnp.array([0.3, 2.0, 0.2, 3.0]))
    after, performance = jax.jit(lambda w, p: w(p, pose, action))(world, pile)
    assert 1.0 < float(performance.mass) < 5.0
    assert 6.0 < float(performance.time) < 25.0
    assert 100.0 < float(performance.work) < 1500.0
    lost = np.asarray(pile.height - after.height, np.float64).sum() * pile.cell_size**2
    assert lost * 1.727 == pytest.approx(float(performance.mass), rel=1e-3)
    deviation = world.uncertainty(pile, pose, action)
    assert 0.01 < float(deviation.mass) < 0.5
    assert 0.01 < float(deviation.time) < 5.0
    assert 0.0 < float(world.stall_probability(pile, pose, action)) < 0.1


@pytest.mark.parametrize("kind", [kind for kind in SHIPPED if kind.startswith("psi")])
def test_the_interval_held_what_it_says_on_held_out_cycles(kind: str) -> None:
    intervals = read_description(pretrained_path(kind), kind)["held_out"]["intervals"]
    for interval in intervals.values():
        assert 0.85 <= interval["coverage"] <= 0.95


def test_stalls_were_foreseen_on_held_out_cycles() -> None:
    report = read_description(pretrained_path("stall"), "stall")["held_out"]
    for name in ("negative_log_likelihood", "brier"):
        assert report["score"][name] < 0.3 * report["constant"][name]
    assert report["area_under_curve"] > 0.99
    assert report["calibration_error"] < 0.01
    # As many as there were, within what so many can be off by chance.
    assert abs(report["foreseen"] * report["cycles"] - report["stalled"]) < 3.0 * np.sqrt(
        report["stalled"]
    )


def test_the_predictor_of_stalls_goes_with_its_data_alone() -> None:
    """A ψ of one's own is of another machine, maybe, and what foresees its stalls is too."""
    psi, stall = pretrained_path("psi_low"), pretrained_path("stall")
    known = {
        "as it ships": load_world("low"),
        "own": load_world("low", model=psi),
        "both own": load_world("low", model=psi, stall=stall),
    }
    said = {
        name: isinstance(world, LearnedWorld) and world.has_stall_probability
        for name, world in known.items()
    }
    assert said == {"as it ships": True, "own": False, "both own": True}
    with pytest.raises(InputError, match="train stall"):
        load_world("low", stall=psi)
    with pytest.raises(InputError, match="has no models"):
        load_world("simulator", stall=stall)


@pytest.mark.parametrize("kind", SHIPPED)
def test_a_model_for_another_grid_is_refused_in_one_line(kind: str, tmp_path: Path) -> None:
    copy = shutil.copytree(pretrained_path(kind), tmp_path / kind)
    document = json.loads((copy / "model.json").read_text())
    for change in ({"cell_size": 0.2}, {"state_cells": 64}):
        grid = {**document["grid"], **change}
        (copy / "model.json").write_text(json.dumps({**document, "grid": grid}))
        with pytest.raises(InputError, match=next(iter(change))) as error:
            load_model(copy, kind)
        assert "\n" not in str(error.value)
    for wrong in ("fine", None):
        (copy / "model.json").write_text(json.dumps({**document, "grid": wrong}))
        with pytest.raises(InputError, match="grid"):
            load_model(copy, kind)


def test_all_models_are_trained_by_one_call_which_goes_on_where_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The trainings themselves have tests of their own."""
    collected: list[tuple[str, int, int, str]] = []
    trained: list[str | tuple[str, int]] = []
    told: list[tuple[object, ...]] = []

    def collect(
        path: Path, *, cycles: int, seed: int, protocol: str, progress: Callable[[int, int], None]
    ) -> None:
        collected.append((path.name, cycles, seed, protocol))
        progress(cycles, cycles)

    few = Dataset(
        **{name: np.zeros((3, *v.shape), v.dtype) for name, v in VARIABLES.items()},
        attributes={},
    )
    monkeypatch.setattr(weights, "collect", collect)
    monkeypatch.setattr(weights, "open_dataset", lambda path: few)
    monkeypatch.setattr(weights, "is_new", lambda path: len(collected) < 6)
    monkeypatch.setattr(weights, "read_attributes", lambda path: {"cycles": 1, "cycles_done": 1})

    def train(
        settings: Settings,
        dataset: Sequence[Dataset],
        *,
        out: Path,
        progress: Callable[[int, int], None],
    ) -> None:
        if settings.kind == "psi_high" and not trained.count("broke"):
            trained.append("broke")
            raise KeyboardInterrupt
        trained.append((settings.kind, settings.seed))
        shutil.copytree(pretrained_path(settings.kind), out)
        document = json.loads((out / "model.json").read_text())
        document["dataset"]["fingerprints"] = [fingerprint(each) for each in dataset]
        document["training"]["settings"] = settings.as_dict()
        document["versions"] = versions()
        (out / "model.json").write_text(json.dumps(document))
        progress(1, 1)

    monkeypatch.setattr(weights, "train", train)
    call: dict[str, Any] = {"seed": 3, "progress": lambda *news: told.append(news)}
    with pytest.raises(KeyboardInterrupt):
        train_all(tmp_path / "d.zarr", tmp_path / "out", **call)
    reports = train_all(tmp_path / "d.zarr", tmp_path / "out", **call)
    assert collected[:2] == [
        ("d.zarr", 10_800, 3, "paper"),
        ("d-corridor.zarr", 10_800, 4, "corridor"),
    ]
    # No two data sets share their piles, or their place.
    assert len({name for name, *_ in collected}) == len({seed for *_, seed, _ in collected}) == 6
    assert trained == [("psi_low", 3), "broke", ("psi_high", 3), ("phi", 3), ("stall", 3)]
    assert told[0] == ("cycles, d.zarr", 10_800, 10_800)
    assert set(reports) == set(SHIPPED)
    train_all(tmp_path / "d.zarr", tmp_path / "out", **call)
    assert len(trained) == 5
    # Other settings are another training.
    shutil.rmtree(tmp_path / "out")
    train_all(tmp_path / "d.zarr", tmp_path / "out", seed=4, progress=call["progress"])
    assert trained[5:] == [("psi_low", 4), ("psi_high", 4), ("phi", 4), ("stall", 4)]


def test_what_was_trained_and_what_was_kept_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def train_all(
        data: str,
        out: str,
        *,
        seed: int,
        epochs: int | None,
        progress: Callable[[str, int, int], None],
    ) -> dict[str, Any]:
        progress("cycles, d.zarr", 10, 10)
        progress("psi_high", 60, 60)
        return {kind: read_description(pretrained_path(kind), kind)["held_out"] for kind in SHIPPED}

    monkeypatch.setattr("wlplan.training.train_all", train_all)
    code = cli.main(["train", "all", "--data", str(tmp_path / "d.zarr"), "--out", str(tmp_path)])
    assert code == 0
    *_, time, written, kept = capsys.readouterr().out.strip().splitlines()
    assert time.startswith("collecting and training")
    assert written == f"written: {tmp_path / 'psi_high'}"
    others = ", ".join(str(tmp_path / kind) for kind in ("phi", "psi_low", "stall"))
    assert kept == f"kept, since data, settings and versions are the same: {others}"


def test_every_model_that_a_world_needs_is_trained() -> None:
    assert {settings.kind for settings in weights.SHIPPED} == set(SHIPPED)
