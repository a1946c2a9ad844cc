"""What every command prints in a terminal of 80 and of 100 columns, against the texts in tests/golden/terminal.

Words, lines and columns are compared: a number stands for any other, since test_golden.py holds the numbers, and some are
times. `python tests/test_golden_terminal.py` writes the texts anew (`-k fit` one of them). Read the diff, at both
widths, before a commit.
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from test_cli import run

from orthaug._base.lines import fit_screen
from orthaug.commands import program, streams

FOLDER = Path(__file__).parent / "golden" / "terminal"
WIDTHS = (80, 100)
BOX = '--box "y[k-1]=-1:1" --box "u[k-1]=-0.5:0.5"'
COMMANDS = {
    "init": "init run.csv --inputs u --outputs y --out first.toml --force",
    "check": "check plant.toml",
    "fit": "fit plant.toml --out again --force",
    "compare": "compare plant.toml --out structures --force",
    "compare_results": "compare result other --out beside --force",
    "select": "select plant.toml --out selected --force",
    "design": "design plant.toml --out input.csv --force",
    "recover": "recover plant.toml --out rehearsal --draws 2 --choices 1 --force",
    "simulate": "simulate result steps.csv --out simulated.csv --force",
    "predict": "predict result steps.csv --horizon 5 --out predicted.csv --force",
    "split": f"split result run.csv --measure uniform {BOX}",
    "explain": "explain result run.csv",
    "linearize": "linearize result --at u=0.2",
    "track": "track result --data steps.csv --training run.csv --memory 4",
    "export": "export result --to c --out code --force",
    "schema": "schema error",
    "benchmark": "benchmark --list",
    "demo": "demo --help",
    "app": "app --help",
    "reproduce": "reproduce --help",
}
"""A line for every command; those that serve a page or run for minutes show their help. `schema` prints JSON."""
NUMBER = re.compile(r"[-+−]?\d+(\.\d+)?(e[-+]?\d+)?")


def layout(text: str) -> str:
    """Return a text with 0 for every number, and columns two blanks apart."""
    return re.sub(r" {2,}", "  ", NUMBER.sub("0", text))


def printed(line: str) -> str:
    """Return what a command prints at both widths, each under its prompt."""
    shown = ""
    with pytest.MonkeyPatch.context() as patch:
        for width in WIDTHS:
            patch.setenv("COLUMNS", str(width))
            streams.prepare()
            done = run(*shlex.split(line))
            assert done.code == 0, done.err
            wide = [row for row in done.out.splitlines() if len(row) > width]
            assert not wide or line.startswith("schema"), wide
            shown += f"[{width} columns] $ orthaug {line}\n{done.out.rstrip()}\n\n"
    fit_screen(0)
    return shown


@pytest.fixture(scope="module")
def fitted(golden_records: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a spec and two results; only folders that a command writes come to it."""
    folder = tmp_path_factory.mktemp("terminal")
    for name in ("run.csv", "steps.csv"):
        shutil.copy(golden_records / name, folder)
    spec = (FOLDER / "plant.toml").read_text(encoding="utf-8")
    alone = spec.replace("hidden = [1]", 'kind = "none"')
    for name, text in (("plant", spec), ("alone", alone)):
        (folder / f"{name}.toml").write_text(text, encoding="utf-8")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for name, out in (("plant", "result"), ("alone", "other")):
            done = run("fit", f"{name}.toml", "--out", out)
            assert done.code == 0, done.err
    return folder


def test_every_command_is_shown():
    shown = {line.split()[0] for line in COMMANDS.values()}
    assert shown == {name for names in program.GROUPS.values() for name in names}


@pytest.mark.parametrize("name", COMMANDS)
@pytest.mark.usefixtures("without_figures")
def test_what_a_command_prints(fitted, name, monkeypatch):
    monkeypatch.chdir(fitted)
    file, found = FOLDER / f"{name}.txt", printed(COMMANDS[name])
    if os.environ.get("GOLDEN") == "write":
        file.write_text(found, encoding="utf-8")
    kept = file.read_text(encoding="utf-8")
    assert layout(found).splitlines() == layout(kept).splitlines()


if __name__ == "__main__":
    whole = [sys.executable, "-m", "pytest", "-q", "-n", "0", __file__, *sys.argv[1:]]
    sys.exit(subprocess.call(whole, env={**os.environ, "GOLDEN": "write"}))
