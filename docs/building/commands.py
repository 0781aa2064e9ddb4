"""The reference page of the command line, from the commands themselves."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from docs.building.words import escaped


def command_pages() -> dict[str, str]:
    """Return the page of the commands by its path in the site."""
    return {"reference/commands.md": "\n".join(_page())}


def _page() -> Iterator[str]:
    import typer

    from cqrun.cli.app import app

    root: Any = typer.main.get_command(app)
    yield from ("(reference-commands)=", "# Commands", "")
    yield from ("`cqrun -h` lists the commands, and `cqrun COMMAND -h` shows this text.", "")
    yield from ("| command | what it does |", "|---|---|")
    for name, command in root.commands.items():
        yield f"| [{name}](#command-{name}) | {escaped(command.get_short_help_str(200))} |"
    yield from ("", f"{root.epilog}", "")
    for name, command in root.commands.items():
        yield from (f"(command-{name})=", f"## cqrun {name}", "", escaped(command.help or ""), "")
        context = command.make_context(name, [], resilient_parsing=True)
        records = (parameter.get_help_record(context) for parameter in command.params)
        for words, text in (record for record in records if record):
            yield from (f"`{words}`", f": {escaped(text)}", "")
