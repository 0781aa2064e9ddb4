"""Read JSON files that a pydantic model describes; error messages give the key path of the problem."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from cqrun.errors import UsageError
from cqrun.explain import in_words, shown
from cqrun.store.atomic import write_text

T = TypeVar("T")

NOT_UTF8, ESCAPED = re.compile("[\udc80-\udcff]"), re.compile(r"\\x([89a-f][0-9a-f])")


class Part(BaseModel):
    """A part of a JSON file; unknown keys, and text in place of numbers, are errors."""

    model_config = ConfigDict(extra="forbid", strict=True)


def optional() -> Any:
    """Return a field that may be None; its key is then omitted from the file."""
    return Field(default=None, exclude_if=lambda value: value is None)


def write_model(file: Path, model: BaseModel) -> None:
    """Write a model. Bytes of file names that are not UTF-8, which JSON cannot have, are written as `\\xe9`.

    Raises:
        ValueError: a number is not finite. UsageError, RunError: the file cannot be written.
    """
    text = json.dumps(model.model_dump(), indent=2, allow_nan=False, ensure_ascii=False) + "\n"
    write_text(file, NOT_UTF8.sub(lambda sign: rf"\\x{ord(sign[0]) - 0xDC00:02x}", text))


def path_of(text: str) -> Path:
    """Return the path that such a file names."""
    return Path(ESCAPED.sub(lambda sign: chr(0xDC00 + int(sign[1], 16)), text))


def read_model(file: Path, model: TypeAdapter[T]) -> T:
    """Return the content of a file as an instance of a model.

    Raises:
        UsageError: the file is damaged, or another program wrote it; the message gives the key path and the problem.
    """
    try:
        text = file.read_bytes()
        return model.validate_json(text)
    except OSError as error:
        raise UsageError(f"{file}: unreadable ({error.strerror}); run the scene again with --fresh") from error
    except ValidationError as error:
        raise UsageError(f"{file}: {_complaint(text, error)}; run the scene again with --fresh") from error


def _complaint(text: bytes, error: ValidationError) -> str:
    """Return where a file is not valid, what is wrong there, and what would be right."""
    first = error.errors(include_url=False)[0]
    if first["type"] == "json_invalid":
        return f"unreadable ({first['msg'].removeprefix('Invalid JSON: ')})"
    if first["type"] == "union_tag_invalid":
        return f"job: must be one of {first['ctx']['expected_tags']}, is {shown(first['ctx']['tag'])}"
    if not first["loc"]:
        return "is not a result: it must be a mapping with the key `job`"
    place = _place(json.loads(text), first["loc"][1:], missing=first["type"] == "missing")
    words = "unknown key" if first["type"] == "extra_forbidden" else in_words(first)
    return f"{'.'.join(map(str, place))}: {words}"


def _place(data: Any, loc: Sequence[Any], *, missing: bool) -> Iterator[int | str]:
    """Yield those keys of pydantic's place `loc` that exist in the plain data; the others are names of types.

    Args:
        missing: whether the problem is that the last key is missing; then it is yielded too.
    """
    for key in loc:
        if (isinstance(data, dict) and key in data) or (isinstance(data, list) and isinstance(key, int)):
            yield key
            data = data[key]
    if missing:
        yield loc[-1]
