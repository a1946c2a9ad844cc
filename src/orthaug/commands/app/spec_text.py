"""A spec as text that forms change, one key or table at a time, comments and order kept.

And the files where specs are kept.
"""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import platformdirs
import tomlkit
from tomlkit.exceptions import TOMLKitError
from tomlkit.items import AoT

from orthaug._base.errors import InputError
from orthaug.data.tables import check_readable

# Keys whose values are text, digits or not
_WORDS = ("parameter", "regressor", "output", "unit", "channel", "derivative", "next")
_KEPT = 20  # specs of earlier work
_MARK = 7  # letters behind the title in the name of one


def parse_document(text: str) -> tomlkit.TOMLDocument:
    """Return the document.

    Raises:
        InputError: broken TOML.
    """
    try:
        return tomlkit.parse(text)
    except (TOMLKitError, RecursionError) as error:
        raise InputError(f"broken TOML: {' '.join(str(error).split())}.") from None


def in_file(path: Path) -> str:
    """Return the text of a spec in a file.

    Raises:
        InputError: a file that cannot be read, or broken TOML.
    """
    check_readable(path)
    try:
        text = path.read_text(encoding="utf-8-sig")
        parse_document(text)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}).") from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: not a text file; expected TOML in UTF-8.") from None
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    return text


def keep(name: str, spec: str) -> None:
    """Write the spec of a session anew, whole or not at all; the oldest ones and their results go.

    It does nothing where the folder cannot be written.
    """
    place = results_folder(name).with_name(f"{name}.toml")
    with suppress(OSError):
        place.parent.mkdir(parents=True, exist_ok=True)
        partial = place.with_suffix(".partial")
        partial.write_text(spec, encoding="utf-8")
        os.replace(partial, place)
        for old in earlier()[_KEPT:]:
            shutil.rmtree(results_folder(old.stem), ignore_errors=True)
            old.unlink(missing_ok=True)


def kept_name(title: str, key: str) -> str:
    """Return the name under which a session keeps its spec and its results."""
    return f"{title}-{key[: _MARK - 1]}"


def results_folder(name: str) -> Path:
    """Return the folder of the results of a spec that is kept under a name."""
    return _folder() / name


def earlier() -> list[Path]:
    """Return the specs that are kept, the latest first."""
    with suppress(OSError):
        return sorted(
            _folder().glob("*.toml"), key=lambda place: place.stat().st_mtime, reverse=True
        )
    return []


def kept_title(place: Path) -> str:
    """Return the title under which a spec was kept."""
    return place.stem[:-_MARK]


def _folder() -> Path:
    return platformdirs.user_state_path("orthaug") / "app"


def absolute(text: str, folder: Path) -> str:
    """Return the spec with absolute paths for the files that it names relative to `folder`."""
    document = parse_document(text)
    for entry in _with_files(document):
        entry["files"] = [_absolute_path(folder, file) for file in entry["files"]]
    return tomlkit.dumps(document)


def _absolute_path(folder: Path, file: Any) -> Any:
    """Return a path as an absolute one, not resolved: links and patterns remain what they are."""
    return Path(os.path.abspath(folder / file)).as_posix() if isinstance(file, str) else file


def _with_files(document: Mapping[str, object]) -> Iterator[Any]:
    data = section(document, "data")
    parts = [data.get("train"), data.get("validation"), *section(data, "tests").values()]
    for entry in (*parts, section(document, "structure").get("measure")):
        if isinstance(entry, Mapping) and isinstance(entry.get("files"), list):
            yield entry


def files(content: Mapping[str, object]) -> list[str]:
    """Return every data file that a spec names, the training data first, each once."""
    return list(
        dict.fromkeys(file for entry in _with_files(content) for file in names(entry, "files"))
    )


def columns(content: Mapping[str, Any]) -> dict[str, str]:
    """Return the use, `input` or `output`, of each column of a file that holds a channel."""
    data = section(content, "data")
    kinds = {name: kind for kind in ("input", "output") for name in names(data, f"{kind}s")}
    return {
        str(section(data, "channels", name).get("column") or name): kind
        for name, kind in kinds.items()
    }


def section(content: Mapping[str, Any], *path: str) -> Mapping[str, Any]:
    """Return the table at the end of the path.

    Empty where there is no table.
    """
    for key in path:
        found = content.get(key)
        content = found if isinstance(found, Mapping) else {}
    return content


def names(table: Mapping[str, Any], key: str) -> list[str]:
    """Return the strings of a list, such as `outputs`; none where there is no such list."""
    found = table.get(key)
    return [name for name in found if isinstance(name, str)] if isinstance(found, list) else []


def field_text(value: object) -> str:
    """Return a value as a field shows it."""
    return (
        ""
        if value is None
        else ", ".join(map(str, value))
        if isinstance(value, list | tuple)
        else str(value)
    )


