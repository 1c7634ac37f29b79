"""What every module must have. What it may import is a contract in pyproject.toml."""

import ast
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "wlplan"


def modules(package: Path) -> dict[str, Path]:
    """Name below the package -> file; a package has the name of its directory."""
    found = {}
    for path in sorted(package.rglob("*.py")):
        parts = path.relative_to(package).with_suffix("").parts
        parts = parts[:-1] if parts[-1] == "__init__" else parts
        found[".".join(parts)] = path
    return found


def is_overload(node: ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef) -> bool:
    """Whether a definition only says one of the types of the next."""
    return any(isinstance(d, ast.Name) and d.id == "overload" for d in node.decorator_list)


def undocumented(name: str, source: str) -> list[str]:
    """Public definitions without a docstring."""
    tree = ast.parse(source)
    missing = [] if ast.get_docstring(tree) else [name]

    def visit(body: Sequence[ast.stmt], prefix: str) -> None:
        for node in body:
            if isinstance(node, ast.If | ast.Try):
                visit(node.body, prefix)
            if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
                continue
            if node.name.startswith("_") or is_overload(node):
                continue
            if not ast.get_docstring(node):
                missing.append(f"{prefix}.{node.name}")
            if isinstance(node, ast.ClassDef):
                visit(node.body, f"{prefix}.{node.name}")

    visit(tree.body, name)
    return missing


def prints(source: str) -> list[int]:
    """Lines that call `print`."""
    return [
        node.lineno
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.Call)
        and isinstance(node.func, ast.Name)
        and node.func.id == "print"
    ]


FILES = modules(PACKAGE)


def test_everything_public_has_a_docstring() -> None:
    missing = [
        entry for name, path in FILES.items() for entry in undocumented(name, path.read_text())
    ]
    assert not missing, missing


def test_only_the_command_line_prints() -> None:
    found = {
        name: prints(path.read_text())
        for name, path in FILES.items()
        if name.split(".")[0] != "cli"
    }
    assert not any(found.values()), {name: lines for name, lines in found.items() if lines}


def test_importing_the_package_is_light() -> None:
    code = "import sys, wlplan; print(sorted({'jax', 'flax', 'matplotlib'} & set(sys.modules)))"
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60
    )
    assert result.stdout.strip() == "[]"


def test_every_public_name_exists_where_the_package_says() -> None:
    """Read off the files, since importing all of them takes seconds."""
    import wlplan

    public: set[str] = set()
    for node in ast.parse((PACKAGE / "__init__.pyi").read_text()).body:
        if not isinstance(node, ast.ImportFrom):
            continue
        # Its modules, and what it defines.
        assert node.module is not None
        inside = f"{node.module}."
        defined = {name.removeprefix(inside) for name in FILES if name.startswith(inside)}
        for inner in ast.parse(FILES[node.module].read_text()).body:
            if isinstance(inner, ast.ImportFrom):
                defined |= {alias.asname or alias.name for alias in inner.names}
            elif isinstance(inner, ast.Assign):
                defined |= {t.id for t in inner.targets if isinstance(t, ast.Name)}
            elif hasattr(inner, "name"):
                defined.add(inner.name)
        names = {alias.name for alias in node.names}
        defined |= {name for name in names if f"{node.module}.{name}" in FILES}
        assert names <= defined, (node.module, names - defined)
        public |= names
    assert set(wlplan.__all__) == public <= set(dir(wlplan))  # type: ignore[attr-defined]
    with pytest.raises(AttributeError, match="no_such_name"):
        _ = wlplan.no_such_name  # type: ignore[attr-defined]


def test_the_checks_of_docstrings_and_prints_can_fail() -> None:
    source = '"""Doc."""\nclass A:\n    """Doc."""\n    def b(self): print(1)\ndef _c(): pass\n'
    assert undocumented("m", source) == ["m.A.b"]
    assert undocumented("m", "x = 1") == ["m"]
    assert prints(source) == [4]
