"""`cqrun schema`: print the JSON Schema of scenes."""

from __future__ import annotations

import json

from cqrun.cli.options import PluginFiles
from cqrun.cli.terminal import echo


def schema(plugin: PluginFiles = None) -> None:
    """Print the JSON Schema of scenes; with `cqrun schema > cqrun.schema.json` editors can complete scenes."""
    from cqrun.scene.plugin_files import load_plugin_files
    from cqrun.scene.schema_json import scene_json_schema

    load_plugin_files(plugin or [])
    echo(json.dumps(scene_json_schema(), indent=2))
