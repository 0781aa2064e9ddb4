"""Parts of pages about a command that this version of cqrun does not have are left out."""

from __future__ import annotations

import re

PART = re.compile(r"^<!-- for cqrun (\w+) -->\n(.*?)^<!-- end -->\n", re.MULTILINE | re.DOTALL)


def present(text: str) -> str:
    """Return a page without the parts for commands that do not exist: `<!-- for cqrun NAME -->` to `<!-- end -->`."""
    from cqrun.cli.app import COMMANDS

    names = {command.__name__ for command in COMMANDS}
    return PART.sub(lambda part: part[2] if part[1] in names else "", text)
