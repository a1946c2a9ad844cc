"""What is wrong with a spec, in one sentence: pydantic's complaints in the words of TOML."""

from __future__ import annotations

import json
from typing import Any

from pydantic import BaseModel, ValidationError

from orthaug._base.checks import nearest
from orthaug._base.errors import KeyedError, cut


def first_message(error: ValidationError, content: dict[str, Any], model: type[BaseModel]) -> str:
    """The first error as `key: found …; expected …`."""
    errors = error.errors()
    # every branch of a union complains: the branch was meant whose type fits, and there the deepest complaint counts
    fitting = [e for e in errors if not e["type"].endswith("_type")]
    first = max(fitting or errors[:1], key=lambda e: len(e["loc"]))
    key = _key(first["loc"], content)
    kind, given = first["type"], first["input"]
    if kind == "extra_forbidden":
        *parents, name = [part for part in first["loc"] if isinstance(part, str | int)]
        known = _known_keys(parents, model)
        return f"unknown key '{key}'{nearest(str(name), known) or ', known are ' + ', '.join(known)}"
    if kind == "missing":
        return f"the key '{key}' is missing"
    if kind == "value_error":
        cause = first.get("ctx", {}).get("error")
        if isinstance(cause, KeyedError):
            return f"`{key}.{cause.key}`{cause.words}"
        text = first["msg"].removeprefix("Value error, ").removesuffix(".")
        return f"'{key}': {text}" if key else text
    same_key = [e["msg"] for e in errors if _key(e["loc"], content) == key]
    expected = " or ".join(dict.fromkeys(_plain(m) for m in same_key))
    return f"'{key}': found {_shown(given)}; expected {expected}"


def _shown(value: Any) -> str:
    """A value as the file writes it, cut where it is long."""
    try:
        text = json.dumps(value, default=str, ensure_ascii=False).replace("Infinity", "inf").replace("NaN", "nan")
    except RecursionError:
        return "what is nested too deeply"
    return cut(text)


def _plain(message: str) -> str:
    """Pydantic's words in those of TOML."""
    if "at least 1 item" in message or "at least 1 character" in message:
        return "at least one entry" if "item" in message else "some text"
    if "after validation" in message:
        return "two numbers, [start, stop]"
    message = message.removeprefix("Input should be ").replace("a valid ", "a ").replace("a integer", "an integer")
    return "a table" if "dictionary" in message else message


def _key(location: tuple[Any, ...], content: Any) -> str:
    """The key's path in the file; pydantic's names of union branches are not part of it."""
    text = ""
    for i, part in enumerate(location):
        if isinstance(part, int):
            text += f"[{part}]"
            content = content[part] if isinstance(content, list) and part < len(content) else None
        elif isinstance(content, dict) and (part in content or i == len(location) - 1):
            text += f".{part}" if text else part
            content = content.get(part)
    return text


def _known_keys(parents: list[Any], model: Any) -> list[str]:
    """The keys of the section at a path such as ["data", "tests", "steps"]."""
    for part in parents:
        if isinstance(part, int) or not isinstance(model, type):
            continue
        field = model.model_fields.get(part)
        model = _section_of(field.annotation) if field else model
    return list(model.model_fields) if isinstance(model, type) else []


def _section_of(annotation: Any) -> Any:
    """The section inside an annotation such as `dict[str, PartSection] | None`."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    for inner in getattr(annotation, "__args__", ()):
        section = _section_of(inner)
        if section is not None:
            return section
    return None
