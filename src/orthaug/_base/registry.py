"""Registries of learners, structures, measures, criteria and solvers by name.

Each kind is a declaration.

A declaration is a frozen dataclass. Its fields are the keys of its section in a spec: name, type,
limits (`Annotated[int, Ge(1)]`) and default. A declaration of something else, such as
files that hold points, has a method `resolve(context)` that makes the real thing.
"""

from __future__ import annotations

import dataclasses
import functools
import typing
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
from annotated_types import Ge, Gt, Le

from orthaug._base.checks import check_choice, check_count, check_number, check_type, nearest
from orthaug._base.errors import InputError, KeyedError
from orthaug._base.plugins import discover

LIBRARY_ONLY = {"library_only": True}
"""Metadata of a dataclass field that is no key of the spec: `field(default=…,
metadata=LIBRARY_ONLY)`.
"""


@dataclass(frozen=True)
class OneOf:
    """In `Annotated`: one of these texts."""

    choices: Collection[str]


@dataclass(frozen=True)
class SpecLimit:
    """In `Annotated`: a limit that holds in a spec only."""

    limit: Any


@dataclass(frozen=True)
class Option:
    """In `Annotated`: the option of `orthaug split` that gives this key."""

    name: str


@dataclass(frozen=True)
class Key:
    """One key of a section, as a declaration's field has it."""

    name: str
    annotation: Any
    default: Any

    @property
    def type(self) -> Any:
        """The type without its limits."""
        return typing.get_args(self.annotation)[0] if self.metadata else self.annotation

    @property
    def meaning(self) -> tuple[Any, ...]:
        """Type and limits, which must agree wherever a section has the key."""
        return self.type, *(mark for mark in self.metadata if not isinstance(mark, Option))

    @property
    def metadata(self) -> tuple[Any, ...]:
        """Limits and marks next to the type in `Annotated`."""
        return getattr(self.annotation, "__metadata__", ())

    @property
    def option(self) -> str | None:
        """The command-line option that gives it."""
        return next((mark.name for mark in self.metadata if isinstance(mark, Option)), None)


