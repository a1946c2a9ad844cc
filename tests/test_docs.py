"""What the documents name is there: files, names in them, rooms; and what they tell a contributor to write works."""

from __future__ import annotations

import ast
import importlib
import inspect
import re
import textwrap
from collections.abc import Iterable
from dataclasses import fields, is_dataclass
from functools import cache
from pathlib import Path

import pytest
from sources import parsed
from test_architecture import ROOMS
from test_cli import make_project, run

import orthaug
from orthaug.models.kinds import LEARNERS
from orthaug.models.learners import Bound

ROOT = Path(__file__).resolve().parents[1]
SOURCE = ROOT / "src" / "orthaug"
PAGES = [
    *sorted((ROOT / "docs").rglob("*.md")),
    *(
        ROOT / name
        for name in ("CONTRIBUTING.md", "README.md", "CHANGELOG.md", "examples/README.md")
    ),
]
TEXTS = {str(page.relative_to(ROOT)): page.read_text(encoding="utf-8") for page in PAGES}
MADE = {  # by functions: nobody writes their arguments
    *(
        "Estimate",
        "LaggedEstimate",
        "MotionEstimate",
        "Model",
        "MotionModel",
        "Response",
        "Trajectory",
        "Status",
        "Explanation",
    ),
    *("LinearView", "Linearization", "Selection", "PhysicsMap"),
}
# Their names are the code's, not a spec's
DEVELOPERS = (
    "CONTRIBUTING.md",
    "docs/notation.md",
    "docs/architecture.md",
    "docs/guide/inside.md",
    *sorted(name for name in TEXTS if name.startswith("docs/decisions/")),
)


def backticked(text: str) -> list[str]:
    return re.findall(
        r"`([^`\n]+)`", re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE)
    )


def found(path: str, page: str) -> list[Path]:
    """The files that a path in a document means, from its own folder, the root or the sources."""
    places = (ROOT / page).parent, ROOT, SOURCE
    return [
        file
        for place in places
        for file in ([place / path] if "*" not in path else place.glob(path))
    ]


def statements(files: Iterable[Path]) -> list[ast.stmt]:
    return [node for file in files for node in parsed(file).body]


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
                    names |= {
                        t.id if isinstance(t, ast.Name) else getattr(t, "attr", "") for t in targets
                    }
            names = names.union(
                *(members(base.id, nodes) for base in node.bases if isinstance(base, ast.Name))
            )
    return names


def commands_in(text: str) -> set[str]:
    """What follows `orthaug` in backticks, and at the start of a line of fenced code."""
    fenced = "\n".join(re.findall(r"^```.*?^```", text, flags=re.DOTALL | re.MULTILINE))
    return {
        *re.findall(r"`orthaug ([a-z]+)", text),
        *re.findall(r"^(?:\$ )?orthaug ([a-z]+)", fenced, re.MULTILINE),
    }


COMMANDS = {*re.findall(r"^  (\w+) ", run("--help").out.partition("Commands:")[2], re.MULTILINE)}


@cache
def everything() -> list[ast.stmt]:
    return statements(sorted(SOURCE.rglob("*.py")))


@cache
def words() -> set[str]:
    return set(
        re.findall(
            r"\w+",
            "".join(f.read_text() for d in (SOURCE, ROOT / "tests") for f in d.rglob("*.py")),
        )
    )


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
    for name in re.findall(
        r"\b(?:orthaug|oa)(?:\.[A-Za-z_]\w*)+", "\n".join(backticked(TEXTS[page]))
    ):
        first, *rest = name.replace("oa.", "orthaug.", 1).split(".")[1:]
        thing = (
            importlib.import_module(f"orthaug.{first}")
            if first in ROOMS
            else getattr(orthaug, first, None)
        )
        for part in rest:
            if hasattr(thing, "__path__") and not hasattr(thing, part):
                thing = importlib.import_module(f"{thing.__name__}.{part}")
            else:
                thing = getattr(thing, part, None)
        missing |= {name} if thing is None else set()
    for owner, attribute in re.findall(
        r"\b([A-Z]\w+)\.(?!md|csv)([a-z_]\w*)", "\n".join(backticked(TEXTS[page]))
    ):
        missing |= {f"{owner}.{attribute}"} - {
            f"{owner}.{one}" for one in members(owner, everything())
        }
    assert missing == set()


@pytest.mark.parametrize("page", TEXTS)
def test_every_command_that_is_named_exists(page):
    assert commands_in(TEXTS[page]) <= COMMANDS


def test_every_command_that_the_program_names_exists():
    texts = [
        file.read_text(encoding="utf-8")
        for suffix in ("py", "html", "toml")
        for file in SOURCE.rglob(f"*.{suffix}")
    ]
    named = set().union(*(commands_in(text) for text in texts))
    assert named <= COMMANDS and len(named) > 5


def test_commands_are_found_in_texts():
    text = (
        "`orthaug validate x.toml`\nso orthaug is\n```sh\northaug fit a.toml\n$ orthaug "
        "demo\n```\northaug computes"
    )
    assert commands_in(text) == {"validate", "fit", "demo"}


