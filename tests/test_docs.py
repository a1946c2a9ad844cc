"""What the documents name is there: files, names in them, rooms; and what they tell a contributor to write works."""

from __future__ import annotations

import ast
import importlib
import re
from pathlib import Path

import pytest
from test_architecture import ROOMS
from test_cli import make_project

import orthaug
from orthaug.commands.cli import app
from orthaug.commands.spec import load_spec
from orthaug.models.kinds import LEARNERS
from orthaug.models.learners import Bound

ROOT = Path(__file__).resolve().parents[1]
SOURCE = ROOT / "src" / "orthaug"
PAGES = [
    *sorted((ROOT / "docs").rglob("*.md")),
    *(ROOT / name for name in ("CONTRIBUTING.md", "README.md", "CHANGELOG.md", "examples/README.md")),
]
TEXTS = {str(page.relative_to(ROOT)): page.read_text(encoding="utf-8") for page in PAGES}
DEVELOPERS = ("CONTRIBUTING.md", "docs/design.md", "docs/notation.md")  # their names are the code's, not a spec's


def backticked(text: str) -> list[str]:
    return re.findall(r"`([^`\n]+)`", re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE))


def found(path: str, page: str) -> list[Path]:
    """The files that a path in a document means, from its own folder, the root or the sources."""
    places = (ROOT / page).parent, ROOT, SOURCE
    return [file for place in places for file in ([place / path] if "*" not in path else place.glob(path))]


def parsed(files: list[Path]) -> list[ast.stmt]:
    return [node for file in files for node in ast.parse(file.read_text(encoding="utf-8")).body]


def members(name: str, nodes: list[ast.stmt]) -> set[str]:
    """The attributes of a class, as its body, its bases and `self.…` define them; none where there is no such class."""
    names: set[str] = set()
    for node in nodes:
        if isinstance(node, ast.ClassDef) and node.name == name:
            for child in ast.walk(node):
                if isinstance(child, ast.FunctionDef):
                    names.add(child.name)
                elif isinstance(child, ast.AnnAssign | ast.Assign):
                    targets = [child.target] if isinstance(child, ast.AnnAssign) else child.targets
                    names |= {t.id if isinstance(t, ast.Name) else getattr(t, "attr", "") for t in targets}
            names = names.union(*(members(base.id, nodes) for base in node.bases if isinstance(base, ast.Name)))
    return names


def commands_in(text: str) -> set[str]:
    """What follows `orthaug` in backticks, and at the start of a line of fenced code."""
    fenced = "\n".join(re.findall(r"^```.*?^```", text, flags=re.DOTALL | re.MULTILINE))
    return {*re.findall(r"`orthaug ([a-z]+)", text), *re.findall(r"^(?:\$ )?orthaug ([a-z]+)", fenced, re.MULTILINE)}


COMMANDS = {command.name or getattr(command.callback, "__name__", "") for command in app.registered_commands}
EVERYTHING = parsed(sorted(SOURCE.rglob("*.py")))
WORDS = set(re.findall(r"\w+", "".join(f.read_text() for d in (SOURCE, ROOT / "tests") for f in d.rglob("*.py"))))


@pytest.mark.parametrize("page", TEXTS)
def test_every_file_that_is_named_exists(page):
    text = re.sub(r'title="[^"]+"', "", TEXTS[page])  # files that a page writes
    named = re.findall(r"(?<![\w/.<])[\w./*-]+\.pyi?\b", text)
    named += [link for link in re.findall(r"\]\(([^)#]+)\)", TEXTS[page]) if "://" not in link]
    missing = {path for path in named if not any(file.exists() for file in found(path, page))}
    assert missing == set()


@pytest.mark.parametrize("page", TEXTS)
def test_every_dotted_name_exists(page):
    missing = set()
    for name in re.findall(r"\b(?:orthaug|oa)(?:\.[A-Za-z_]\w*)+", "\n".join(backticked(TEXTS[page]))):
        first, *rest = name.replace("oa.", "orthaug.", 1).split(".")[1:]
        thing = importlib.import_module(f"orthaug.{first}") if first in ROOMS else getattr(orthaug, first, None)
        for part in rest:
            if hasattr(thing, "__path__") and not hasattr(thing, part):
                thing = importlib.import_module(f"{thing.__name__}.{part}")
            else:
                thing = getattr(thing, part, None)
        missing |= {name} if thing is None else set()
    for owner, attribute in re.findall(r"\b([A-Z]\w+)\.(?!md|csv)([a-z_]\w*)", "\n".join(backticked(TEXTS[page]))):
        missing |= {f"{owner}.{attribute}"} - {f"{owner}.{one}" for one in members(owner, EVERYTHING)}
    assert missing == set()


@pytest.mark.parametrize("page", TEXTS)
def test_every_command_that_is_named_exists(page):
    assert commands_in(TEXTS[page]) <= COMMANDS


def test_every_command_that_the_program_names_exists():
    texts = [
        file.read_text(encoding="utf-8") for suffix in ("py", "html", "toml") for file in SOURCE.rglob(f"*.{suffix}")
    ]
    named = set().union(*(commands_in(text) for text in texts))
    assert named <= COMMANDS and len(named) > 5


def test_commands_are_found_in_texts():
    text = "`orthaug validate x.toml`\nso orthaug is\n```sh\northaug fit a.toml\n$ orthaug demo\n```\northaug computes"
    assert commands_in(text) == {"validate", "fit", "demo"}


@pytest.mark.parametrize("page", DEVELOPERS)
def test_every_name_of_the_code_is_a_word_of_the_code(page):
    named = [text.partition("(")[0].removeprefix("@") for text in backticked(TEXTS[page])]
    named = [text for text in named if re.fullmatch(r"[A-Za-z]\w*_\w*|[A-Z]\w*[a-z]\w*|[A-Z]{3,}", text)]
    assert {name for name in named if name not in WORDS} == set()


def test_the_rooms_are_told_in_their_order():
    told = tuple(re.findall(r"^\| `(\w+)` \|", TEXTS["CONTRIBUTING.md"], re.MULTILINE))
    assert told == ROOMS
    assert " ← ".join(f"`{room}`" for room in ROOMS) in TEXTS["docs/design.md"]


def test_the_learner_of_the_example_is_one_file_and_one_entry(tmp_path):
    (text,) = re.findall(r"^```python\n(.*?)^```", TEXTS["CONTRIBUTING.md"], re.DOTALL | re.MULTILINE)
    names: dict = {"__name__": __name__}
    exec(compile(text, "CONTRIBUTING.md", "exec", dont_inherit=True), names)
    polynomial = names["Polynomial"]
    spec = make_project(tmp_path)
    section = '[learner]\nkind = "polynomial"\nhighest = 2\n'
    spec.write_text(re.sub(r"^\[learner\]\n(?:\w.*\n)*", section, spec.read_text(), flags=re.MULTILINE))
    with LEARNERS.added("polynomial", polynomial):
        assert load_spec(spec).declared_learner() == polynomial(highest=2)
    assert Bound(polynomial(), nz=2, ny=1).size == 4
    with pytest.raises(orthaug.InputError, match="`highest` must be a whole number, 2 or more; got 1"):
        polynomial(highest=1)
