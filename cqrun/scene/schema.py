"""Scene version 1: its sections, checked against each other, and the origin of each value."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Self

from pydantic import PrivateAttr, model_validator

from cqrun.explain import complaint
from cqrun.plugin.choice import Chosen
from cqrun.plugin.contract import Plugin
from cqrun.plugin.reference import NamesFile
from cqrun.scene.defaults import with_defaults
from cqrun.scene.origin import Origin
from cqrun.scene.plain_data import impossible_data, one_line
from cqrun.scene.references import findings_between
from cqrun.scene.sections import Sections
from cqrun.scene.walk import marked


class Scene(Sections):
    """A scene: a world, its bodies, what acts on them and for how long, and what a job computes."""

    _origin: Origin = PrivateAttr(default_factory=Origin)

    def set_origin(self, origin: Origin) -> None:
        """Store the origin of the scene; the file names in its parts are relative to it."""
        self._origin = origin
        for found in marked(self, NamesFile):
            found.part.set_folder(self.resolve_path(""))

    @property
    def source(self) -> Path | None:
        """The file from which the scene was read; files that it names are relative to it."""
        return self._origin.source

    @property
    def text(self) -> str:
        """The text from which the scene was read; empty for a scene made from data."""
        return self._origin.text

    def where(self, path: str) -> str:
        """Return `file:line:column` of a key path, or the override that set it."""
        return self._origin.where_path(path)

    def resolve_path(self, file: str) -> Path:
        """Return the path of a file that the scene names."""
        return self._origin.path_of(file)

    def plugin_paths(self) -> dict[str, Path]:
        """Return the paths of the scene's plug-in files, by the names in the scene."""
        return dict(zip(self.plugins, self._origin.plugin_paths(self.plugins), strict=True))

    def with_plugin(self, key: str, plugin: Plugin) -> Scene:
        """Return this scene with another optimizer or controller."""
        changed = self.model_copy(update={key: Chosen(plugin.name, plugin)})
        changed.set_origin(self._origin)
        return changed

    @model_validator(mode="before")
    @classmethod
    def _fill_in(cls, data: Any) -> Any:
        if isinstance(data, dict) and isinstance(data.get("title"), str):
            data = {**data, "title": one_line(data["title"])}
        if findings := list(impossible_data(data)):
            raise complaint("Scene", findings)
        return with_defaults(data)

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        findings = findings_between(self)
        if findings:
            raise complaint("Scene", findings)
        return self
