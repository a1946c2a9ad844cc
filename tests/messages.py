"""Every text that the program can print, collected from its source into docs/messages.md.

`python tests/messages.py` writes the page anew; `tests/test_messages.py` compares it with the source.
A text counts as an error where it reaches a `raise`, as a warning where it reaches a `Warning` with a
code, and as a part of reports and the terminal otherwise.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from itertools import chain
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SOURCE = ROOT / "src" / "orthaug"
PAGE = ROOT / "docs" / "messages.md"
FEWEST_WORDS = 4  # below that a text is a label, a heading or a key
MOST_WORDS = 30  # of a sentence that a user reads
SKIPPED = ("export", "studies")  # code for other programs; captions of the paper's figures
ERRORS, HELP, REST = "errors", "help", "reports"  # the groups beside the codes of warnings
ROOMS = {
    "_base": "Arguments, folders, memory",
    "data": "Records, files, expressions",
    "physics": "Physics and its parameters",
    "models": "Models and learners",
    "inference": "Measures, splits, intervals",
    "fitting": "Fitting",
    "analysis": "Analysis of a fit",
    "selection": "Choice of a structure",
    "reports": "Reports and figures",
    "commands": "Commands and the app",
}
HEAD = """# Messages

Every text of four words or more that the program can print. A name in braces stands for a value, and
braces with a slash for one of two words: `{channel}`, `{is/are}`. Long messages consist of several of these texts.

To find a message, search for a few words of it without figures or names. The text states the cause and then the
remedy; [What goes wrong](guide/trouble.md) has more on each warning.

`python tests/messages.py` writes this page from the source, and a test compares both.
"""
Text = tuple[str, str]  # the group of a text, and the text


@cache
def nodes_of(node: ast.AST) -> tuple[ast.AST, ...]:
    """Return a node and all below it, looked for once: `ast.walk` would take most of the time."""
    return (node, *chain.from_iterable(map(nodes_of, ast.iter_child_nodes(node))))


def dotted(node: ast.AST) -> str:
    """Return a name with its dots, "" of anything else: `ast.unparse` takes a hundred times as long."""
    if isinstance(node, ast.Attribute):
        return f"{dotted(node.value)}.{node.attr}"
    return node.id if isinstance(node, ast.Name) else ""


def placeholder(node: ast.AST) -> str:
    """Return a readable name of the value that an f-string inserts, … where it has none."""
    match node:
        case ast.Name(id=name) | ast.Attribute(attr=name):
            return name.strip("_") or "…"
        case ast.Constant(value=str() as text):
            return text if len(text.split()) < FEWEST_WORDS else "…"
        case ast.IfExp(body=first, orelse=second):
            return "/".join(placeholder(one).replace("/", "…") for one in (first, second))
        case ast.Call(func=ast.Name(id="len")):
            return "number"
        case ast.Call(args=[first, *_]) | ast.Call(func=ast.Attribute(value=first)):
            return placeholder(first)
        case ast.Call(func=first) | ast.Starred(value=first):
            return placeholder(first)
        case ast.Subscript(slice=ast.Constant(value=str() as key)):
            return key
        case ast.Subscript(value=first) | ast.UnaryOp(operand=first) | ast.NamedExpr(target=first):
            return placeholder(first)
        case (
            ast.GeneratorExp(elt=first) | ast.ListComp(elt=first) | ast.FormattedValue(value=first)
        ):
            return placeholder(first)
        case ast.BinOp(left=first, right=second):
            return next((p for p in map(placeholder, (first, second)) if p != "…"), "…")
        case _:
            return "…"


def text_of(node: ast.AST) -> str | None:
    """Return the text of a string or f-string with `{name}` for values; None of another node."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        text = node.value
    elif isinstance(node, ast.JoinedStr):
        text = "".join(
            str(part.value) if isinstance(part, ast.Constant) else f"{{{placeholder(part)}}}"
            for part in node.values
        )
    else:
        return None
    return " ".join(text.split())


def is_message(text: str) -> bool:
    """Return whether a user reads a text: some words in a row, no code and no markup."""
    shape = r"[`'\"(]?[A-Za-z{][\w{}/…'’.-]*[`'\"),.;:?!]*"
    words = [word for word in flat(text).split() if re.fullmatch(shape, word)]
    code = re.search(r"[<>]\w+|;\s*$|\bdef \w+\(|import |default-src", text)
    return len(words) >= FEWEST_WORDS and len(words) > len(text.split()) / 2 and not code


