"""Functions as files: what they compute, what is said about them, what is refused."""

import functools
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import onnxruntime
import pytest
from cones import cone
from flax import nnx
from jax import lax

import wlplan
from wlplan import cli
from wlplan.errors import InputError
from wlplan.models.ensemble import Ensemble
from wlplan.models.normaliser import Normaliser
from wlplan.models.phi import HeightChange, HeightChangeModel
from wlplan.models.phi_vae import PhiVae, VaePileStateModel
from wlplan.models.psi_high import HighPerformanceModel, PsiHigh
from wlplan.models.psi_low import LowPerformanceModel, PsiLow
from wlplan.models.stall import StallModel, StallNetwork
from wlplan.portable import FORMATS, FUNCTIONS
from wlplan.portable.export import Compared, check_agrees, export
from wlplan.portable.function import Port, PortableFunction, checksum
from wlplan.portable.functions import Asked, portable
from wlplan.site.site import Site
from wlplan.terrain.toe import toe_contour
from wlplan.types import Action, Performance, Pile, Pose
from wlplan.worlds.pile_states import Strip
from wlplan.worlds.shipped import load_world

INPUTS = Normaliser.of(
    np.array([[0.1, 0.0, -0.2, -0.2, 0, 0, 0, 0], [0.6, 1.8, 0.4, 0.4, 0.7, 5, 0.7, 5]], np.float32)
)
OUTPUTS = Normaliser.of(np.array([[0.1, 6.0, 110.0], [4.8, 21.0, 1390.0]], np.float32))
MAPS = Normaliser.of(np.array([[-0.2], [2.7]], np.float32))


def function_of(
    function: Callable[..., Any], *cases: np.ndarray, name: str = "mine", outputs: int = 1
) -> PortableFunction:
    """A function of some arrays, of which the first axis counts the cases."""
    ports = [
        Port(f"in{k}", "any", "1", shape=case.shape[1:], dtype=str(case.dtype))
        for k, case in enumerate(cases)
    ]
    results = [Port(f"out{k}", "any", "1") for k in range(outputs)]
    return PortableFunction(name, "a test", function, tuple(ports), tuple(results), cases, {})