def read(key: str, value: str) -> Any:
    """Return the value of a field's text: a number, names, or text; None for nothing.

    Errors are left to the check of the spec.
    """
    value = value.strip()
    if not value:
        return None
    if key in ("channels", "inputs"):
        return [name.strip() for name in value.split(",") if name.strip()] or None
    for kind in (int, float) if key not in _WORDS else ():
        try:
            return kind(value)
        except ValueError:
            continue
    return value


def _make_table(document: Any, path: Sequence[str]) -> Any:
    """Return the table at the end of the path; it is made where there is none."""
    for key in path:
        if not isinstance(document.get(key), Mapping):
            document[key] = tomlkit.table()
        document = document[key]
    return document


def plain(text: str) -> dict[str, object]:
    """Return the content in plain dictionaries and lists.

    Raises:
        InputError: broken TOML.
    """
    return parse_document(text).unwrap()


def edit_text(text: str, change: Callable[[Any], None]) -> str:
    """Return the text after a change of its document.

    Raises:
        InputError: broken TOML, or TOML in which the change cannot be written.
    """
    document = parse_document(text)
    change(document)
    written = tomlkit.dumps(document)
    if plain(written) != document.unwrap():
        raise InputError(
            "a form cannot write this change into the spec in its present layout; make it in "
            "the text."
        )
    return written


def with_value(text: str, path: Sequence[str], value: object) -> str:
    """Return the text with a key of a table set, or removed where the value is None.

    Missing tables on the path are added.
    """

    def change(document: object) -> None:
        table = _make_table(document, path[:-1])
        if value is None:
            table.pop(path[-1], None)
        elif isinstance(
            value, Mapping
        ):  # inline: beside dotted keys a separate table would be written elsewhere
            table[path[-1]] = tomlkit.inline_table()
            table[path[-1]].update(value)
        else:
            table[path[-1]] = value

    return edit_text(text, change)


def with_name(text: str, path: Sequence[str], new: str) -> str:
    """Return the text with another name for a state or a parameter of a motion, in its expressions.

    Raises:
        InputError: a name that is taken, or is none.
    """
    *above, old = path
    known = section(plain(text), *above)
    if new == old:
        return text
    if not re.fullmatch(r"[A-Za-z]\w*", new, re.ASCII) or new in known:
        raise InputError(f"'{new}' is taken, or no name: letters, digits and underscores.")

    def renamed(value: object) -> Any:
        own = rf"\b{re.escape(old)}\b"
        return re.sub(own, new, value) if isinstance(value, str) else value

    def change(document: Any) -> None:
        table = _table_at(document, above)
        for name, row in [(name, table.pop(name)) for name in list(table)]:
            table[new if name == old else name] = row
        motion = document["motion"]
        for row in motion.get("states", {}).values():
            row |= {key: renamed(row[key]) for key in ("derivative", "next") if key in row}
        for part in ("outputs", "define"):
            for name, value in section(motion, part).items():
                motion[part][name] = renamed(value)
        seen = section(document, "learner").get("inputs")
        if isinstance(seen, list):
            document["learner"]["inputs"] = [renamed(value) for value in seen]

    return edit_text(text, change)


def rows_of(text: str, path: Sequence[str]) -> list[dict[str, object]]:
    """Return the tables of a list of tables, such as `data.prepare`.

    Empty where there is no such list.
    """
    found = section(plain(text), *path[:-1]).get(path[-1])
    return (
        [dict(row) for row in found if isinstance(row, Mapping)] if isinstance(found, list) else []
    )


def with_row(text: str, path: Sequence[str], row: Mapping[str, object]) -> str:
    """Return the text with one more table at the end of a list of tables."""

    def change(document: object) -> None:
        table = _make_table(document, path[:-1])
        rows = table.get(path[-1])
        if not isinstance(rows, list) or (not rows and not isinstance(rows, AoT)):
            table[path[-1]] = tomlkit.aot()
            rows = table[path[-1]]
        new = tomlkit.table() if isinstance(rows, AoT) else tomlkit.inline_table()
        new.update(row)
        if isinstance(rows, AoT):
            new.add(tomlkit.nl())  # before what follows
        rows.append(new)

    return edit_text(text, change)


def with_field(text: str, path: Sequence[str], index: int, key: str, entered: str) -> str:
    """Return the text with a key of one table of a list set; an empty field removes it."""

    def change(document: object) -> None:
        row, value = _table_at(document, path)[index], read(key, entered)
        if value is None:
            row.pop(key, None)
        else:
            row[key] = value

    return edit_text(text, change)


