"""The house rules that a machine can check: rooms, forbidden names, sizes, and what an import may load."""

from __future__ import annotations

import ast
import importlib
import json
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator
from functools import cache
from pathlib import Path

import pytest
from sources import parsed

import orthaug

SOURCE = Path(__file__).resolve().parents[1] / "src" / "orthaug"

# From left to right; a room imports only from those to its left.
ROOMS = (
    "_base",
    "data",
    "physics",
    "models",
    "inference",
    "fitting",
    "analysis",
    "selection",
    "export",
    "reports",
    "studies",
    "commands",
)
NUMERICAL = ROOMS[: ROOMS.index("reports")]  # these know no pictures and no user
NOT_NUMERICAL = ("matplotlib", "typer", "rich", "pandas.io")
ONLY_IN = {
    "matplotlib": {"reports.drawing", "studies"},
    "typer": {"commands.cli", "commands.model_cli", "commands.program"},
}  # a room, or a file
UNSAFE_MODULES = (
    "pickle",
    "cPickle",
    "_pickle",
    "cloudpickle",
    "dill",
    "joblib",
    "marshal",
    "shelve",
)
UNSAFE_CALLS = ("eval", "exec", "read_pickle", "to_pickle")
MOST_NAMES = 12  # of a room's face
ENTRIES = {
    "studies.": "a study is an entry of `orthaug reproduce`",
    "export.": "a target is an entry of `orthaug export --to`",
    "commands.": "a command, or a part of the page, has a file of its own",
}
CONCEPTS = {
    "_base.kept_programs": "traced programs on disk",
    "analysis.amplitude_dependence": "the nearest linear system over movements of some size",
    "analysis.form_budget": "what other forms of selected terms make of the parameters",
    "selection.linear_runs": "linear models by the error of their free run",
    "_base.host_calls": "the interface of XLA to functions of the host",
    "physics.fmu": "a kind of source",
    "physics.fmu_points": "values of an FMU, with slopes",
    "physics.mechanisms": "a kind of source",
    "physics.array_moves": "what only moves elements of arrays",
    "analysis.free_run_stability": "all checks of stability together",
    "analysis.observer": "the verb `observe`",
    "analysis.term_sensitivities": "slopes of a free run by terms that are added to it",
    "analysis.plant": "systems simulated for many inputs side by side",
    "analysis.signals": "excitation signals",
    "analysis.verdict_text": "verdicts on residuals, in words",
    "data.matlab": "a reader of MATLAB's v5 files",
    "fitting.innovations": "the gain of a predictor, estimated",
    "fitting.focus": "the choice of `Auto`",
    "fitting.free_run": "training on the free run",
    "fitting.noise_estimation": "coefficients and orders of noise models",
    "fitting.recursive_storage": "the format of a saved recursive estimate",
    "fitting.segmented_streamed": "segments of rows that remain in a source",
    "models.devices": "an engine, an entry of the registry",
    "reports.figures": "figures from Python",
    "reports.linear_text": "linear views in words",
    "reports.page_findings": "a section of the page",
    "reports.page_learned": "a section of the page",
    "selection.candidates": "which terms can be chosen",
    "selection.explaining": "the regression behind `explain`",
    "selection.roles": "inputs and outputs by what predicts what",
    "selection.selecting": "the verb `select`",
}


def module_name(path: Path) -> str:
    """`orthaug/fitting/estimates.py` is `fitting.estimates`, a package is its folder, orthaug itself is ''."""
    parts = path.relative_to(SOURCE).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


FILES = {
    module_name(path): path for path in sorted(SOURCE.rglob("*.py")) if path.name != "__main__.py"
}