def flat(text: str) -> str:
    """Return a text whose placeholders are one word each."""
    return re.sub(r"\{[^{}]*\}", "{…}", text)


def sentences_of(text: str) -> list[str]:
    """Return the sentences of a message: a full stop, question or exclamation mark ends one."""
    return [part for part in re.split(r"(?<=[.?!])\s+(?=[A-Zθ`{\[a-z])", flat(text)) if part]


def _help_of(tree: ast.AST) -> Iterator[ast.expr]:
    """Yield what `--help` prints: `help=` of options, and the docstrings of commands."""
    for node in nodes_of(tree):
        if isinstance(node, ast.keyword) and node.arg == "help":
            yield node.value
        elif isinstance(node, ast.FunctionDef):
            first = node.body[0]
            if isinstance(first, ast.Expr) and any(
                dotted(getattr(one, "func", one)).startswith("app.") for one in node.decorator_list
            ):
                yield first.value


def _unread(tree: ast.AST) -> set[int]:
    """Return the nodes whose texts nobody reads: docstrings, annotations, keys, parts of others."""
    found: set[int] = set()
    helped = {id(one) for part in _help_of(tree) for one in nodes_of(part)}
    for node in nodes_of(tree):
        inner: list[ast.AST | None] = []
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            inner = [node.value]
        elif isinstance(node, ast.JoinedStr):
            found.update(id(part) for part in node.values if isinstance(part, ast.Constant))
            specs = [part for part in node.values if isinstance(part, ast.FormattedValue)]
            inner = [part.format_spec for part in specs]
        elif isinstance(node, ast.arg | ast.AnnAssign):
            inner = [node.annotation]
        elif isinstance(node, ast.FunctionDef):
            inner = [node.returns]
        elif isinstance(node, ast.Call) and dotted(node.func) in (
            "Float",
            "Bool",
            "Int",
            "re.compile",
        ):
            inner = [node]
        elif isinstance(node, ast.Subscript):
            inner = [node.slice]
        found.update(id(part) for one in inner if one is not None for part in nodes_of(one))
    return found - helped


@cache
def assigned(scope: ast.AST) -> dict[str, list[ast.expr]]:
    """Return what is assigned to each name in a function, or on the top level of a module."""
    found: dict[str, list[ast.expr]] = {}
    for node in scope.body if isinstance(scope, ast.Module) else nodes_of(scope):
        if isinstance(node, ast.Assign | ast.AugAssign | ast.AnnAssign | ast.NamedExpr):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names = {target.id for target in targets if isinstance(target, ast.Name)}
            if node.value is not None:
                for name in names:
                    found.setdefault(name, []).append(node.value)
    return found


class _Groups:
    """Groups of the texts of a module: what reaches a `raise` or a `Warning`, by way of names, too."""

    def __init__(self, tree: ast.Module) -> None:
        self.of: dict[int, str] = {}
        self._functions = {n.name: n for n in nodes_of(tree) if isinstance(n, ast.FunctionDef)}
        self._module = tree
        self._scope: dict[int, ast.AST] = {}
        for function in self._functions.values():  # an inner function comes after its outer one
            self._scope |= {id(node): function for node in nodes_of(function)}
        self._since: dict[tuple[int, str], int] = {}  # the line of a name's last use, by its scope
        self.of |= {id(part): HELP for one in _help_of(tree) for part in nodes_of(one)}
        raised = [n for n in nodes_of(tree) if isinstance(n, ast.Raise) and n.exc is not None]
        calls = [n for n in nodes_of(tree) if isinstance(n, ast.Call)]
        for call in sorted(calls, key=lambda one: one.lineno):
            if dotted(call.func) == "Warning":
                given = [*call.args, *(keyword.value for keyword in call.keywords)]
                code = self._code(given[0])
                for one in given[1:]:
                    self._reach(one, code, self._scope.get(id(call), tree), {}, call)
        built = [call for call in calls if dotted(call.func).endswith("Error")]
        for node in [*(one.exc for one in raised), *built]:  # what is built here a caller raises
            self._reach(node, ERRORS, self._scope.get(id(node), tree), {})

    def _code(self, node: ast.expr) -> str:
        if isinstance(node, ast.Name):
            node = next(iter(self._values(node.id, self._module)), node)
        return node.value if isinstance(node, ast.Constant) else REST

    def _values(self, name: str, scope: ast.AST) -> list[ast.expr]:
        """Return what is assigned to a name in a function, or in the module where there is nothing."""
        found = assigned(scope).get(name, [])
        if not found and not isinstance(scope, ast.Module):
            return self._values(name, self._module)
        return found

    def _reach(
        self,
        node: ast.AST | None,
        group: str,
        scope: ast.AST,
        seen: dict[str, bool],
        use: ast.Call | None = None,
    ) -> None:
        called = (
            {part.func for part in nodes_of(node) if isinstance(part, ast.Call)} if node else set()
        )
        for part in nodes_of(node) if node is not None else ():
            if isinstance(part, ast.Constant | ast.JoinedStr):
                self.of.setdefault(id(part), group)
            elif isinstance(part, ast.Name) and part.id not in seen:
                seen[part.id] = True
                values = self._values(part.id, scope)
                if use is not None and not isinstance(scope, ast.Module):  # one name, several texts
                    since = self._since.get((id(scope), part.id), 0)
                    here = [v for v in values if since < v.lineno <= (use.end_lineno or use.lineno)]
                    values = here or values
                    self._since[id(scope), part.id] = use.end_lineno or use.lineno
                for value in values:
                    self._reach(value, group, scope, seen, use)
                function = self._functions.get(part.id)
                if function is not None and part in called:
                    self._reach(function, group, function, seen)


