"""Lets the reference say what the sources say beside the docstrings.

Fields of small frozen classes are explained by the comment beside or above them; the reference
lists them, with type and default, in place of a signature that repeats them. What stands in single
backticks becomes a link if it is the name of something that the site has a place for.
"""

import ast
import dataclasses
import inspect
import re
import textwrap
from typing import Any

from docutils import nodes
from sphinx.domains.python import PyXRefRole
from sphinx.util.typing import stringify_annotation

from wlplan.planning.proposals import Progress
from wlplan.types import World
from wlplan.worlds.capabilities import StallProbability, Uncertainty

ALIASES = {
    stringify_annotation(alias, "smart"): f"~wlplan.{name}"
    for name, alias in {
        "types.World": World,
        "planning.proposals.Progress": Progress,
        "worlds.capabilities.Uncertainty": Uncertainty,
        "worlds.capabilities.StallProbability": StallProbability,
    }.items()
}
"""What a name stands for, as Sphinx writes it -> the name, which says more."""

LONGEST = 64
"""Characters of the names of the fields that are repeated behind the name of a class."""

PLAIN = re.compile(r"-?[\w.]+|'[^']*'|\"[^\"]*\"|\(\)|\([-\w., ]*\)")


def comment_of(node: ast.AnnAssign, lines: list[str]) -> str:
    """The comment on the last line of a field, or else the block of comments above it."""
    if found := re.search(r"\s#\s(?!type:)(.*)", lines[(node.end_lineno or node.lineno) - 1]):
        return re.sub(r"^type: ignore\S*\s+#\s*", "", found[1])
    above: list[str] = []
    for line in reversed(lines[: node.lineno - 1]):
        if not line.strip().startswith("# "):
            break
        above.insert(0, line.strip().removeprefix("# "))
    return " ".join(above)


def fields_of(cls: type) -> dict[str, tuple[str, str, str]]:
    """Name of each field of a dataclass or named tuple -> its type, meaning and default."""
    names = getattr(cls, "_fields", ())
    entries: dict[str, Any] = {}
    if dataclasses.is_dataclass(cls):
        entries = {field.name: field for field in dataclasses.fields(cls) if field.init}
        names = tuple(entries)
    found: dict[str, tuple[str, str]] = {}
    for base in reversed(cls.__mro__):
        if not base.__module__.startswith("wlplan"):
            continue
        lines = textwrap.dedent(inspect.getsource(base)).splitlines()
        (tree,) = ast.parse("\n".join(lines)).body
        assert isinstance(tree, ast.ClassDef)
        for node in tree.body:
            if not isinstance(node, ast.AnnAssign) or not isinstance(node.target, ast.Name):
                continue
            name = node.target.id
            setting = getattr(entries.get(name), "metadata", {}).get("setting")
            meaning = comment_of(node, lines) if setting is None else setting.help
            found[name] = (tidy(ast.unparse(node.annotation)), meaning)
    defaults = getattr(cls, "_field_defaults", {})
    for name, field in entries.items():
        if field.default is not dataclasses.MISSING:
            defaults = {**defaults, name: field.default}
    return {
        name: (*found[name], short(defaults[name]) if name in defaults else "")
        for name in names
        if name in found and not name.startswith("_")
    }


def short(value: Any) -> str:
    """A default as it stands behind a type; nothing if it is longer than a number or a word."""
    text = f"{value:.6g}" if isinstance(value, float) else repr(value)
    return f" = {text}" if PLAIN.fullmatch(text) else ""


def tidy(signature: str) -> str:
    """Names for what they stand for, short arrays, and no space in shapes of one axis."""
    for long, name in ALIASES.items():
        signature = signature.replace(long, name)
    signature = re.sub(r"\b(jaxlib\._jax|numpy|np)\.(?=Array|ndarray)", "", signature)
    return re.sub(r"(['\"]) (\w+['\"])", r"\1\2", signature)


def show_fields(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Adds the fields of a class to its docstring, unless that explains them itself."""
    if what != "class" or not isinstance(obj, type):
        return
    if "Attributes:" in lines:
        lines[lines.index("Attributes:")] = "Args:"
        return
    if fields := fields_of(obj):
        lines += ["", "Args:"]
    for field, (kind, meaning, default) in fields.items():
        typed = f"`{kind}`" if kind.isidentifier() and not default else f"``{kind}{default}``"
        meaning = re.sub(r"([|*])", r"\\\1", meaning)
        lines.append(f"    {field}: {typed}" + (f"; {meaning}" if meaning else ""))


def keep_colons(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Joins again what napoleon took apart at a colon, for a type: ours stand in signatures."""
    for index, line in reversed(list(enumerate(lines))):
        if found := re.match(r":r?type: (.*)", line):
            del lines[index]
            first = next((n for n, text in enumerate(lines) if text.startswith(":returns: ")), 0)
            mark = ":returns: " if lines[first].startswith(":returns: ") else ""
            lines[first] = f"{mark}{found[1]}: {lines[first].removeprefix(mark)}"


def plainer(app: Any, tree: nodes.document) -> None:
    """A colon between a name and what it means, and an array by the name that users know."""
    for text in list(tree.findall(nodes.Text)):
        if text == " -- ":
            text.parent.replace(text, nodes.Text(": "))
        elif text.startswith("jaxlib._jax."):
            text.parent.replace(text, nodes.Text(text.rpartition(".")[2]))


def show_signature(
    app: Any, what: str, name: str, obj: Any, options: Any, signature: str, returns: str
) -> tuple[str, str] | None:
    """Shortens a signature: that of a class with fields is their names, which are listed below."""
    if what == "class" and isinstance(obj, type) and (fields := fields_of(obj)):
        given = ", ".join(fields)
        return f"({given if len(given) <= LONGEST else '...'})", ""
    return (tidy(signature), tidy(returns or "")) if signature else None


def leave_out(app: Any, what: str, name: str, obj: Any, skip: bool, options: Any) -> bool | None:
    """Leaves out what every frozen class has, and fields, which are listed."""
    inherited = name == "replace" or type(obj).__name__ == "_tuplegetter"
    return True if inherited else None


class Name(PyXRefRole):
    """A link for what looks like the name of a class or of something in the package; else code."""

    def run(self) -> tuple[list[nodes.Node], list[Any]]:
        """The nodes that stand for the text."""
        if re.fullmatch(r"(wlplan[.]|[A-Z])[\w.]*", self.text):
            self.name = "py:obj"
            return super().run()
        return [nodes.literal(self.rawtext, self.text)], []

    def process_link(self, env: Any, node: Any, explicit: bool, *text: str) -> tuple[str, str]:
        """Title and target: looked for in all modules."""
        found = super().process_link(env, node, explicit, *text)
        node["refspecific"] = True
        return found


def setup(app: Any) -> dict[str, bool]:
    """For Sphinx."""
    app.setup_extension("sphinx.ext.autodoc")
    # Before napoleon, which reads what is added.
    app.connect("autodoc-process-docstring", show_fields, priority=400)
    app.connect("autodoc-process-docstring", keep_colons, priority=600)
    app.connect("doctree-read", plainer)
    app.connect("autodoc-process-signature", show_signature)
    app.connect("autodoc-skip-member", leave_out)
    app.add_role_to_domain("py", "name", Name())
    return {"parallel_read_safe": True, "parallel_write_safe": True}