def imports_of(name: str, tree: ast.AST, is_package: bool) -> Iterator[tuple[int, str]]:
    """(line, dotted name) of everything imported, inside functions and for types only too; relative ones made absolute.

    `from a import b` yields `a.b`, so that a submodule and a name in a module look alike.
    """
    package = ["orthaug", *(name.split(".") if name else [])]
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                above = node.level - 1 if is_package else node.level
                base = ".".join([*package[: len(package) - above], *([base] if base else [])])
            yield from ((node.lineno, f"{base}.{alias.name}") for alias in node.names)
        elif isinstance(node, ast.Call) and called(node) in ("import_module", "__import__"):
            target = node.args[0] if node.args else None
            if isinstance(target, ast.Constant) and isinstance(target.value, str):
                yield node.lineno, target.value
            else:
                yield node.lineno, "a computed name"


def called(node: ast.Call) -> str:
    """The last name of what is called: `print` for `print(…)`, `eval` for `frame.eval(…)`."""
    function = node.func
    return function.id if isinstance(function, ast.Name) else getattr(function, "attr", "")


def within(imported: str, package: str) -> bool:
    return imported == package or imported.startswith(package + ".")


def own(imported: str) -> str | None:
    """What is imported of orthaug, without its first name; None for other packages and for the version.

    The version is there before any room, and the root imports none of them until it is asked.
    """
    head, _, rest = imported.partition(".")
    return None if head != "orthaug" or rest == "__version__" else rest


def room_of(name: str) -> str:
    return name.partition(".")[0]


@cache
def all_imports(name: str) -> tuple[tuple[int, str], ...]:
    return tuple(imports_of(name, parsed(FILES[name]), FILES[name].name == "__init__.py"))


def breaches(name: str, tree: ast.AST, is_package: bool = False) -> list[str]:
    """Imports of `name` from a room that is not its own nor to the left of it."""
    found = []
    for line, imported in imports_of(name, tree, is_package):
        if imported == "a computed name":
            found.append(f"line {line} imports a computed name, which no one can check")
        target = own(imported)
        if target is not None and (
            room_of(target) not in ROOMS
            or (name and ROOMS.index(room_of(target)) > ROOMS.index(room_of(name)))
        ):
            found.append(
                f"line {line} imports {imported}, which is not to the left of {name or 'orthaug'}"
            )
    return found


def files_imported(name: str) -> set[str]:
    """The files of orthaug that a file imports; a name that a room's face hands on is the file it comes from."""
    found = set()
    for _, imported in all_imports(name):
        target = own(imported)
        while target and target not in FILES:
            target = target.rpartition(".")[0]
        if target and FILES[target].name == "__init__.py":
            target = handed_on(target).get(imported.rpartition(".")[2], target)
        if target:
            found.add(target)
    return found - {name}


@cache
def handed_on(room: str) -> dict[str, str]:
    """The names of a room's face, with the file that each comes from."""
    face = FILES[room].with_suffix(".pyi")
    if not face.exists():
        return {}
    return {
        alias.name: f"{room}.{node.module}" if node.module else f"{room}.{alias.name}"
        for node in ast.parse(face.read_text(encoding="utf-8")).body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }


def in_files(
    found: Callable[[str], list[str]], names: Iterable[str] = FILES
) -> dict[str, list[str]]:
    """What is found in each file where there is anything."""
    return {name: told for name in names if (told := found(name))}


def test_the_rooms_are_those_of_the_list() -> None:
    folders = {
        path.name for path in SOURCE.iterdir() if path.is_dir() and path.name != "__pycache__"
    }
    assert folders == set(ROOMS)
    assert {name for name in FILES if "." not in name} == {"", *ROOMS}, "a file belongs into a room"


def test_imports_point_to_the_left() -> None:
    assert (
        in_files(
            lambda name: breaches(name, parsed(FILES[name]), FILES[name].name == "__init__.py")
        )
        == {}
    )