def texts_of(tree: ast.Module) -> Iterator[Text]:
    """Yield the texts of a module that users read, in order, each with its group."""
    unread, groups = _unread(tree), _Groups(tree).of
    found = [
        node
        for node in nodes_of(tree)
        if isinstance(node, ast.Constant | ast.JoinedStr) and id(node) not in unread
    ]
    for node in sorted(found, key=lambda one: (one.lineno, one.col_offset)):
        text = text_of(node)
        if text is not None and is_message(text):
            yield groups.get(id(node), REST), text


@cache
def messages() -> dict[str, list[Text]]:
    """Return the texts of every file, by its path below src/orthaug; files without any are left out."""
    found = {}
    for path in sorted(SOURCE.rglob("*.py")):
        name = path.relative_to(SOURCE).as_posix()
        if not name.startswith(SKIPPED):
            texts = list(dict.fromkeys(texts_of(ast.parse(path.read_text(encoding="utf-8")))))
            found |= {name: texts} if texts else {}
            nodes_of.cache_clear()
            assigned.cache_clear()
    return found


def page() -> str:
    """Return the page of all messages: errors by room, warnings by code, other texts by room."""
    by_heading: dict[str, dict[str, list[str]]] = {
        top: {} for top in ("Errors", "Warnings", "Other", "Help")
    }
    for name, texts in messages().items():
        room = ROOMS.get(name.split("/")[0], ROOMS["commands"])
        for group, text in texts:
            place = {ERRORS: ("Errors", room), REST: ("Other", room), HELP: ("Help", HELP)}
            top, heading = place.get(group, ("Warnings", f"`{group}`"))
            by_heading[top].setdefault(heading, []).append(text)
    parts = [HEAD]
    for top, title, says in (
        (
            "Errors",
            "Errors",
            "The command line writes `error:` before them and ends with exit code 2 or 1; Python raises them as exceptions.",
        ),
        (
            "Warnings",
            "Warnings, by code",
            "They are in `warnings` of the result, in the report and on the terminal.",
        ),
        (
            "Other",
            "Reports, terminal and app",
            "Sentences and parts of sentences, in the order of the source.",
        ),
        (
            "Help",
            "Help of the command line",
            "`orthaug --help` and `orthaug COMMAND --help` print them.",
        ),
    ):
        parts += [f"\n## {title}\n", says]
        headings = by_heading[top]
        order = sorted(headings) if top == "Warnings" else [*ROOMS.values(), HELP]
        for heading in filter(headings.__contains__, order):
            parts += [f"\n### {heading}\n"] if heading != HELP else [""]
            parts += ["```text", *dict.fromkeys(headings[heading]), "```"]
    return "\n".join(parts) + "\n"


def long_sentences() -> list[str]:
    """Return every sentence that has too many words, with its file."""
    return [
        f"{name}: {sentence}"
        for name, texts in messages().items()
        for _, text in texts
        for sentence in sentences_of(text)
        if len(sentence.split()) > MOST_WORDS
    ]


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
