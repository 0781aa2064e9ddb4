"""Notebooks: pages of the site with what their cells print and show.

python -m docs.building.notebooks docs/site/howto/own_loss.ipynb     # run it, and keep its outputs in it
"""

from __future__ import annotations

import base64
import os
import sys
from pathlib import Path
from typing import Any


def executed(path: Path) -> Any:
    """Return a notebook after all its cells ran, in a kernel of its own; a failing cell is an error."""
    import nbformat
    from nbclient import NotebookClient

    notebook = nbformat.read(path, as_version=4)
    options: dict[str, Any] = {
        "timeout": 600,
        "record_timing": False,
        "coalesce_streams": True,
        "kernel_name": "python3",
    }
    shown_inline = {"MPLBACKEND": "module://matplotlib_inline.backend_inline"}
    NotebookClient(notebook, **options).execute(env={**os.environ, **shown_inline})
    notebook.metadata["language_info"] = {"name": "python"}  # not the version that happened to run it
    return notebook


def notebook_page(path: Path) -> str:
    """Return a notebook as a page; its pictures are written beside it."""
    import nbformat

    cells = nbformat.read(path, as_version=4).cells
    title, *others = cells
    parts = [title.source, f"You can also [download this notebook]({path.name}), and run it."]
    for number, cell in enumerate(others, 1):
        parts.append(cell.source if cell.cell_type == "markdown" else f"```python\n{cell.source}\n```")
        picture = path.with_name(f"{path.stem}_{number}.png")
        parts += [_shown(output, picture, cell.metadata.get("alt", "")) for output in cell.get("outputs", [])]
    return "\n\n".join(part for part in parts if part) + "\n"


def _shown(output: Any, picture: Path, alt: str) -> str:
    """Return an output of a cell as it is on the page."""
    data = output.get("data", {})
    if "image/png" in data:
        picture.write_bytes(base64.b64decode(data["image/png"]))
        return f"![{alt}]({picture.name})"
    if "text/html" in data:
        return str(data["text/html"]).strip()
    text = output.get("text") or data.get("text/plain", "")
    return f"```text\n{text.rstrip()}\n```"


if __name__ == "__main__":
    import nbformat

    for name in sys.argv[1:]:
        nbformat.write(executed(Path(name)), name)
