"""Every block of code of README and docs runs as it is written, in a fresh folder, and prints what stands below it."""

from __future__ import annotations

import ast
import importlib
import re
import sys
from collections.abc import Iterator

import given
import matplotlib
import pytest
from documents import ROOT, Page, blocks, blocks_of, differences, pages
from sources import parsed

import orthaug
from orthaug.export.kinds import TARGETS

SOURCE = ROOT / "src" / "orthaug"

PAGES = {page.relative_to(ROOT).as_posix(): page for page in pages()}
BLOCKS = {name: blocks_of(page) for name, page in PAGES.items()}
RUNNING = [name for name, found in BLOCKS.items() if any(block.not_run is None for block in found)]
REFERENCE = "".join(
    page.read_text(encoding="utf-8") for page in sorted((ROOT / "docs" / "reference").glob("*.md"))
)
RESULTS = ("analysis", "selection", "inference")  # rooms whose classes are results
NOT_RUN = 12
OPTIONAL = ("casadi", "control", "dask", "distributed", "pyarrow", "sklearn")


@pytest.fixture
def fresh(tmp_path, monkeypatch) -> Iterator[None]:
    """A fresh folder to work in; what a page leaves in the process goes with it. Other tests draw figures."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("orthaug.commands.fit._draw", lambda *_: None)
    matplotlib.use("agg")
    path, targets, modules = list(sys.path), dict(TARGETS), set(sys.modules)
    yield
    sys.path[:] = path
    for kind in set(TARGETS) - set(targets):
        TARGETS.remove(kind)
    for name in set(sys.modules) - modules:
        if str(getattr(sys.modules[name], "__file__", None) or "").startswith(
            (str(tmp_path), "mpc")
        ):
            del sys.modules[name]
    while given.OPEN:
        given.OPEN.pop().close()


@pytest.mark.parametrize("name", RUNNING)
@pytest.mark.usefixtures("fresh")
def test_the_page_runs(name):
    page = Page(PAGES[name])
    for block in page.blocks:
        if block.not_run is None:
            try:
                printed = page.printed(block)
            except ModuleNotFoundError as error:
                if error.name not in OPTIONAL:
                    raise
                pytest.skip(f"no {error.name}")
            assert block.prints is None or differences(block.prints, printed) == [], (
                f"{name}:{block.line}"
            )


def test_few_blocks_are_not_run_and_each_says_why():
    left_out = [
        f"{name}:{block.line} {block.language}: {block.not_run}"
        for name, found in BLOCKS.items()
        for block in found
        if block.not_run is not None
    ]
    print("\n".join(left_out))
    assert len(left_out) <= NOT_RUN
    assert all(len(reason.rpartition(": ")[2].split()) >= 2 for reason in left_out)


def test_every_public_name_is_in_the_reference():
    public = re.findall(
        r"^from \.[\w.]+ import (\w+) as \1$", (SOURCE / "__init__.pyi").read_text(), re.MULTILINE
    )
    names = re.findall(r"^::: orthaug\.(\w+)$", REFERENCE, re.MULTILINE)
    assert sorted(names) == sorted(public) and len(public) > 80


def test_what_functions_return_is_in_the_reference():
    """Every class of ours that a public function returns, and every class of a result that its fields hold."""
    classes: dict[str, list[tuple[str, ast.ClassDef]]] = {}
    public = set(orthaug.__all__)
    annotations = [
        str(getattr(getattr(orthaug, name), "__annotations__", {}).get("return")) for name in public
    ]
    for file in sorted(SOURCE.rglob("*.py")):
        for node in parsed(file).body:
            if isinstance(node, ast.ClassDef):
                classes.setdefault(node.name, []).append((file.relative_to(SOURCE).parts[0], node))
    returned = set(classes).intersection(re.findall(r"\b[A-Z]\w+", " ".join(annotations)))
    held = {
        name
        for owner in returned | (public & set(classes))
        for room, node in classes[owner]
        if room in RESULTS
        and (owner in returned or f"orthaug.{room}." in getattr(orthaug, owner).__module__)
        for child in node.body
        if isinstance(child, ast.AnnAssign)
        for name in re.findall(r"\b[A-Z]\w+", ast.unparse(child.annotation))
        if any(room in RESULTS for room, _ in classes.get(name, ()))
    }
    assert {
        "Verdict",
        "Budget",
        "Diagnosis",
        "Job",
        "FitReport",
    } <= returned and "SuspectedBias" in held
    names = re.findall(r"^::: orthaug\.(?:[\w.]+\.)?(\w+)$", REFERENCE, re.MULTILINE)
    assert (returned | held) - set(names) == set()
    assert {
        "PhysicalEstimate",
        "Observations",
        "ObserverState",
        "Alarm",
        "FitPlots",
        "Page",
    } <= set(names)
    for shown in ("Estimate", "MotionEstimate"):
        assert re.search(
            rf"^::: orthaug\.{shown}\n    options: .*plot, report", REFERENCE, re.MULTILINE
        )


def test_readme_and_home_page_have_no_comments_and_readme_is_short():
    texts = {
        name: PAGES[name].read_text(encoding="utf-8") for name in ("README.md", "docs/index.md")
    }
    assert {name for name, text in texts.items() if "<!--" in text} == set()
    assert len(texts["README.md"].split()) <= 600
    contributing = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    assert len(contributing.split()) <= 1200


def test_pages_have_pictures_that_are_small_and_described():
    """Each tutorial and the pages where people look; every picture has a function that draws it, and words."""
    shown = {
        name: re.findall(r"^!\[([^\]]*)\]\((\S+)\)", page.read_text(encoding="utf-8"), re.MULTILINE)
        for name, page in PAGES.items()
    }
    wanted = {name for name in PAGES if re.match(r"docs/tutorials/(?!index)", name)}
    looked_at = [
        "result",
        "app",
        "selection",
        "explain",
        "linear",
        "observer",
        "export",
        "architecture",
    ]
    wanted |= {"README.md", *(f"docs/{page}.md" for page in looked_at)}
    assert {name for name in wanted if not shown[name]} == set()
    files = {(PAGES[name].parent / path).resolve() for name in shown for _, path in shown[name]}
    assert all(len(text) > 20 for name in shown for text, _ in shown[name])
    assert files == set((ROOT / "docs" / "figures").iterdir())
    assert max(file.stat().st_size for file in files) <= 60_000
    assert sum(file.stat().st_size for file in files) <= 1_200_000
    drawn = (ROOT / "docs" / "_site" / "figures.py").read_text(encoding="utf-8")
    made = {
        page.rpartition("/")[2].lower()
        for page in re.findall(r'^@picture\("([\w/]+)"', drawn, re.M)
    }
    assert {file.stem for file in files} - {"app", "mpc"} <= made


def test_every_page_is_in_the_navigation():
    nav = (ROOT / "mkdocs.yml").read_text(encoding="utf-8").partition("\nnav:")[2]
    names = set(re.findall(r"[\w/]+\.md\b", nav))
    assert {name.removeprefix("docs/") for name in PAGES if name != "README.md"} <= names


def test_every_warning_has_a_row_with_a_remedy():
    calls = [
        node
        for file in SOURCE.rglob("*.py")
        for node in ast.walk(parsed(file))
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "Warning"
    ]
    first = [call.args[0] if call.args else call.keywords[0].value for call in calls]
    codes = {node.value for node in first if isinstance(node, ast.Constant)}
    rows = re.findall(
        r"^\| (`.+`) \| .+ \| .+ \|$", (ROOT / "docs/guide/trouble.md").read_text(), re.MULTILINE
    )
    assert len(codes) > 50 and codes - set(re.findall(r"`(\w+)`", " ".join(rows))) == set()


@pytest.mark.parametrize(
    ("expected", "printed", "same"),
    [
        ("RMSE 0.0251 m", "RMSE   0.02512 m\n", True),
        ("RMSE 0.0251 m", "RMSE 0.0271 m", False),
        ("rank 3 of 3", "rank 2 of 3", False),
        ("took ... s\nloss 1.2e-3", "took 5 s of 8 s\n\nloss 1.21e-03\n", True),
        ("loss 1.2e-3", "loss 1.4e-03", False),
        ("y[k-1]  -0.5", "y[k-2] -0.5", False),
        ("value -0.5", "value 0.5", False),
        ("a b", "a c", False),
    ],
)
def test_output_is_compared(expected, printed, same):
    assert (differences(expected, printed) == []) is same


def test_blocks_of_a_page():
    text = (
        "<!-- given: run1.csv, record -->\n```python\nx = 1\n```\n\n```text\n1\n```\n<!-- not run: no device -->\n"
        '```sh\nfail\n```\nwords\n```text\nno output\n```\n<!-- exit 2 -->\n```toml title="a.toml"\n```\n'
    )
    one, two, three = blocks(text)
    assert (one.given, one.prints, one.line) == (["run1.csv", "record"], "1\n", 2)
    assert (two.not_run, two.prints) == ("no device", None)
    assert (three.title, three.exits) == ("a.toml", 2)


def test_a_page_of_the_site_that_loads_from_a_network_is_found(monkeypatch):
    pytest.importorskip("mkdocs")
    monkeypatch.syspath_prepend(ROOT / "docs" / "_site")
    hooks = importlib.import_module("hooks")
    for tag in (
        '<script src="https://x.y/z.js">',
        "<link rel=stylesheet href=//x.y/z.css>",
        '<img src="http://x.y/z.png">',
    ):
        assert hooks.LOADED.search(tag)
    assert not hooks.LOADED.search(
        '<a href="https://x.y"><img src="figures/a.png"><script src="../assets/a.js">'
    )
    linked = hooks.targets(
        "[a](../examples/mpc.py) [b](https://x.y) [c](spec.md#data) [d](absent.md)",
        "docs/export.md",
    )
    assert linked == {"../examples/mpc.py": "examples/mpc.py", "spec.md": "docs/spec.md"}
    section = '<nav class="md-nav" data-md-level="1" aria-labelledby="l">'
    named = hooks.NAMED.sub(
        r'\1 aria-label="\3"\2\3',
        f'{section} <label class="md-nav__title"><span></span> Theory </label>',
    )
    assert named.startswith('<nav class="md-nav" data-md-level="1" aria-label="Theory">')
    assert (
        hooks.boost("export.md")
        > hooks.boost("reference/further.md")
        > hooks.boost("repository/README.md")
    )
    assert (
        hooks.place("examples/mpc.py") == "repository/examples/mpc.py"
        and hooks.place("docs/spec.md") == "spec.md"
    )
