"""`python -m docs.building [FOLDER]`: build the documentation; warnings are errors."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

from docs.building.layout import ROOT, lay_out


def build(output: Path) -> int:
    """Build the site into a folder; return the exit status of Sphinx."""
    output.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch:
        source, cache = Path(scratch) / "source", Path(scratch) / "cache"
        lay_out(source)
        command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html", "-d", str(cache)]
        return subprocess.run([*command, str(source), str(output)], cwd=ROOT, check=False).returncode


if __name__ == "__main__":
    place = Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "build" / "docs"
    status = build(place)
    if not status:
        print(f"the documentation: {place / 'index.html'}")
    sys.exit(status)
