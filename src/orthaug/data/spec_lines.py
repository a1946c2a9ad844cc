"""Lines of a spec that a change of it adds or replaces, to be copied."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any


def toml_value(value: object) -> str:
    """Return a value as it is written behind a key of a TOML file, a number with six digits.

    Examples:
        >>> print(toml_value({"derivative": "v", "learned": True}))
        { derivative = "v", learned = true }
    """
    if isinstance(value, Mapping):
        rows = (f"{toml_key(k)} = {toml_value(v)}" for k, v in value.items() if v is not None)
        return f"{{ {', '.join(rows)} }}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(toml_value, value))}]"
    if isinstance(value, float):
        return repr(float(f"{value:.6g}"))
    return json.dumps(value, ensure_ascii=False) if isinstance(value, str | bool) else repr(value)


def toml_key(key: str) -> str:
    """Return a key, in quotes where it is no bare one."""
    bare = key.isascii() and key.replace("-", "").replace("_", "").isalnum()
    return key if bare else json.dumps(key, ensure_ascii=False)


def changed_lines(spec: Mapping[str, Any], change: Mapping[str, Any]) -> list[str]:
    r"""Return the lines by which a spec takes a change; an entry that is changed is written whole.

    Args:
        spec: as it was read.
        change: new values by their keys, dots between the parts of a key.

    Examples:
        >>> spec = {"motion": {"states": {"v": {"derivative": "u", "start": 0}}}}
        >>> change = {"motion.states.v.derivative": "u - c*v"}
        >>> print("\n".join(changed_lines(spec, change)))
        [motion.states]
        v = { derivative = "u - c*v", start = 0 }
    """
    blocks: dict[str, dict[str, Any]] = {}
    lists = []
    for key, value in change.items():
        path = key.split(".")
        table, name, deeper = _place(path, value)
        if _is_list_of_tables(value):
            lists += _new_tables(key, value, _entry(spec, path))
        elif name is None:
            blocks.setdefault(table, {}).update(value)
        else:
            entries = blocks.setdefault(table, {})
            if deeper:
                known = entries.get(name, _entry(spec, path[: -len(deeper)]))
                value = _changed_entry(known if isinstance(known, Mapping) else {}, deeper, value)
            entries[name] = value
    tables = [
        [f"[{table}]", *(f"{toml_key(k)} = {toml_value(v)}" for k, v in rows.items())]
        for table, rows in blocks.items()
    ]
    lines = [line for block in (*lists, *tables) for line in ("", *block)]
    return lines[1:]


def _place(path: list[str], value: object) -> tuple[str, str | None, list[str]]:
    """Return the table of a key, its entry there, None for all of them, and its path in that."""
    if len(path) == 1 and isinstance(value, Mapping):
        return path[0], None, []
    depth = min(len(path) - 1, 2)
    return ".".join(map(toml_key, path[:depth])), path[depth], path[depth + 1 :]


def _is_list_of_tables(value: object) -> bool:
    return isinstance(value, list) and bool(value) and all(isinstance(v, Mapping) for v in value)


def _new_tables(key: str, value: list[Any], declared: object) -> list[list[str]]:
    """Return the tables that a list does not have; all of them where it has others."""
    known = declared if isinstance(declared, list) else []
    kept = all(entry in value for entry in known)
    return [
        [f"[[{key}]]", *(f"{toml_key(k)} = {toml_value(v)}" for k, v in entry.items())]
        for entry in value
        if not (kept and entry in known)
    ]


def _entry(spec: Mapping[str, Any], path: list[str]) -> Any:
    found: Any = spec
    for part in path:
        found = found.get(part) if isinstance(found, Mapping) else None
    return found


def _changed_entry(entry: Mapping[str, Any], path: list[str], value: object) -> dict[str, Any]:
    first, *rest = path
    inner = entry.get(first)
    known = inner if isinstance(inner, Mapping) else {}
    return dict(entry) | {first: _changed_entry(known, rest, value) if rest else value}
