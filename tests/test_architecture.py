"""The house rules that a machine can check: layers, forbidden names, sizes, and what an import may load."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

SOURCE = Path(__file__).resolve().parents[1] / "src" / "orthaug"

# Lowest first; a module imports only from those that stand before it. A new file gets its place here.
LAYERS = (
    "errors",
    "_jax",
    "_arrays",
    "expressions",
    "record",
    "regressors",
    "baseline",
    "projection",
    "excitation",
    "problem",
    "suspects",
    "bias",
    "signals",
    "measures",
    "metrics",
    "learners",
    "predictor",
    "gram",
    "criteria",
    "segments",
    "pasts",
    "structures",
    "solvers.levenberg_marquardt",
    "solvers.adam_lbfgs",
    "solvers.output_error",
    "solvers",
    "covariance",
    "training",
    "simulation",
    "ensemble",
    "parallel",
    "physics",
    "physical",
    "residuals",
    "model",
    "uncertainty",
    "splitting",
    "stability",
    "result",
    "conclusion",
    "estimation",
    "diagnosis",
    "validation",
    "design",
    "synthetic",
    "variables",
    "tables",
    "readers",
    "folders",
    "storage",
    "plots",
    "study",
    "studies.entry",
    "studies.common",
    "studies.static_errors",
    "studies.data_length",
    "studies.static_noise",
    "studies.covariance",
    "studies.consistency",
    "studies.regularization_weight",
    "studies.coverage",
    "studies.solver_times",
    "studies.theory",
    "studies",
    "reproduction",
    "spec",
    "suspicion",
    "jobs",
    "report",
    "outcome",
    "compare",
    "designing",
    "runs",
    "demo",
    "cli",
    "",  # orthaug/__init__.py
)
ORDER = {name: i for i, name in enumerate(LAYERS)}
FILES_AND_FACES = LAYERS[ORDER["variables"] :]  # from here on modules know files or the user
NUMERICAL = LAYERS[: ORDER["variables"]]
NOT_NUMERICAL = ("matplotlib", "typer", "rich", "pydantic", "pandas.io")
ONLY_IN = {"matplotlib": {"plots", "studies.common"}, "typer": {"cli"}}
UNSAFE_MODULES = ("pickle", "cPickle", "_pickle", "cloudpickle", "dill", "joblib", "marshal", "shelve")
UNSAFE_CALLS = ("eval", "exec", "read_pickle", "to_pickle")
WITHOUT_JAX = (
    "expressions",
    "record",
    "regressors",
    "baseline",
    "projection",
    "excitation",
    "problem",
    "tables",
    "readers",
    "folders",
    "spec",
    "jobs",
    "runs",
)
MOST_LINES, MOST_FUNCTION_LINES = 450, 80


def module_name(path: Path) -> str:
    """`orthaug/solvers/exact.py` is `solvers.exact`, a package is its folder, orthaug itself is ''."""
    parts = path.relative_to(SOURCE).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


FILES = {module_name(path): path for path in sorted(SOURCE.rglob("*.py"))}
TREES = {name: ast.parse(path.read_text(encoding="utf-8")) for name, path in FILES.items()}


def run_time_nodes(node: ast.AST) -> Iterator[ast.AST]:
    """Every node below `node` except the bodies of `if TYPE_CHECKING:`."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.If) and ast.unparse(child.test) in ("TYPE_CHECKING", "typing.TYPE_CHECKING"):
            for other in child.orelse:
                yield other
                yield from run_time_nodes(other)
        else:
            yield child
            yield from run_time_nodes(child)


def imports_of(name: str, tree: ast.AST, is_package: bool) -> Iterator[tuple[int, str]]:
    """(line, dotted name) of everything imported at run time, relative imports made absolute.

    `from a import b` yields `a.b`, so that a submodule and a name in a module look alike.
    """
    package = ["orthaug", *(name.split(".") if name else [])]
    for node in run_time_nodes(tree):
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
            elif name:  # the root loads its names by a table, on first use
                yield node.lineno, "a computed name"


def called(node: ast.Call) -> str:
    """The last name of what is called: `print` for `print(…)`, `eval` for `frame.eval(…)`."""
    function = node.func
    return function.id if isinstance(function, ast.Name) else getattr(function, "attr", "")


def layer_of(imported: str) -> str | None:
    """The module of orthaug that `imported` (a module, or a name in one) loads; None for other packages.

    The version is None too: the root is there before any of its modules and imports none of them at run time.
    """
    head, _, rest = imported.partition(".")
    if head != "orthaug" or rest == "__version__":
        return None
    while rest and rest not in ORDER and rest not in FILES:
        rest = rest.rpartition(".")[0]
    return rest


def within(imported: str, package: str) -> bool:
    return imported == package or imported.startswith(package + ".")


def external_imports(name: str) -> list[tuple[int, str]]:
    return list(imports_of(name, TREES[name], FILES[name].name == "__init__.py"))


def breaches(name: str, tree: ast.AST, is_package: bool = False) -> list[str]:
    """Imports of `name` that do not point downwards."""
    found = []
    for line, imported in imports_of(name, tree, is_package):
        if imported == "a computed name":
            found.append(f"line {line} imports a computed name, which no one can check")
        layer = layer_of(imported)
        if layer is not None and ORDER.get(layer, len(LAYERS)) >= ORDER[name]:
            found.append(f"line {line} imports {imported}, which is not below {name or 'orthaug'}")
    return found


