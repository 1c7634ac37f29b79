"""Data flows one way: what a module may import, and what every module must have."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "wlplan"

# From the bottom to the top: a module imports only from what stands before it.
LAYERS = [
    *("errors", "types", "units", "precision", "compilation", "published", "io.files"),
    *("machine", "loading_cycle", "presets"),
    *("ground", "pile.volumes", "pile.noise", "pile.seeds", "pile.resampling", "pile.outlines"),
    *("pile.toe", "pile"),
    *("heightmap", "characteristics"),
    *("automaton.neighbours", "automaton.slopes", "automaton.windows", "automaton.flow"),
    *("automaton.rounds", "automaton.relaxation", "automaton", "excavation"),
    *("simulator.controller", "simulator.soil", "simulator.loader", "simulator.terrain"),
    *("simulator.cycle", "simulator.trajectory", "simulator.world", "simulator"),
    *("dem.grains", "dem.bucket", "dem.loader", "dem.columns", "dem.packing", "dem.engine"),
    *("dem.bed", "dem.cycle", "dem.worker", "dem.process", "dem.world", "dem"),
    *("sampling", "dataset.variables", "dataset.protocol", "dataset.workbench", "dataset.worker"),
    *(
        "dataset.crew",
        "dataset.batches",
        "dataset.store",
        "dataset.collecting",
        "dataset.merging",
        "dataset.probes",
    ),
    "dataset",
    *("models", "models.normaliser", "models.layers", "models.performance"),
    *("models.performance_high", "models.ensemble", "models.pile_state", "models.height_change"),
    *("training.evaluation", "training.fitting", "training.storage", "training.session"),
    *("training.performance", "training.pile_state", "training.weights", "training"),
    *("worlds", "horizon"),
    *("transport", "objective"),
    *("planner.toe", "planner.job", "planner.search", "planner.gradient", "planner"),
    *("diggability", "gradcheck", "io.plans", "io.scans", "io"),
    *(
        "plots.paper",
        "plots.relief",
        "plots.truck",
        "plots.digs",
        "plots.figures",
        "plots",
        "report",
    ),
    *("bench.timing", "bench.digs", "bench.baselines", "bench.setup", "bench.automata"),
    *("bench.inference", "bench.rollouts", "bench.planning", "bench.items", "bench"),
    *("cli.options", "cli.outputs", "cli.inputs", "cli.progress", "cli.played", "cli.engines"),
    *("cli.planning", "cli.maps", "cli.gradients", "cli.evaluated", "cli.learning"),
    "cli.benchmark",
    *("cli", "__main__"),
]


def modules(package):
    """Name below the package -> file; a package has the name of its directory."""
    found = {}
    for path in sorted(package.rglob("*.py")):
        parts = path.relative_to(package).with_suffix("").parts
        parts = parts[:-1] if parts[-1] == "__init__" else parts
        found[".".join(parts)] = path
    return found


def imports(tree, name, known, *, is_package=False):
    """Modules of the package that a module imports, wherever in the file, and foreign ones."""
    own, foreign = set(), set()
    here = ["wlplan", *(name.split(".") if name else [])]
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            targets = [(alias.name, None) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                up = here[: len(here) - node.level + is_package]
                base = ".".join([*up, *([node.module] if node.module else [])])
            targets = [(base, alias.name) for alias in node.names]
        else:
            continue
        for base, imported in targets:
            if base.split(".")[0] != "wlplan":
                foreign.add(base.split(".")[0])
                continue
            inside = base.removeprefix("wlplan").removeprefix(".")
            member = f"{inside}.{imported}".lstrip(".")
            own.add(member if member in known else inside)
    return own, foreign


def violations(name, source, layers, known, *, is_package=False):
    """What a module imports although it may not."""
    own, foreign = imports(ast.parse(source), name, known, is_package=is_package)
    wrong = [
        f"{name} imports {other or 'wlplan'}, which does not stand before it"
        for other in sorted(own)
        # The package itself holds the version and nothing else that a module may need.
        if other and (other not in layers or layers.index(other) >= layers.index(name))
    ]
    return wrong + [
        f"{name} imports {other}" for other in sorted(foreign & {"tests", "laws", "experiments"})
    ]


def undocumented(name, source):
    """Public definitions without a docstring."""
    tree = ast.parse(source)
    missing = [] if ast.get_docstring(tree) else [name]

    def visit(body, prefix):
        for node in body:
            if isinstance(node, ast.If | ast.Try):
                visit(node.body, prefix)
            if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
                continue
            if node.name.startswith("_"):
                continue
            if not ast.get_docstring(node):
                missing.append(f"{prefix}.{node.name}")
            if isinstance(node, ast.ClassDef):
                visit(node.body, f"{prefix}.{node.name}")

    visit(tree.body, name)
    return missing


def prints(source):
    """Lines that call `print`."""
    return [
        node.lineno
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.Call)
        and isinstance(node.func, ast.Name)
        and node.func.id == "print"
    ]


FILES = modules(PACKAGE)
# The package itself only forwards names, from every layer, when they are first used.
INNER = sorted(name for name in FILES if name)


def test_every_module_has_its_layer():
    assert sorted(LAYERS) == INNER


@pytest.mark.parametrize("name", INNER)
def test_imports_go_down(name):
    path = FILES[name]
    found = violations(name, path.read_text(), LAYERS, FILES, is_package=path.name == "__init__.py")
    assert not found, found


def test_everything_public_has_a_docstring():
    missing = [
        entry for name, path in FILES.items() for entry in undocumented(name, path.read_text())
    ]
    assert not missing, missing


def test_only_the_command_line_prints():
    found = {
        name: prints(path.read_text())
        for name, path in FILES.items()
        if name.split(".")[0] != "cli"
    }
    assert not any(found.values()), {name: lines for name, lines in found.items() if lines}


def test_importing_the_package_is_light():
    code = "import sys, wlplan; print(sorted({'jax', 'flax', 'matplotlib'} & set(sys.modules)))"
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60
    )
    assert result.stdout.strip() == "[]"


def test_every_public_name_exists_where_the_package_says():
    """Read off the files, since importing all of them takes seconds."""
    import wlplan

    for module, names in wlplan._MODULES.items():
        defined = set()
        for node in ast.parse(FILES[module].read_text()).body:
            if isinstance(node, ast.ImportFrom):
                defined |= {alias.asname or alias.name for alias in node.names}
            elif isinstance(node, ast.Assign):
                defined |= {t.id for t in node.targets if isinstance(t, ast.Name)}
            elif hasattr(node, "name"):
                defined.add(node.name)
        assert set(names) <= defined, (module, set(names) - defined)
    assert set(wlplan.__all__) <= set(dir(wlplan))
    with pytest.raises(AttributeError, match="no attribute"):
        _ = wlplan.no_such_name


@pytest.mark.parametrize(
    ("source", "complaint"),
    [
        ("from wlplan.cli import main", "pile imports cli"),
        ("import wlplan.planner.job", "pile imports planner.job"),
        ("from wlplan.planner import gradient", "pile imports planner.gradient"),
        ("def f():\n    from .cli import main", "pile imports cli"),
        ("from . import cli", "pile imports cli"),
        ("from wlplan.pile import volume", "pile imports pile"),
        ("from wlplan.made_up import x", "pile imports made_up"),
        ("from tests.laws import assert_gradient", "pile imports tests"),
        ("import experiments.table_1", "pile imports experiments"),
    ],
)
def test_the_check_of_imports_can_fail(source, complaint):
    (found,) = violations("pile", source, LAYERS, FILES)
    assert complaint in found


def test_the_check_of_imports_lets_pass_what_it_should():
    source = "import jax\nfrom wlplan.types import Pile\nfrom . import machine"
    assert not violations("pile", source, LAYERS, FILES)
    inside = "from .soil import x\nfrom wlplan.simulator import loader\nfrom ..units import GRAVITY"
    assert not violations("simulator.terrain", inside, LAYERS, FILES)


def test_the_checks_of_docstrings_and_prints_can_fail():
    source = '"""Doc."""\nclass A:\n    """Doc."""\n    def b(self): print(1)\ndef _c(): pass\n'
    assert undocumented("m", source) == ["m.A.b"]
    assert undocumented("m", "x = 1") == ["m"]
    assert prints(source) == [4]
