"""Tables of the spec as pydantic models: a common base, and the keys of the kinds in a registry.

An error is one sentence: pydantic's message in the words of TOML.
"""

from __future__ import annotations

import json
import math
import types
import typing
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import MISSING
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self, TypeVar, Union

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    TypeAdapter,
    ValidationError,
    create_model,
    model_validator,
)

from orthaug._base.checks import nearest
from orthaug._base.errors import KeyedError, shorten
from orthaug._base.registry import Key, OneOf, Option, Registry, SpecLimit
from orthaug.physics.parameters import PhysicalParameter

Count = Annotated[int, Field(ge=0, strict=True)]
Positive = Annotated[int, Field(ge=1, strict=True)]
Finite = Annotated[float, Field(allow_inf_nan=False)]


class Section(BaseModel):
    """A table of the spec; unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class PhysicalSection(Section):
    """One physical parameter."""

    initial: Finite
    unit: str = ""
    min: Finite | None = None
    max: Finite | None = None
    selected: bool = False

    def declared(self, name: str) -> PhysicalParameter:
        """Return the parameter of this name."""
        low, high = (
            -math.inf if self.min is None else self.min,
            math.inf if self.max is None else self.max,
        )
        return PhysicalParameter(name, self.initial, self.unit, low, high, self.selected)


class KindSection(Section):
    """A table whose keys are those of the kinds in a registry.

    Keys of kinds that are not chosen have no effect.
    """

    registries: ClassVar[Mapping[str, Registry]] = {}
    """The registries, by the key that chooses a kind."""

    if TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any: ...

    def declared(self, registry: Registry, kind: str) -> Any:
        """Return the declaration of a kind with the keys that the file gives."""
        return registry.declare(kind, {name: getattr(self, name) for name in self.model_fields_set})

    @model_validator(mode="after")
    def _check(self) -> Self:
        for chooser, registry in self.registries.items():
            self.declared(registry, getattr(self, chooser))
        return self


Kinds = TypeVar("Kinds", bound=KindSection)


def with_kinds(section: type[Kinds], **other: Any) -> type[Kinds]:
    """Return a section with the keys of all kinds of its registries.

    Args:
        section: has each key that chooses a kind, with the default kind.
        other: further fields to replace.
    """
    fields: dict[str, Any] = {}
    for chooser, registry in section.registries.items():
        fields[chooser] = (Literal[tuple(registry)], section.model_fields[chooser].default)
        fields |= {name: _field(key) for name, key in registry.section_keys().items()}
    return create_model(section.__name__, __base__=section, **(fields | other))


def _field(key: Key) -> tuple[Any, Any]:
    """Return a key as pydantic's type and default.

    A required key is None where another kind is chosen.
    """
    if key.default is MISSING:
        return Union[_in_file(key.annotation), None], None  # noqa: UP007  (the parts are known at run time only)
    return _in_file(key.annotation), _thaw(key.default)


def _in_file(annotation: Any) -> Any:
    """Return the type in a file for a type in a declaration: lists for tuples, finite numbers."""
    origin, inner = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is Annotated:
        limits = []
        for limit in annotation.__metadata__:
            if isinstance(limit, OneOf):
                return Literal[tuple(limit.choices)]
            limits += (
                [limit.limit]
                if isinstance(limit, SpecLimit)
                else []
                if isinstance(limit, Option)
                else [limit]
            )
        plain = _in_file(inner[0])
        return Annotated[(plain, *limits)] if limits else plain  # type: ignore[return-value]
    if origin is tuple and inner[-1] is not Ellipsis:
        return Annotated[
            list[_in_file(inner[0])], Field(min_length=len(inner), max_length=len(inner))
        ]
    if origin in (tuple, list, Sequence):
        return list[_in_file(inner[0])]
    if origin is Mapping:
        return dict[inner[0], _in_file(inner[1])]
    if origin in (Union, types.UnionType):
        return Union[tuple(_in_file(branch) for branch in inner)]  # noqa: UP007
    return Annotated[float, Field(allow_inf_nan=False)] if annotation is float else annotation


def _thaw(value: object) -> Any:
    """Return a value with tuples as lists, as files hold them."""
    if isinstance(value, tuple | list):
        return [_thaw(item) for item in value]
    return (
        {name: _thaw(item) for name, item in value.items()} if isinstance(value, Mapping) else value
    )


def first_message(
    error: ValidationError, content: dict[str, object], model: type[BaseModel]
) -> str:
    """Return the first error as `key: found …; expected …`."""
    errors = error.errors()
    # every branch of a union has errors: the branch whose type fits was meant, and there the
    # deepest error counts
    fitting = [e for e in errors if not e["type"].endswith("_type")]
    # a misspelt key has two errors, the missing name and the unknown one: the latter says why
    first = max(fitting or errors[:1], key=lambda e: (len(e["loc"]), e["type"] != "missing"))
    key = _key(first["loc"], content)
    kind, given = first["type"], first["input"]
    if kind == "extra_forbidden":
        *parents, name = [part for part in first["loc"] if isinstance(part, str | int)]
        known = _known_keys(parents, model)
        return (
            f"unknown key '{key}'{nearest(str(name), known) or ', known are ' + ', '.join(known)}"
        )
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
    example = _list_example(first, model) if expected == "a list" else ""
    return f"'{key}': found {_file_text(given)}; expected {expected}{example}"


def _list_example(error: Any, model: type[BaseModel]) -> str:
    """Return `, such as hidden = [6]` for 6; nothing where a list of the value is wrong too."""
    *parents, name = [part for part in error["loc"] if isinstance(part, str | int)]
    section = _section_at(parents, model)
    field = section.model_fields.get(str(name)) if section is not None else None
    if field is None or isinstance(error["input"], dict):
        return ""
    kind: Any = field.annotation
    try:
        TypeAdapter(kind).validate_python([error["input"]], strict=True)
    except ValidationError:
        return ""
    return f", such as {name} = {_file_text([error['input']])}"


def values_by_key(value: object, path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield every value of a spec with its key, such as `baseline.terms[0].regressor`."""
    if isinstance(value, Mapping):
        for key, own in value.items():
            yield from values_by_key(own, f"{path}.{key}" if path else str(key))
    elif isinstance(value, Sequence) and any(isinstance(own, Mapping) for own in value):
        for i, own in enumerate(value):
            yield from values_by_key(own, f"{path}[{i}]")
    else:
        yield path, value