def line(x: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
    return 2.0 * x.sum() + y, jnp.tanh(y)


def check_of(folder: Path) -> dict[str, np.ndarray]:
    with np.load(folder / "check.npz", allow_pickle=False) as file:
        return dict(file)


NUMBERS = np.random.default_rng(0).normal(size=(5, 3)).astype(np.float32)
LINE = function_of(line, NUMBERS, NUMBERS[:, 0], outputs=2)


# --- what is written


def test_an_export_says_what_it_is_and_can_be_checked_elsewhere(tmp_path: Path) -> None:
    compared = export(LINE, tmp_path / "out", kinds=FORMATS)
    assert [found.file for found in compared] == ["mine.mlirbc", "mine.onnx", "mine.stablehlo"]
    assert all(max(found.relative.values()) < 1e-6 for found in compared)
    said = json.loads((tmp_path / "out" / "export.json").read_text())
    assert said["inputs"][0]["shape"] == ["batch", 3]
    assert [port["name"] for port in said["outputs"]] == ["out0", "out1"]
    assert said["files"]["mine.stablehlo"]["calling_convention_version"] >= 9
    assert said["files"]["mine.mlirbc"]["stablehlo_version"].startswith("1.")
    check = check_of(tmp_path / "out")
    np.testing.assert_allclose(check["output_out0"], 2 * NUMBERS.sum(axis=1) + NUMBERS[:, 0], 1e-5)
    np.testing.assert_array_equal(check["input_in0"], NUMBERS)


def test_files_take_any_batch(tmp_path: Path) -> None:
    export(LINE, tmp_path / "out", kinds=FORMATS)
    more = np.concatenate([NUMBERS, NUMBERS + 1.0])
    want = 2.0 * more.sum(axis=1) + more[:, 0]
    file = (tmp_path / "out" / "mine.stablehlo").read_bytes()
    found = jax.export.deserialize(bytearray(file)).call(more, more[:, 0])
    np.testing.assert_allclose(found[0], want, rtol=1e-5)
    session = onnxruntime.InferenceSession(str(tmp_path / "out" / "mine.onnx"))
    (got,) = session.run(["out0"], {"in0": more, "in1": more[:, 0]})
    np.testing.assert_allclose(got, want, rtol=1e-5)


def test_an_input_that_is_not_looked_at_stays_one(tmp_path: Path) -> None:
    lonely = function_of(lambda x, y: (y,), NUMBERS, NUMBERS[:, 0])
    export(lonely, tmp_path / "out", kinds=FORMATS)
    file = (tmp_path / "out" / "mine.stablehlo").read_bytes()
    read = jax.export.deserialize(bytearray(file))
    assert read.module_kept_var_idx == (0, 1)


def test_nothing_of_wlplan_is_needed_to_read_it(tmp_path: Path) -> None:
    export(LINE, tmp_path / "out", kinds=["stablehlo", "onnx"])
    code = (
        "import sys, numpy as np, jax, onnxruntime\n"
        "check = dict(np.load('out/check.npz'))\n"
        "given = check['input_in0'], check['input_in1']\n"
        "read = jax.export.deserialize(bytearray(open('out/mine.stablehlo', 'rb').read()))\n"
        "assert np.allclose(read.call(*given)[1], check['output_out1'], atol=1e-6)\n"
        "session = onnxruntime.InferenceSession('out/mine.onnx')\n"
        "got = session.run(['out1'], dict(zip(('in0', 'in1'), given)))\n"
        "assert np.allclose(got[0], check['output_out1'], atol=1e-6)\n"
        "print([name for name in ('wlplan', 'flax') if name in sys.modules])\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, cwd=tmp_path
    )
    assert (done.stdout.strip(), done.returncode) == ("[]", 0), done.stderr


def test_the_checksum_is_of_the_numbers() -> None:
    assert checksum({"a": NUMBERS}) == checksum({"a": NUMBERS.copy()})
    assert checksum({"a": NUMBERS}) != checksum({"a": NUMBERS + 1e-6})


# --- what is refused, and leaves nothing behind


def test_a_file_that_computes_something_else_is_refused(tmp_path: Path) -> None:
    traced = iter(range(100))
    # Another function each time that it is traced: a file of it is never the original.
    moving = function_of(lambda x: (x.sum() + next(traced),), NUMBERS)
    for kind in FORMATS:
        with pytest.raises(InputError, match=r"out0 is off by .* nothing was written"):
            export(moving, tmp_path / "out", kinds=[kind])
    assert list(tmp_path.iterdir()) == []


def test_what_is_no_number_is_off() -> None:
    check_agrees(Compared("f", {"a": 1e-6}, {"a": 1e-6}), 1e-4)
    for bad in (2e-4, float("inf"), float("nan")):
        with pytest.raises(InputError, match="a is off"):
            check_agrees(Compared("f", {"a": bad}, {"a": bad}), 1e-4)


def test_nothing_foreign_is_replaced(tmp_path: Path) -> None:
    place = tmp_path / "out"
    export(LINE, place, kinds=["stablehlo"])
    export(LINE, place, kinds=["mlir"])
    assert not (place / "mine.stablehlo").exists()
    (place / "notes.txt").write_text("mine")
    before = {path: path.read_bytes() for path in place.iterdir()}
    with pytest.raises(InputError, match="holds something that is no export"):
        export(LINE, place, kinds=["stablehlo"])
    assert {path: path.read_bytes() for path in place.iterdir()} == before
    (tmp_path / "file").write_text("mine")
    with pytest.raises(InputError, match="is a file"):
        export(LINE, tmp_path / "file")
    other = tmp_path / "other"
    other.mkdir()
    (other / "export.json").write_text('{"format": "theirs"}')
    with pytest.raises(InputError, match="no export of wlplan"):
        export(LINE, other)


def test_what_onnx_cannot_hold_is_named(tmp_path: Path) -> None:
    places = np.array([[0], [1], [2], [0], [1]], np.int32)
    looking_up = function_of(lambda x, i: (x[i[0]],), NUMBERS, places)
    with pytest.raises(InputError, match="does not know what JAX calls gather: export as stable"):
        export(looking_up, tmp_path / "out", kinds=["onnx"])
    export(looking_up, tmp_path / "out", kinds=["stablehlo"])


def test_what_calls_back_into_python_is_refused(tmp_path: Path) -> None:
    def calls(x: jax.Array) -> tuple[jax.Array]:
        shape = jax.ShapeDtypeStruct((), jnp.float32)
        return (jax.pure_callback(lambda v: v, shape, x[0], vmap_method="sequential"),)

    for kind in ("stablehlo", "mlir"):
        with pytest.raises(InputError, match="calls back into Python"):
            export(function_of(calls, NUMBERS), tmp_path / "out", kinds=[kind])
    assert list(tmp_path.iterdir()) == []


def test_a_missing_library_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(InputError, match=r"^onnx: needs onnxruntime.*wlplan\[export\]"):
        export(LINE, tmp_path / "out", kinds=["stablehlo", "onnx"])
    assert list(tmp_path.iterdir()) == []


def test_arguments_that_make_no_sense_are_refused(tmp_path: Path) -> None:
    for kinds, tolerance, words in (
        ([], 1e-4, "no kind of file"),
        (["tflite"], 1e-4, "unknown kind of file 'tflite'"),
        (["stablehlo"], float("nan"), "tolerance"),
    ):
        with pytest.raises(InputError, match=words):
            export(LINE, tmp_path / "out", kinds=kinds, tolerance=tolerance)


# --- ONNX: each rule beside JAX


def _loop(x: jax.Array) -> jax.Array:
    """As many halvings as the number asks for: another count for each case."""

    def halved(state: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        return 0.5 * state[0], state[1] + 1

    return lax.while_loop(lambda state: jnp.abs(state[0]) > 0.1, halved, (x[0], jnp.int32(0)))[0]


RULES: dict[str, Callable[[jax.Array], jax.Array]] = {
    "atan2": lambda x: jnp.arctan2(x[0], x[1]),
    "atan2 on the axes": lambda x: jnp.arctan2(jnp.sign(x[0]), 0.0 * x[1]),
    "powers": lambda x: (jnp.abs(x) ** 1.5).sum() + (x**3).sum() + jnp.square(x).prod(),
    "logarithms": lambda x: jnp.log1p(jnp.abs(x)).sum() - jnp.expm1(x).max(),
    "roots": lambda x: lax.rsqrt(1.0 + jnp.abs(x)).min(),
    "choice": lambda x: jnp.where(x[0] > 0.0, x[1], x[2]),
    "logic": lambda x: ((x > 0.0).any() & ~(x > 1.0).all() | (x[0] != x[1])).astype(jnp.float32),
    "choice of truths": lambda x: jnp.where(x[0] > 0, x[1] > 0, x[2] > 0).astype(jnp.float32),
    "unequal truths": lambda x: ((x[0] > 0) != (x[1] > 0)).astype(jnp.float32),
    "clamp": lambda x: jnp.clip(x, -0.3, 0.4).sum() + lax.clamp(-0.1, x[0], 0.1),
    "parts": lambda x: jnp.concatenate([x, -x])[1:6:2].sum() + jnp.pad(x, 2)[2],
    "counts": lambda x: (x * jnp.arange(3.0)).sum(),
    "matrices": lambda x: (jnp.outer(x, x) @ jnp.linspace(0.0, 1.0, 3) @ x.T).sum(),
    "stacks": lambda x: jnp.stack([x, 2.0 * x], axis=1)[:, 1].sum(),
    "loop": _loop,
    "softplus": lambda x: jax.nn.softplus(x).sum() + jax.nn.leaky_relu(x).sum(),
}


@pytest.mark.parametrize("rule", RULES)
def test_a_rule_of_onnx_is_that_of_jax(rule: str, tmp_path: Path) -> None:
    cases = np.concatenate([NUMBERS, -NUMBERS, 2.0 * NUMBERS])
    function = function_of(lambda x: (jnp.asarray(RULES[rule](x), jnp.float32),), cases)
    (found,) = export(function, tmp_path / "out", kinds=["onnx"], tolerance=1e-5)
    assert found.relative["out0"] < 1e-5


# --- predictors and worlds


def _split(network: Callable[[], Any]) -> Any:
    return nnx.split(nnx.jit(network)())


def _psi_low(*, scattered: bool = False, seed: int = 0) -> LowPerformanceModel:
    graph, params = _split(lambda: PsiLow((8,), scattered=scattered, rngs=nnx.Rngs(seed)))
    return LowPerformanceModel(params, INPUTS, OUTPUTS, graph)


def _ensemble() -> Ensemble:
    members = [_psi_low(scattered=True, seed=seed) for seed in (0, 1)]
    params = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(one.params for one in members))
    return Ensemble(
        members[0].replace(params=params), jnp.array([1.0, 1.5, 2.0]), jnp.array([0.0, 0.1, 0.2])
    )


def _psi_high(encoder: str) -> HighPerformanceModel:
    graph, params = _split(lambda: PsiHigh((8,), encoder=encoder, rngs=nnx.Rngs(0)))
    return HighPerformanceModel(params, INPUTS, OUTPUTS, graph, MAPS)


def _stall() -> StallModel:
    graph, params = _split(lambda: StallNetwork((8,), rngs=nnx.Rngs(0)))
    return StallModel(params, MAPS, INPUTS, graph)


def _phi() -> HeightChangeModel:
    def network() -> HeightChange:
        made = HeightChange((8,), rngs=nnx.Rngs(0))
        # Untrained patterns are nothing: these have a dig in them.
        made.change.basis[...] = jax.random.normal(jax.random.key(0), made.change.basis.shape)
        made.before.basis[...] = jax.random.normal(jax.random.key(1), made.before.basis.shape)
        return made

    graph, params = _split(network)
    return HeightChangeModel(params, graph)


def _phi_vae() -> VaePileStateModel:
    graph, params = _split(lambda: PhiVae((8,), rngs=nnx.Rngs(0)))
    return VaePileStateModel(params, graph)


@functools.cache
def asked_of(world: Any, count: int = 3) -> Asked:
    pile = cone()
    return Asked(world, pile, toe_contour(pile), Site(), {"world": "mine"}, count=count)


@pytest.mark.parametrize(
    ("name", "made"),
    [
        ("performance", _psi_low),
        ("performance", _ensemble),
        ("performance", lambda: _psi_high("principal")),
        pytest.param(
            "performance", lambda: _psi_high("convolutional"), marks=pytest.mark.slow, id="paper"
        ),
        ("stall", _stall),
        ("pile-state", _phi),
        pytest.param("pile-state", _phi_vae, marks=pytest.mark.slow, id="vae"),
    ],
)
def test_every_kind_of_predictor_goes_into_every_file(
    name: str, made: Callable[[], Any], tmp_path: Path
) -> None:
    psi, phi, stall = _psi_low(), Strip(), None
    if name == "performance":
        psi = made()
    elif name == "stall":
        stall = made()
    else:
        phi = made()
    world = wlplan.LearnedWorld(psi, phi, stall=stall)
    function = portable(name, asked_of(world))
    compared = export(function, tmp_path / "out", kinds=FORMATS)
    assert all(max(found.relative.values()) < 3e-5 for found in compared)
    said = json.loads((tmp_path / "out" / "export.json").read_text())
    check = check_of(tmp_path / "out")
    for port in said["outputs"]:
        values = check[f"output_{port['name']}"]
        assert np.isfinite(values).all()
        assert len(np.unique(values)) > 1, "the cases have to tell one function from another"
    given = {"performance": psi, "stall": stall, "pile-state": phi}[name]
    assert said["origin"] == {"world": "mine", "sha256": checksum(given)}


def sliding(pile: Pile, pose: Pose, action: Action) -> tuple[Pile, Performance]:
    """A world in closed form: everything sinks by a part that the action says."""
    part = 0.1 * action.delta_bm * jnp.cos(pose.heading) ** 2
    above = pile.height - pile.floor
    mass = (part * above).sum() * pile.cell_size**2 * 1.7
    after = pile.replace(height=pile.height - part * above)
    return after, Performance(mass, 10.0 + pose.x + pile.origin[0], 100.0 * action.k_bm)


def test_a_world_takes_maps_of_the_size_of_the_pile(tmp_path: Path) -> None:
    function = portable("world", asked_of(sliding))
    export(function, tmp_path / "out", kinds=["stablehlo", "mlir"])
    said = json.loads((tmp_path / "out" / "export.json").read_text())
    assert said["inputs"][0]["shape"] == ["batch", 161, 161]
    assert said["origin"]["cell_size"] == 0.1
    check = check_of(tmp_path / "out")
    # Ordered as export.json has them: without wlplan one has nothing else to go by.
    given = [check[f"input_{port['name']}"] for port in said["inputs"]]
    file = (tmp_path / "out" / "world.stablehlo").read_bytes()
    after, mass, *_ = jax.export.deserialize(bytearray(file)).call(*given)
    left = (given[0] - np.asarray(after)).sum(axis=(1, 2)) * 0.01 * 1.7
    np.testing.assert_allclose(mass, left, rtol=1e-3)


def test_a_part_that_a_world_has_not_is_refused() -> None:
    for name, words in (
        ("performance", "no predictor of performance"),
        ("stall", "no predictor of stalls"),
        ("pile-state", "no learned pile state"),
        ("truck", "unknown function 'truck': choose one of"),
    ):
        with pytest.raises(InputError, match=words):
            portable(name, asked_of(sliding))
    with pytest.raises(InputError, match="no learned pile state"):
        portable("pile-state", asked_of(wlplan.LearnedWorld(_psi_low())))
    assert set(FUNCTIONS) == {"next-load", "performance", "pile-state", "stall", "world"}


@pytest.mark.slow
@pytest.mark.parametrize("world", ["low", "hybrid", "high", "simulator"])
def test_worlds_that_ship_can_be_exported(world: str, tmp_path: Path) -> None:
    function = portable("world", asked_of(load_world(world), count=2))
    export(function, tmp_path / "out", kinds=["stablehlo", "mlir"])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["performance", "pile-state", "stall"])
