"""`cqrun schema` prints a JSON Schema with every plug-in."""

from __future__ import annotations

import json

from typer.testing import CliRunner

from cqrun.cli.app import app
from cqrun.scene.schema_json import scene_json_schema


def test_it_prints_the_scene_schema_as_json():
    done = CliRunner().invoke(app, ["schema"])
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout) == scene_json_schema()
    assert '"fixed_corotated"' in done.stdout