def test_no_files_import_each_other() -> None:
    graph = {name: files_imported(name) for name in FILES}
    while True:
        ends = {name for name, imported in graph.items() if not imported & graph.keys()}
        if not ends:
            break
        graph = {name: imported for name, imported in graph.items() if name not in ends}
    assert graph == {}, f"a circle among {', '.join(graph)}"


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("models.rows", "from orthaug.fitting.estimates import Estimate"),
        ("models.rows", "import orthaug.fitting.estimates"),
        ("models.rows", "from orthaug.fitting import Estimate"),
        ("models.rows", "from orthaug import fitting"),
        ("models.rows", "from orthaug import estimate"),
        ("models.rows", "import orthaug"),
        ("models.rows", "from ..fitting import Estimate"),
        ("models.rows", "def f():\n    from orthaug.commands.cli import main"),
        ("models.rows", "import importlib\nimportlib.import_module('orthaug.commands.cli')"),
        ("models.rows", "import importlib\nimportlib.import_module(name)"),
        ("models.rows", "if TYPE_CHECKING:\n    from orthaug.commands.cli import main"),
        ("fitting.solvers.levenberg_marquardt", "from ...analysis import diagnose"),
    ],
)
def test_an_import_from_the_right_is_seen(name: str, text: str) -> None:
    assert len(breaches(name, ast.parse(text))) == 1


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("models.rows", "import numpy\nfrom orthaug._base.jax import jnp"),
        ("models.rows", "from .._base import jax"),
        ("models.rows", "from orthaug import __version__"),
        ("models.rows", "from orthaug.models.learners import Bound"),
        ("fitting.solvers.levenberg_marquardt", "from ..status import Status"),
    ],
)
def test_an_import_from_the_left_is_let_pass(name: str, text: str) -> None:
    assert breaches(name, ast.parse(text)) == []


def test_numerical_rooms_know_no_pictures_and_no_user() -> None:
    def pictures(name: str) -> list[str]:
        return [
            what
            for _, what in all_imports(name)
            if any(within(what, package) for package in NOT_NUMERICAL)
        ]

    numerical = [name for name in FILES if room_of(name) in NUMERICAL]
    assert len(numerical) > 100 and in_files(pictures, numerical) == {}


@pytest.mark.parametrize("package", ONLY_IN)
def test_one_place_imports_it(package: str) -> None:
    users = {name for name in FILES if any(within(what, package) for _, what in all_imports(name))}
    assert {
        name for name in users if not any(within(name, place) for place in ONLY_IN[package])
    } == set()


def test_nothing_prints_or_runs_text_as_code() -> None:
    assert in_files(unsafe) == {}


def unsafe(name: str) -> list[str]:
    found = [
        f"line {line}: {what}"
        for line, what in all_imports(name)
        if any(within(what, one) for one in UNSAFE_MODULES)
    ]
    for node in ast.walk(parsed(FILES[name])):
        if isinstance(node, ast.Call):
            verb = called(node)
            if verb in UNSAFE_CALLS or (verb == "print" and isinstance(node.func, ast.Name)):
                found.append(f"line {node.lineno}: {verb}(…)")
            if any(
                keyword.arg == "allow_pickle" and not is_false(keyword.value)
                for keyword in node.keywords
            ):
                found.append(f"line {node.lineno}: allow_pickle")
        elif isinstance(node, ast.ExceptHandler) and node.type is None:
            found.append(f"line {node.lineno}: a bare except")
    return found


def is_false(node: ast.expr) -> bool:
    return isinstance(node, ast.Constant) and node.value is False


def importers() -> dict[str, set[str]]:
    """Return the files that import each file, by their dotted names; a room's own face does not count."""
    found: dict[str, set[str]] = {name: set() for name in FILES}
    for name, path in FILES.items():
        for _, dotted in imports_of(name, parsed(path), path.name == "__init__.py"):
            parts = dotted.removeprefix("orthaug.").split(".")
            for end in range(len(parts), 0, -1):
                target = ".".join(parts[:end])
                if target in FILES and target != name:
                    found[target].add(name)
                    break
    return found