@pytest.mark.parametrize("name", FILES)
def test_every_module_has_its_layer(name: str) -> None:
    assert name in ORDER, f"{FILES[name]} has no place in LAYERS; put it above everything that it imports."


@pytest.mark.parametrize("name", [name for name in FILES if name in ORDER])
def test_imports_point_downwards(name: str) -> None:
    assert breaches(name, TREES[name], FILES[name].name == "__init__.py") == []


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("gram", "from orthaug.model import Model"),
        ("gram", "import orthaug.model"),
        ("gram", "from orthaug import model"),
        ("gram", "from orthaug import estimation"),
        ("gram", "import orthaug"),
        ("gram", "from .model import Model"),
        ("gram", "from . import model"),
        ("gram", "def f():\n    from orthaug.cli import main"),
        ("gram", "import importlib\nimportlib.import_module('orthaug.cli')"),
        ("gram", "import importlib\nimportlib.import_module(name)"),
        ("gram", "if TYPE_CHECKING:\n    pass\nelse:\n    from orthaug.cli import main"),
        ("solvers.levenberg_marquardt", "from orthaug.solvers import LevenbergMarquardt"),
        ("solvers.levenberg_marquardt", "from ..model import Model"),
    ],
)
def test_an_upward_import_is_seen(name: str, text: str) -> None:
    assert len(breaches(name, ast.parse(text))) == 1


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("gram", "import numpy\nfrom orthaug._jax import jnp"),
        ("gram", "from . import _jax"),
        ("gram", "from orthaug import __version__"),
        ("gram", "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from orthaug.model import Model"),
        ("solvers.levenberg_marquardt", "from ..criteria import Normal"),
    ],
)
def test_a_downward_import_is_let_pass(name: str, text: str) -> None:
    assert breaches(name, ast.parse(text)) == []


@pytest.mark.parametrize("name", [name for name in NUMERICAL if name in FILES])
def test_numerical_modules_know_no_files_and_no_faces(name: str) -> None:
    imported = external_imports(name)
    foreign = [f"line {line}: {what}" for line, what in imported if any(within(what, p) for p in NOT_NUMERICAL)]
    own = [f"line {line}: {what}" for line, what in imported if layer_of(what) in FILES_AND_FACES]
    assert foreign + own == []


@pytest.mark.parametrize("package", ONLY_IN)
def test_one_module_imports_it(package: str) -> None:
    users = {name for name in FILES if any(within(what, package) for _, what in external_imports(name))}
    assert users <= ONLY_IN[package]


@pytest.mark.parametrize("name", FILES)
def test_nothing_prints_or_runs_text_as_code(name: str) -> None:
    found = [
        f"line {line}: {what}"
        for line, what in external_imports(name)
        if any(within(what, module) for module in UNSAFE_MODULES)
    ]
    for node in ast.walk(TREES[name]):
        if isinstance(node, ast.Call):
            verb = called(node)
            if verb in UNSAFE_CALLS or (verb == "print" and isinstance(node.func, ast.Name) and name != "cli"):
                found.append(f"line {node.lineno}: {verb}(…)")
            if any(keyword.arg == "allow_pickle" and not is_false(keyword.value) for keyword in node.keywords):
                found.append(f"line {node.lineno}: allow_pickle")
        elif isinstance(node, ast.ExceptHandler) and node.type is None:
            found.append(f"line {node.lineno}: a bare except")
    assert found == []


def is_false(node: ast.expr) -> bool:
    return isinstance(node, ast.Constant) and node.value is False


@pytest.mark.parametrize("name", FILES)
def test_files_and_functions_are_short(name: str) -> None:
    lines = len(FILES[name].read_text(encoding="utf-8").splitlines())
    assert lines <= MOST_LINES, f"{FILES[name]} has {lines} lines: there are two concepts in it."
    for node in ast.walk(TREES[name]):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            length = (node.end_lineno or node.lineno) - node.lineno + 1
            assert length <= MOST_FUNCTION_LINES, f"{node.name} has {length} lines: there are two functions in it."


def loaded_by(code: str) -> dict[str, object]:
    """What `code` leaves in the dictionary `report`, run in an interpreter of its own."""
    program = f"import json, sys\nreport = {{}}\n{code}\nprint('\\n' + json.dumps(report))"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def test_the_import_and_the_help_page_load_nothing_heavy() -> None:
    report = loaded_by(
        "HEAVY = ('jax', 'pandas', 'matplotlib')\n"
        "import orthaug\n"
        "report['import'] = [name for name in HEAVY if name in sys.modules]\n"
        "from orthaug.cli import main\n"
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


def test_reading_a_spec_and_its_data_does_not_load_jax() -> None:
    report = loaded_by(
        "import importlib\n"
        f"for name in {WITHOUT_JAX!r}:\n"
        "    importlib.import_module('orthaug.' + name)\n"
        "    if 'jax' in sys.modules:\n"
        "        report['first'] = name\n"
        "        break"
    )
    assert report == {}, f"importing orthaug.{report.get('first')} loads jax"