@pytest.mark.parametrize("page", DEVELOPERS)
def test_every_name_of_the_code_is_a_word_of_the_code(page):
    named = [text.partition("(")[0].removeprefix("@") for text in backticked(TEXTS[page])]
    named = [
        text for text in named if re.fullmatch(r"[A-Za-z]\w*_\w*|[A-Z]\w*[a-z]\w*|[A-Z]{3,}", text)
    ]
    assert {name for name in named if name not in words()} == set()


def test_every_numbered_fact_is_reported():
    names = re.findall(r"^\| (F\d+) \|", TEXTS["docs/guide/theory.md"], re.MULTILINE)
    texts = [*TEXTS.values(), *(file.read_text(encoding="utf-8") for file in SOURCE.rglob("*.py"))]
    named = set(re.findall(r"[(\s](F\d{1,2})[),:.\s]", " ".join(texts)))
    assert names == [f"F{i + 1}" for i in range(12)] and named - set(names) == set()


def test_the_rooms_are_reported_in_their_order():
    names = tuple(re.findall(r"^\| `(\w+)` \|", TEXTS["CONTRIBUTING.md"], re.MULTILINE))
    assert names == ROOMS
    assert " ← ".join(f"`{room}`" for room in ROOMS) in TEXTS["docs/decisions/rooms.md"]


def test_the_learner_of_the_example_is_one_file_and_one_entry(tmp_path):
    (text,) = re.findall(
        r"^```python\n(.*?)^```", TEXTS["docs/guide/inside.md"], re.DOTALL | re.MULTILINE
    )
    names: dict = {"__name__": __name__}
    exec(compile(text, "inside.md", "exec", dont_inherit=True), names)
    polynomial = names["Polynomial"]
    spec = make_project(tmp_path)
    section = '[learner]\nkind = "polynomial"\nhighest = 2\n'
    spec.write_text(
        re.sub(r"^\[learner\]\n(?:\w.*\n)*", section, spec.read_text(), flags=re.MULTILINE)
    )
    with LEARNERS.with_kind("polynomial", polynomial):
        assert orthaug.load_spec(spec).spec.declared_learner() == polynomial(highest=2)
    assert Bound(polynomial(), nz=2, ny=1).size == 4
    with pytest.raises(
        orthaug.InputError, match="`highest` must be a whole number, 2 or more; got 1"
    ):
        polynomial(highest=1)


def told(thing: type | object) -> str:
    """The docstrings of a function or of a class, of its fields and of its makers."""
    if not inspect.isclass(thing):
        return inspect.getdoc(thing) or ""
    body = ast.parse(textwrap.dedent(inspect.getsource(thing))).body[0]
    fields = [
        f"{before.target.id}: {ast.literal_eval(text.value)}"
        for before, text in zip(body.body, body.body[1:], strict=False)  # type: ignore[attr-defined]
        if isinstance(before, ast.AnnAssign)
        and isinstance(before.target, ast.Name)
        and isinstance(text, ast.Expr)
    ]
    makers = [
        inspect.getdoc(member) or ""
        for name, member in inspect.getmembers(thing)
        if name.startswith("from_")
    ]
    bases = [inspect.getsource(base) for base in thing.__mro__[1:] if base.__name__.startswith("_")]
    return "\n".join([inspect.getdoc(thing) or "", *fields, *makers, *bases])


def test_every_argument_of_a_function_and_of_a_declaration_is_reported():
    known = {"name", "resident"}  # what the name says, and what only the engines' own code gives
    untold = {}
    for name in orthaug.__all__:
        thing = getattr(orthaug, name)
        made = inspect.isclass(thing) and (not is_dataclass(thing) or name in MADE)
        if inspect.ismodule(thing) or made:
            continue
        arguments = (
            [f.name for f in fields(thing) if f.init]
            if inspect.isclass(thing)
            else inspect.signature(thing).parameters
        )
        text = told(thing)
        untold[name] = {one for one in arguments if not re.search(rf"\b{one}\b", text)} - known
    assert {name: missing for name, missing in untold.items() if missing} == {} and len(untold) > 50


def test_the_most_used_names_have_examples():
    wanted = """read_record Record Channel Lags Term Baseline MLP Terms Motion PhysicalParameter PhysicsMap Uniform
    Samples Simulation Prediction prepare Detrend Lowpass Decimate Outliers Shift save Model estimate Suspect
    MotionSuspect export numpy_step identifiability scores Orthogonal verdict diagnose stability bias_budget
    linearize"""
    assert {
        name
        for name in wanted.split()
        if ">>> " not in (inspect.getdoc(getattr(orthaug, name)) or "")
    } == set()


def test_the_glossary_is_short_sorted_and_plain() -> None:
    """At most 25 words of our own, in order, each explained in at most two sentences and in use elsewhere."""
    page = (ROOT / "docs" / "glossary.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| ([^|]+) \| ([^|]+) \|$", page, re.M)[1:]
    terms = [term for term, _ in rows]
    others = " ".join(
        file.read_text(encoding="utf-8")
        for file in (ROOT / "docs").rglob("*.md")
        if file.name != "glossary.md"
    )
    assert 15 <= len(terms) <= 25 and terms == sorted(set(terms))
    used = others.replace("_", " ")
    assert [one for one in terms if not re.search(one.split(", ")[0], used, re.I)] == []
    assert [term for term, text in rows if not text.endswith(".") or text.count(". ") > 1] == []
