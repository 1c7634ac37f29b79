"""The documentation as a site: nothing public is missing in it, no page is out of reach."""

import ast
import importlib.util
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from browsers import CHROMIUM

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"


def site_module(name: str) -> ModuleType:
    """A module of what makes the site."""
    spec = importlib.util.spec_from_file_location(name, DOCS / f"_site/{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def named_in(stub: str) -> set[str]:
    """The public names of a package, but modules."""
    tree = ast.parse((ROOT / stub).read_text())
    return {
        alias.name
        for node in tree.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
        if not (node.module == "planning" and alias.name == "planners")
    }


def documented() -> set[str]:
    """What the reference has an entry for."""
    text = "\n".join(page.read_text() for page in DOCS.glob("api/*.md"))
    return {name.split(".")[-1] for name in re.findall(r"^\.\. auto\w+:: ([\w.]+)$", text, re.M)}


@pytest.mark.parametrize("stub", ["wlplan/__init__.pyi", "wlplan/planning/planners/__init__.pyi"])
def test_every_public_name_is_in_the_reference(stub: str) -> None:
    names = named_in(stub)
    assert len(names) > 5
    assert not names - documented()


def test_every_command_is_in_the_reference() -> None:
    from wlplan import cli

    entries = re.findall(r"^```\{command\} (\w+)$", (DOCS / "command-line.md").read_text(), re.M)
    assert sorted(entries) == sorted(cli.wlplan.commands)


def reached(pages_below: Any, root: Path, first: str) -> set[str]:
    """The pages that tables of pages lead to, from the root of the sources, without endings."""
    found, waiting = {first}, [first]
    while waiting:
        name = waiting.pop()
        for pages in pages_below(name, (root / f"{name}.md").read_text()).values():
            waiting += [page for page in pages if page not in found]
            found |= set(pages)
    return found


def test_every_page_is_in_a_table_of_contents() -> None:
    found = reached(site_module("contents").pages_below, ROOT, "docs/index")
    written = [*DOCS.glob("**/*.md"), *ROOT.glob("experiments/results/*.md")]
    pages = {str(page.relative_to(ROOT).with_suffix("")) for page in written}
    assert len(pages) > 30
    assert pages | {"experiments/README", "CONTRIBUTING", "CHANGELOG", "SECURITY"} == found


def test_a_page_without_a_row_is_out_of_reach(tmp_path: Path) -> None:
    (tmp_path / "first.md").write_text(
        "# One\n\n## Top\n\n| page | answers |\n|---|---|\n| [Two](in/two.md) | What? |\n\n"
        "| other | table |\n|---|---|\n| [Four](four.md) | |\n"
    )
    (tmp_path / "in").mkdir()
    (tmp_path / "in/two.md").write_text("| page | |\n|---|---|\n| [Three](../three.md) | |\n")
    (tmp_path / "three.md").write_text("# Three\n")
    below = site_module("contents").pages_below
    assert below("first", (tmp_path / "first.md").read_text()) == {"Top": ["in/two"]}
    assert reached(below, tmp_path, "first") == {"first", "in/two", "three"}


def test_fields_are_explained_by_their_comments() -> None:
    pytest.importorskip("sphinx", reason="the extra [docs] is not installed")
    import wlplan
    from wlplan.site.machine import WheelLoader
    from wlplan.training import PsiLowSettings

    module = site_module("docstrings")
    fields = module.fields_of(wlplan.Pile)
    assert fields["height"] == ("Float[Array, '*batch nx ny']", "surface [m]", "")
    assert fields["ground"][1:] == ("what cannot be moved [m]; None: level 0", " = None")
    assert fields["origin"][1] == "cell [0, 0] [m]"
    # Above the field, on several lines; from the settings of a training; of a named tuple.
    assert module.fields_of(WheelLoader)["length"][1].startswith("Length of the outline")
    assert module.fields_of(PsiLowSettings)["epochs"][1].startswith("Passes over")
    assert module.fields_of(wlplan.Proposals)["limit"][2] == " = None"
    assert module.fields_of(Path) == {}


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, made as `make docs` makes it."""
    pytest.importorskip("sphinx", reason="the extra [docs] is not installed")
    folder = tmp_path_factory.mktemp("site")
    done = subprocess.run(
        [
            *(sys.executable, "-m", "sphinx", "-b", "html", "-W", "--keep-going", "-q"),
            *("-c", str(DOCS), "-d", str(folder / "doctrees"), str(ROOT), str(folder / "html")),
        ],
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert not done.stderr, done.stderr
    return folder / "html"


@pytest.mark.slow
def test_the_site_is_made_without_a_warning(site: Path) -> None:
    for page in ("index", "docs/index", "docs/api/planning", "experiments/README"):
        assert (site / f"{page}.html").is_file()
    # Types by name, fields with their comments, options as the help has them.
    planning = (site / "docs/api/planning.html").read_text()
    assert "Callable[[Pile" not in planning
    assert "their sum, and that of what is missing of the amount" in planning
    assert "X0,Y0,X1,Y1" in (site / "docs/command-line.html").read_text()


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="no chromium here: .ci/run installs it")
def test_no_page_is_wider_than_a_phone_or_fetches_anything(site: Path) -> None:
    sync_api = pytest.importorskip("playwright.sync_api")
    fetched: list[str] = []
    with sync_api.sync_playwright() as play:
        browser = play.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        view = browser.new_page(viewport={"width": 390, "height": 844})
        view.on("request", lambda request: fetched.append(request.url))
        for page in sorted(site.glob("*/**/*.html")):
            view.goto(page.as_uri())
            width = view.evaluate("document.documentElement.scrollWidth")
            assert width <= 390, (page.name, width)
        browser.close()
    assert len(fetched) > 50
    assert all(url.startswith("file:") for url in fetched)