def without_row(text: str, path: Sequence[str], index: int) -> str:
    """Return the text without one table of a list."""

    def change(document: object) -> None:
        rows = _table_at(document, path)
        del rows[index]
        if not rows:
            del _table_at(document, path[:-1])[path[-1]]

    return edit_text(text, change)


def _table_at(document: Any, path: Sequence[str]) -> Any:
    for key in path:
        document = document[key]
    return document


_OF_TERMS = (
    "linear difference equations",
    "sees the lags that the physics reads",
    'focus = "simulation"',
)
"""Phrases of comments by `orthaug init` that do not hold for equations of motion."""
TERM = """
[[baseline.terms]]
parameter = "{parameter}"
regressor = "{regressor}"
output = "{output}"
"""
MOTION = """
[motion]
[motion.states]
x = {{ derivative = "v", start = "{output}"{x} }}
v = {{ derivative = "({force} - c*v - k*x)/m", start = "derivative of {output}", \
learned = true{v} }}
[motion.outputs]
{output} = "x"
[motion.parameters]
m = {{ initial = 1.0{m}, min = 0 }}
c = {{ initial = 1.0{c}, min = 0 }}
k = {{ initial = 1.0{k}, min = 0 }}
"""


Shelf = dict[str, dict[tuple[str, ...], Any]]
"""By kind of physics, what a spec had under each path before another kind took its place."""
_OF_PHYSICS = (
    *(("baseline",), ("lags",), ("physics",), ("suspects",), ("motion",), ("learner", "inputs")),
    *(("learner", "terms"), ("training", "focus")),
)
"""What of a spec belongs to one kind of physics alone."""


def kind_of_physics(content: Mapping[str, object]) -> str:
    """Return the kind of physics of a spec: `terms`, `motion` or `source`."""
    if section(content, "physics", "source"):
        return "source"
    return "motion" if "motion" in content else "terms"


def with_physics(text: str, kind: str, shelf: Shelf) -> str:
    """Return the spec with `terms` or equations of `motion` as its physics.

    What it has of the present kind is put on the shelf; what lies there of the other is taken.
    Without it the equations are those of a mass, spring and damper, which the user is to change,
    with units where force and output have them.
    """
    present = kind_of_physics(plain(text))
    if kind == present:
        return text
    taken: dict[tuple[str, ...], object] = {}
    known = shelf.get(kind) or _first_physics(text, kind)

    def change(document: Any) -> None:
        for *above, key in _OF_PHYSICS:
            table = section(document, *above) if above else document
            if key in table:
                taken[(*above, key)] = table.pop(key)  # pyright: ignore[reportAttributeAccessIssue]
        for path, value in known.items():
            _make_table(document, path[:-1])[path[-1]] = value

    made = edit_text(_without_comments(text, _OF_TERMS), change)
    shelf[present] = taken
    return made


def _first_physics(text: str, kind: str) -> dict[tuple[str, ...], object]:
    data = section(plain(text), "data")
    inputs, outputs = names(data, "inputs") or ["0"], names(data, "outputs") or ["y"]
    if kind == "terms":
        rows = [
            TERM.format(parameter=f"p{i}", regressor=regressor, output=output)
            for i, (output, regressor) in enumerate(
                ((output, f"{name}[k-1]") for output in outputs for name in (output, inputs[0])), 1
            )
        ]
        return {("baseline",): tomlkit.parse("".join(rows))["baseline"]}
    force, output = (
        section(data, "channels", name).get("unit") for name in (inputs[0], outputs[0])
    )
    units = (
        _motion_units(force, output) if isinstance(force, str) and isinstance(output, str) else {}
    )
    given = {name: f', unit = "{units[name]}"' if name in units else "" for name in "xvmck"}
    written = MOTION.format(output=outputs[0], force=inputs[0], **given)
    return {("motion",): tomlkit.parse(written)["motion"], ("learner", "inputs"): ["v"]}


def _without_comments(text: str, phrases: Sequence[str]) -> str:
    """Return the text without the comments that contain one of these phrases.

    A line without other content is removed too.
    """
    kept = []
    for line in text.splitlines(keepends=True):
        before, mark, comment = line.partition("# ")
        if mark and any(one in comment for one in phrases):
            if not before.strip():
                continue
            line = before.rstrip() + "\n"
        kept.append(line)
    return "".join(kept)


def _motion_units(force: str, output: str) -> dict[str, str]:
    """Return the units of states and parameters in `force = m dv/dt + c v + k x`.

    `x` has the unit of the output.
    """
    if not force or not output or set('"\\') & {*force, *output}:
        return {}
    own = f"({output})" if set(" */") & set(output) else output
    mass = "kg" if (force, output) == ("N", "m") else f"{force} s²/{own}"
    return {"x": output, "v": f"{own}/s", "m": mass, "c": f"{force} s/{own}", "k": f"{force}/{own}"}