class Registry(Mapping[str, Any]):
    """The declarations of one axis by the name of their kind, in the order of their addition.

    Args:
        axis: what the kinds are kinds of, for messages.
        entries: the first declarations.
        reserved: keys that the section has beside those of the declarations.
        beside: another registry whose keys are in the same section.
        group: entry points by which other packages add kinds (`_base/plugins.py`); "" for none.
        follows: what every declaration must be a subclass of; None for any.
    """

    def __init__(
        self,
        axis: str,
        entries: Mapping[str, type],
        *,
        reserved: Collection[str] = ("kind",),
        beside: Registry | None = None,
        group: str = "",
        follows: type | None = None,
    ) -> None:
        self.axis = axis
        self._group, self._follows = group, follows
        self._reserved = frozenset(reserved)
        self._entries: dict[str, type] = {}
        self._section = [self]
        if beside is not None:
            self._section = beside._section
            self._section.append(self)
        for kind, declaration in entries.items():
            self.add(kind, declaration)

    def __getitem__(self, kind: str) -> Any:
        return self._entries[kind]

    def __iter__(self) -> Iterator[str]:
        return iter(self._entries)

    def __len__(self) -> int:
        return len(self._entries)

    def add(self, kind: str, declaration: type) -> None:
        """Register a declaration.

        Raises:
            InputError: a name that is taken, no frozen dataclass, or a key that means something
                else already.
        """
        if kind in self._entries:
            raise InputError(
                f"the {self.axis} '{kind}' is registered already; give it another name."
            )
        parameters = getattr(declaration, "__dataclass_params__", None)
        if parameters is None or not parameters.frozen:
            raise InputError(
                f"the {self.axis} '{kind}' must be a frozen dataclass; got {declaration!r}."
            )
        if self._follows is not None and not issubclass(declaration, self._follows):
            raise InputError(f"the {self.axis} '{kind}' is no {self._follows.__name__}.")
        for key in keys_of(declaration).values():
            if key.name in self._reserved:
                raise InputError(
                    f"the {self.axis} '{kind}' has a key '{key.name}', which its section has "
                    "already."
                )
            for registry in self._section:
                for other, known in registry._entries.items():
                    same = keys_of(known).get(key.name)
                    if same is not None and same.meaning != key.meaning:
                        raise InputError(
                            f"the {self.axis} '{kind}' and the {registry.axis} '{other}' "
                            f"declare the key '{key.name}' differently: {key.annotation} and "
                            f"{same.annotation}; give one of them another name."
                        )
        self._entries[kind] = declaration

    def discover(self) -> Registry:
        """Add the kinds of installed packages, and return the registry itself.

        Raises:
            InputError: a package that cannot be imported, or whose kind cannot be added.
        """
        if self._group:
            discover(self._group, self.axis, self._entries, self.add)
        return self

    def remove(self, kind: str) -> None:
        """Take a declaration out again."""
        del self._entries[kind]

    @contextmanager
    def with_kind(self, kind: str, declaration: type) -> Iterator[None]:
        """Register a declaration inside a `with` block only."""
        self.add(kind, declaration)
        try:
            yield
        finally:
            self.remove(kind)

    def section_keys(self) -> dict[str, Key]:
        """Return the keys of all kinds."""
        keys: dict[str, Key] = {}
        for declaration in self._entries.values():
            keys = keys_of(declaration) | keys
        return keys

    def kind_of(self, declared: object) -> str | None:
        """Return the name under which a declaration's class is registered.

        None for a foreign one.
        """
        return next(
            (kind for kind, declaration in self._entries.items() if type(declared) is declaration),
            None,
        )

    def kind_with(self, option: str) -> tuple[str, Key] | None:
        """Return the kind that a command-line option belongs to, with the key that it gives."""
        for kind, declaration in self._entries.items():
            for key in keys_of(declaration).values():
                if key.option == option:
                    return kind, key
        return None

    def declare(self, kind: str, values: Mapping[str, object]) -> Any:
        """Return the declaration of a kind; `values` of keys that it does not have are left out.

        Raises:
            InputError: an unknown kind, a missing key, or what the declaration refuses.
        """
        if kind not in self._entries:
            hint = nearest(kind, self) or f"; known are {', '.join(self)}."
            raise InputError(f"unknown {self.axis} '{kind}'{hint}")
        known = keys_of(self._entries[kind])
        for name, key in known.items():
            if key.default is dataclasses.MISSING and name not in values:
                raise KeyedError(
                    f"the {self.axis} '{kind}' needs `{name}`.",
                    name,
                    f" is missing; {kind} needs it",
                )
        return self._entries[kind](
            **{name: freeze(value) for name, value in values.items() if name in known}
        )


@functools.cache
def keys_of(declaration: type) -> dict[str, Key]:
    """Return the keys that a declaration's fields are."""
    hints = typing.get_type_hints(declaration, include_extras=True)
    return {
        field.name: Key(field.name, hints[field.name], _default(field))
        for field in dataclasses.fields(declaration)
        if field.init and not field.metadata.get("library_only")
    }


def resolve(declared: Any, context: object = None) -> Any:
    """Return a declaration itself, or the result of its `resolve(context)`."""
    return declared.resolve(context) if hasattr(declared, "resolve") else declared


def check_fields(declared: object) -> None:
    """Raise InputError for a field outside the limits of its type.

    It is called in the `__post_init__` of declarations.
    """
    for name, key in keys_of(type(declared)).items():
        value, metadata = getattr(declared, name), key.metadata
        low = next((mark.ge for mark in metadata if isinstance(mark, Ge)), None)
        positive = any(isinstance(mark, Gt) for mark in metadata)
        choices = next((mark.choices for mark in metadata if isinstance(mark, OneOf)), None)
        if choices is not None:
            check_choice(value, choices, f"`{name}`")
        elif key.type is int and low is not None:
            check_count(value, name, least=int(typing.cast(Any, low)))
        elif key.type is float and (low is not None or positive):
            check_number(value, name, positive=positive)
        elif key.type is bool:
            check_type(value, bool, name, "true or false")
        high = next((mark.le for mark in metadata if isinstance(mark, Le)), None)
        if high is not None and value > high:
            raise InputError(f"`{name}` must be {high} or less; got {value}.")


def _default(field: dataclasses.Field[object]) -> Any:
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return field.default


def freeze(value: object) -> Any:
    """Return lists, as files hold them, as tuples."""
    if isinstance(value, list | tuple):
        return tuple(freeze(item) for item in value)
    if isinstance(value, Mapping):
        return {name: freeze(item) for name, item in value.items()}
    return value.item() if isinstance(value, np.generic) else value
