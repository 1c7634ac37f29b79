"""What `wlplan evaluate` reports: errors, inference times, and the paper's figures."""

import json

import numpy as np
import pytest
from flax import nnx
from test_pile_state import model_of
from test_training import synthetic

from wlplan.cli.evaluated import evaluated, print_stalls, print_times
from wlplan.dataset import Dataset
from wlplan.models.normaliser import Normaliser
from wlplan.models.phi_vae import PhiVae, VaePileStateModel
from wlplan.models.psi_low import LowPerformanceModel, PsiLow
from wlplan.models.stall import StallModel
from wlplan.models.storage import load_model, read_description
from wlplan.studies.bench.inference import BATCH
from wlplan.studies.paper import PERFORMANCE, PILE_STATE, SEQUENCE, SEQUENCE_LOADS
from wlplan.training import evaluate_performance, evaluate_pile_state, evaluate_stalls
from wlplan.worlds.shipped import pretrained_path


@pytest.fixture(scope="module")
def data() -> Dataset:
    return synthetic(rollouts=4)


def psi_low(data: Dataset) -> LowPerformanceModel:
    graph, params = nnx.split(PsiLow((8,), rngs=nnx.Rngs(0)))
    ranges = Normaliser.of(np.concatenate([data.characteristics, data.action], axis=1))
    table = np.stack([data.mass, data.time, data.work], axis=1)
    return LowPerformanceModel(
        params=params, graph=graph, inputs=ranges, outputs=Normaliser.of(table)
    )


def test_a_performance_predictor_stands_beside_the_papers(
    data: Dataset, capsys: pytest.CaptureFixture[str]
) -> None:
    model = psi_low(data)
    description = {"kind": "psi_low", "architecture": {"activation": "leaky_relu"}}
    found = evaluated(model, data, description)
    json.dumps(found, allow_nan=False)
    assert found["errors"] == evaluate_performance(model, data).as_dict()
    assert found["paper"]["mean_relative"] == {"mass": 0.0777, "time": 0.0566, "work": 0.0851}
    one, many = found["inference"]
    assert (one["inputs"], many["inputs"]) == (1, BATCH)
    for record in (one, many):
        assert record["each_s"] == record["call_s"]["median"] / record["inputs"]
        assert 0.0 < record["call_s"]["low"] <= record["call_s"]["median"]
        assert record["compile_s"] > 0.0
    assert one["call_s"]["repeats"] >= BATCH
    print_times(found["inference"], found["paper"]["inference_s"])
    assert "0.31 ms" in capsys.readouterr().out


@pytest.mark.slow
def test_an_ensemble_is_timed_with_and_without_its_deviation(
    data: Dataset, capsys: pytest.CaptureFixture[str]
) -> None:
    place = pretrained_path("psi_low")
    found = evaluated(load_model(place), data, read_description(place))
    asked = [(record["inputs"], record["deviation"]) for record in found["inference"]]
    assert asked == [(1, False), (BATCH, False), (1, True), (BATCH, True)]
    print_times(found["inference"], found["paper"]["inference_s"])
    assert capsys.readouterr().out.count("with the deviation") == 2


def test_the_predictor_of_stalls_stands_beside_a_constant(
    data: Dataset, capsys: pytest.CaptureFixture[str]
) -> None:
    place = pretrained_path("stall")
    model = load_model(place, "stall")
    assert isinstance(model, StallModel)
    found = evaluated(model, data, read_description(place, "stall"))
    json.dumps(found, allow_nan=False)
    assert found["errors"] == evaluate_stalls(model, data).as_dict()
    assert not found["paper"]
    assert [record["inputs"] for record in found["inference"]] == [1, BATCH]
    print_stalls("stall", found["errors"])
    print_times(found["inference"], None)
    said = capsys.readouterr().out
    assert "calibration error" in said
    assert "paper" not in said


@pytest.mark.slow
def test_the_papers_pile_state_model_is_judged_with_and_without_post_processing(
    data: Dataset,
) -> None:
    graph, params = nnx.split(PhiVae((8,), rngs=nnx.Rngs(0)))
    model = VaePileStateModel(params, graph)
    few = data.select(data.rollout < 1)
    found = evaluated(model, few, {"kind": "phi_vae", "architecture": {}})
    without = found["errors"].pop("without_blending")
    assert found["errors"] == evaluate_pile_state(model, few).as_dict()
    assert without == evaluate_pile_state(model.replace(blend=False), few).as_dict()
    assert without["mean_absolute"] != found["errors"]["mean_absolute"]
    assert found["paper"]["without_blending"]["mean_relative"] == 0.0341


def test_ours_has_no_post_processing_to_leave_out(data: Dataset) -> None:
    few = data.select(data.rollout < 1)
    found = evaluated(model_of(), few, {"kind": "phi", "architecture": {}})
    assert "without_blending" not in found["errors"]
    assert found["paper"]["mean_absolute"] == PILE_STATE[True].mean_absolute


def test_the_papers_figures_agree_with_what_its_text_says_of_them() -> None:
    """Section 7.1: low errors are 20 to 70 % larger; 7.3: the low world's mass is 12.8 % over."""
    for activation in ("swish", "leaky_relu"):
        low, high = PERFORMANCE["psi_low", activation], PERFORMANCE["psi_high", activation]
        for name in ("mass", "time", "work"):
            assert 1.2 < getattr(low, name) / getattr(high, name) < 1.75
    truth = SEQUENCE["simulator"]
    assert SEQUENCE["low"].mass[-1] / truth.mass[-1] - 1.0 == pytest.approx(0.128, abs=1e-3)
    assert SEQUENCE["high"].volume[-1] / truth.volume[-1] - 1.0 == pytest.approx(-0.064, abs=1e-3)
    for result in SEQUENCE.values():
        assert {len(column) for column in result} == {len(SEQUENCE_LOADS)}