def _file_text(value: object) -> str:
    """Return a value as the file writes it, cut where it is long."""
    try:
        text = (
            json.dumps(value, default=str, ensure_ascii=False)
            .replace("Infinity", "inf")
            .replace("NaN", "nan")
        )
    except RecursionError:
        return "what is nested too deeply"
    return shorten(text)


def _plain(message: str) -> str:
    """Return a message of pydantic in the words of TOML."""
    if "at least 1 item" in message or "at least 1 character" in message:
        return "at least one entry" if "item" in message else "some text"
    if "after validation" in message:
        return "two numbers, [start, stop]"
    message = (
        message.removeprefix("Input should be ")
        .replace("a valid ", "a ")
        .replace("a integer", "an integer")
    )
    return "a table" if "dictionary" in message else message


def _key(location: tuple[Any, ...], content: object) -> str:
    """Return the key's path in the file, without pydantic's names of union branches."""
    text = ""
    for i, part in enumerate(location):
        if isinstance(part, int):
            text += f"[{part}]"
            content = content[part] if isinstance(content, list) and part < len(content) else None
        elif isinstance(content, dict) and (part in content or i == len(location) - 1):
            text += f".{part}" if text else part
            content = content.get(part)
    return text


def _known_keys(parents: Sequence[object], model: Any) -> list[str]:
    """Return the keys of the section at a path such as ["data", "tests", "steps"]."""
    section = _section_at(parents, model)
    return [] if section is None else list(section.model_fields)


def _section_at(parents: Sequence[object], model: Any) -> type[BaseModel] | None:
    """Return the section at a path; None where there is none."""
    for part in parents:
        if isinstance(part, int) or not isinstance(model, type):
            continue
        field = model.model_fields.get(part)
        model = _section_of(field.annotation) if field else model
    return model if isinstance(model, type) else None


def _section_of(annotation: Any) -> Any:
    """Return the section inside an annotation such as `dict[str, PartSection] | None`."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    for inner in getattr(annotation, "__args__", ()):
        section = _section_of(inner)
        if section is not None:
            return section
    return None
