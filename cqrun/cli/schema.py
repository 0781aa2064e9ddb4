"""`cqrun schema`: the JSON Schema of scenes."""

from __future__ import annotations

import json

import typer


def schema() -> None:
    """Print the JSON Schema of scenes: `cqrun schema > cqrun.schema.json` gives editors their completion."""
    from cqrun.scene.schema_json import scene_json_schema

    typer.echo(json.dumps(scene_json_schema(), indent=2))
