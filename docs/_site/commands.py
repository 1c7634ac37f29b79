"""The directive `command`: what a command of `wlplan` does and takes, as its `--help` says it."""

from typing import Any

import click
from docutils import nodes
from sphinx.util.docutils import SphinxDirective

from wlplan.cli import wlplan


def paragraphs(text: str) -> list[str]:
    """Paragraphs of a help text, without the marks that keep click from wrapping one."""
    parts = text.replace("\b", "").split("\n\n")
    return [" ".join(part.split()) for part in parts if part.strip()]


class Command(SphinxDirective):
    """Usage, meaning and options of the command that is named."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """The nodes that stand for it."""
        command = wlplan.commands[self.arguments[0]]
        context = click.Context(command, info_name=f"wlplan {command.name}")
        usage = command.get_usage(context).removeprefix("Usage: ")
        shown: list[nodes.Node] = [
            nodes.paragraph("", text) for text in paragraphs(command.help or "")
        ]
        shown.append(nodes.literal_block(usage, " ".join(usage.split()), language="text"))
        options = nodes.definition_list(classes=["options"])
        for parameter in command.get_params(context):
            record = parameter.get_help_record(context)
            if record is None or not record[1]:
                continue
            term = nodes.term("", "", nodes.literal("", record[0]))
            meaning = nodes.definition("", nodes.paragraph("", " ".join(record[1].split())))
            options += nodes.definition_list_item("", term, meaning)
        shown.append(options)
        for text in paragraphs(command.epilog or ""):
            example = text.removeprefix("Example:").strip()
            shown.append(nodes.literal_block(example, example, language="sh"))
        return shown


def setup(app: Any) -> dict[str, bool]:
    """For Sphinx."""
    app.add_directive("command", Command)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