def test_a_file_that_one_file_imports_is_a_concept() -> None:
    """Cut a file where a concept ends, not where it is long: what only one file uses is part of it."""
    single = {
        name
        for name, others in importers().items()
        if len(others) == 1 and FILES[name].name != "__init__.py"
    }
    entries = {name for name in single if name.startswith(tuple(ENTRIES))}
    assert single - entries - set(CONCEPTS) == set()
    assert set(CONCEPTS) - single == set(), (
        "these are imported elsewhere, too: strike them from the list"
    )


def test_a_face_has_few_names() -> None:
    for room in ROOMS:
        face = (SOURCE / room / "__init__.pyi").read_text(encoding="utf-8")
        assert face.count(" as ") <= MOST_NAMES, room


def loaded_by(code: str) -> dict[str, object]:
    """What `code` leaves in the dictionary `report`, run in an interpreter of its own."""
    program = f"import json, sys\nreport = {{}}\n{code}\nprint('\\n' + json.dumps(report))"
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def test_the_import_and_the_help_page_load_nothing_heavy() -> None:
    report = loaded_by(
        "HEAVY = ('jax', 'pandas', 'matplotlib')\n"
        "import orthaug\n"
        "report['import'] = [name for name in HEAVY if name in sys.modules]\n"
        "from orthaug.commands.cli import main\n"
        "sys.argv = ['orthaug', '--help']\n"
        "try:\n"
        "    report['code'] = main()\n"
        "except SystemExit as stop:\n"
        "    report['code'] = stop.code\n"
        "report['help'] = [name for name in HEAVY if name in sys.modules]"
    )
    assert report["import"] == []
    assert report["help"] == []
    assert report["code"] in (0, None)


def test_what_a_fit_seldom_needs_is_not_loaded_for_it(tmp_path: Path) -> None:
    (tmp_path / "run.csv").write_text("u,y\n1,2\n3,4\n", encoding="utf-8")
    report = loaded_by(
        "from pathlib import Path\nimport orthaug.commands.fit, orthaug.fitting.estimation, "
        "orthaug.analysis.diagnosis\nimport orthaug.analysis.free_run_stability, "
        "orthaug.analysis.validation\nfrom orthaug.data.tables import read_table\n"
        f"report['rows'] = len(read_table(Path({str(tmp_path / 'run.csv')!r}), ('u', "
        "'y')).columns['u'])\nreport['loaded'] = [n for n in ('pandas', 'optax', "
        "'scipy.optimize', 'scipy.stats') if n in sys.modules]"
    )
    assert report == {"rows": 2, "loaded": []}


def test_reading_a_spec_and_its_data_does_not_load_jax() -> None:
    names = [n for n in FILES if room_of(n) in ("data", "physics")] + [
        "commands.opening",
        "commands.run",
    ]
    report = loaded_by(
        "import importlib\n"
        f"for name in {names!r}:\n"
        "    importlib.import_module('orthaug.' + name)\n"
        "    if 'jax' in sys.modules:\n"
        "        report['first'] = name\n"
        "        break"
    )
    assert report == {}, f"importing orthaug.{report.get('first')} loads jax"


@pytest.mark.parametrize("room", ["", *ROOMS])
def test_every_name_of_a_face_is_there(room: str) -> None:
    face = importlib.import_module(f"orthaug.{room}" if room else "orthaug")
    for name in getattr(face, "__all__", ()):
        assert getattr(face, name) is not None
    if not room:
        assert set(orthaug.__all__) >= {"estimate", "Record", "Baseline", "load", "synthetic"}


def _imported(path: Path) -> Iterator[tuple[str, str]]:
    """Modules and names of orthaug that a program imports."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "orthaug":
            yield from ((node.module or "", alias.name) for alias in node.names)


@pytest.mark.parametrize("folder", ["benchmarks", "examples"])
def test_programs_beside_the_package_import_what_is_there(folder: str) -> None:
    """Most of them run by command only."""
    for path in sorted((SOURCE.parents[1] / folder).glob("*.py")):
        for module, name in _imported(path):
            found = importlib.import_module(module)
            assert hasattr(found, name) or importlib.import_module(f"{module}.{name}"), (
                path.name,
                module,
                name,
            )