def test_predictors_that_ship_can_be_exported(name: str, tmp_path: Path) -> None:
    function = portable(name, asked_of(load_world("high"), count=8))
    export(function, tmp_path / "out", kinds=FORMATS, tolerance=2e-5)


# --- the command line


def test_the_command_writes_and_says_how_far_off_it_is(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["export", "stall", "--format", "onnx", "--out", str(tmp_path / "out")]
    assert cli.main(words) == 0
    out = capsys.readouterr().out
    assert "stall.onnx" in out
    assert "of its largest value" in out
    assert cli.main([*words, "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["origin"]["world"] == "hybrid"
    assert said["files"]["stall.onnx"]["relative_difference"]["probability"] < 1e-4
    assert cli.main([*words, "--tolerance", "0"]) == 2
    assert "more than the tolerance of 0" in capsys.readouterr().err
    assert json.loads((tmp_path / "out" / "export.json").read_text()) == said


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("pile-state",), "no learned pile state: choose --world high"),
        (("moon",), "'moon' is not one of"),
        (("world", "--world", "simulator", "--model", "."), "--model does not go with"),
    ],
)
def test_the_command_refuses_in_one_line(
    words: tuple[str, ...],
    message: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert cli.main(["export", *words, "--out", str(tmp_path / "out")]) == 2
    err = capsys.readouterr().err
    assert message in err
    assert err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []
