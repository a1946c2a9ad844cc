"""Nothing of one operating system alone: names that others lack stand behind a question, and text is UTF-8."""

from __future__ import annotations

import ast
from collections.abc import Iterator

import pytest
from sources import parsed
from test_architecture import FILES, in_files

ONLY_POSIX = {
    **dict.fromkeys(("fcntl", "grp", "pwd", "pty", "termios", "tty", "syslog", "resource"), ()),
    "os": (
        "fork",
        "forkpty",
        "killpg",
        "setsid",
        "getuid",
        "geteuid",
        "mkfifo",
        "getpgid",
        "wait3",
        "uname",
        "nice",
    ),
    "signal": (
        "SIGKILL",
        "SIGPIPE",
        "SIGHUP",
        "SIGUSR1",
        "SIGUSR2",
        "SIGALRM",
        "alarm",
        "setitimer",
        "pause",
    ),
}
# In a `try`, and done without
ASKED_FIRST = dict.fromkeys(("_base.memory", "commands.app.worker"), {"resource"})
TEXT = {"read_text": 0, "write_text": 1}  # and how many arguments stand before the encoding


def foreign(tree: ast.AST) -> Iterator[str]:
    """Modules and names that POSIX alone has."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if ONLY_POSIX.get(alias.name) == ())
        elif isinstance(node, ast.ImportFrom) and node.module in ONLY_POSIX:
            names = [alias.name for alias in node.names]
            yield from (
                name
                for name in names
                if not ONLY_POSIX[node.module] or name in ONLY_POSIX[node.module]
            )
        elif isinstance(node, ast.Attribute) and node.attr in ONLY_POSIX.get(
            name_of(node.value), ()
        ):
            yield f"{name_of(node.value)}.{node.attr}"


def name_of(node: ast.AST) -> str:
    return node.id if isinstance(node, ast.Name) else ""


def without_encoding(tree: ast.AST) -> Iterator[str]:
    """Calls that read or write text in whatever encoding the machine has."""
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call):
            continue
        verb = (
            node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
        )
        said = any(keyword.arg == "encoding" for keyword in node.keywords)
        if verb in TEXT and not said and len(node.args) <= TEXT[verb]:
            if not any(keyword.arg is None for keyword in node.keywords):
                yield f"line {node.lineno}: {verb}"
        elif verb == "open" and not said and is_text(node):
            yield f"line {node.lineno}: open"


def is_text(node: ast.Call) -> bool:
    """Whether a call of `open` opens text; `os.open`, and members of archives, open bytes."""
    if isinstance(node.func, ast.Attribute) and name_of(node.func.value) in ("os", "archive"):
        return False
    place = 1 if isinstance(node.func, ast.Name) else 0
    modes = [
        *node.args[place : place + 1],
        *(keyword.value for keyword in node.keywords if keyword.arg == "mode"),
    ]
    return not any(isinstance(mode, ast.Constant) and "b" in str(mode.value) for mode in modes)


def test_every_system_has_what_is_used():
    assert (
        in_files(
            lambda name: sorted(set(foreign(parsed(FILES[name]))) - ASKED_FIRST.get(name, set()))
        )
        == {}
    )
    assert in_files(lambda name: list(without_encoding(parsed(FILES[name])))) == {}


@pytest.mark.parametrize(
    "code",
    ["import fcntl", "from os import fork", "os.killpg(1, 2)", "signal.signal(signal.SIGPIPE, f)"],
)
def test_what_one_system_has_is_seen(code):
    assert len(list(foreign(ast.parse(code)))) == 1


@pytest.mark.parametrize(
    ("code", "count"),
    [
        ("path.read_text()", 1),
        ("path.write_text(t)", 1),
        ("open('a', 'w')", 1),
        ("path.open()", 1),
        ("path.read_text('utf-8')", 0),
        ("path.write_text(t, encoding='utf-8')", 0),
        ("open('a', 'rb')", 0),
        ("path.open('wb')", 0),
        ("os.open(os.devnull, os.O_WRONLY)", 0),
    ],
)
def test_text_without_an_encoding_is_seen(code, count):
    assert len(list(without_encoding(ast.parse(code)))) == count
