"""What is packaged: one version, one list of dependencies, recipes and workflows that can be read."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import yaml
from test_cli import run

import orthaug

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
CONDA_NAMES = {"matplotlib": "matplotlib-base"}
BROUGHT = {"jaxlib": "jax"}  # pinned along with the package that brings it


def text(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


def recipe() -> dict:
    return yaml.safe_load(text("packaging/conda/recipe.yaml"))


def bounds(requirements: list[str]) -> dict[str, str]:
    """What is allowed of each package, by its name in small letters."""
    split = (re.fullmatch(r"([A-Za-z0-9_.-]+?)\s*([<>=].*)", entry) for entry in requirements)
    return {match[1].lower(): match[2] for match in split if match}


def test_the_version_stands_in_one_place():
    assert PROJECT["project"]["dynamic"] == ["version"] and "version" not in PROJECT["project"]
    assert PROJECT["tool"]["hatch"]["version"]["path"] == "src/orthaug/__init__.py"
    found = {
        "citation": yaml.safe_load(text("CITATION.cff"))["version"],
        "recipe": recipe()["context"]["version"],
        "changelog": re.search(r"^## \[(.+?)\]", text("CHANGELOG.md"), re.MULTILINE)[1],
    }
    assert found == dict.fromkeys(found, orthaug.__version__)


def test_the_recipe_asks_for_what_the_package_asks_for():
    wanted = {
        CONDA_NAMES.get(name, name): what
        for name, what in bounds(PROJECT["project"]["dependencies"]).items()
    }
    given = bounds(recipe()["requirements"]["run"])
    assert given.pop("python") == ">=${{ python_min }}"
    assert given == wanted
    assert f">={recipe()['context']['python_min']}" == PROJECT["project"]["requires-python"]
    (build,) = PROJECT["build-system"]["requires"]
    assert bounds(recipe()["requirements"]["host"])["hatchling"] == bounds([build])["hatchling"]
    entry = f"orthaug = {PROJECT['project']['scripts']['orthaug']}"
    assert recipe()["build"]["python"]["entry_points"] == [entry]


def test_the_oldest_dependencies_are_the_lower_bounds():
    lines = [line.partition(";")[0].strip() for line in text("packaging/oldest.txt").splitlines()]
    pins = dict.fromkeys(line for line in lines if line and not line.startswith("#"))
    oldest: dict[str, list[str]] = {}
    for pin in pins:
        name, _, version = pin.partition("==")
        oldest.setdefault(name.lower(), []).append(version)
    for name, what in bounds(PROJECT["project"]["dependencies"]).items():
        padded = {tuple(map(int, version.split("."))) for version in oldest.pop(name)}
        low = tuple(map(int, re.match(r">=([\d.]+)", what)[1].split(".")))
        assert min(padded)[: len(low)] == low and not any(min(padded)[len(low) :]), name
    assert set(oldest) <= set(BROUGHT)


def test_constraints_name_every_dependency():
    pinned = {
        line.partition("==")[0].lower().replace("_", "-")
        for line in text("constraints.txt").splitlines()
    }
    extras = PROJECT["project"]["optional-dependencies"]
    asked = [
        *PROJECT["project"]["dependencies"],
        *(entry for group in extras.values() for entry in group),
    ]
    names = {
        re.match(r"[A-Za-z0-9_.-]+", entry)[0].lower().replace("_", "-") for entry in asked
    } - {"orthaug"}
    assert names <= pinned


def test_the_workflow_tries_every_python_on_every_system():
    workflow = yaml.safe_load(text(".github/workflows/test.yml"))
    matrix = workflow["jobs"]["wheel"]["strategy"]["matrix"]
    assert {name.partition("-")[0] for name in matrix["os"]} == {"ubuntu", "macos", "windows"}
    named = {
        c.rpartition(" ")[2] for c in PROJECT["project"]["classifiers"] if re.search(r"3\.\d+$", c)
    }
    assert set(matrix["python"]) == named
    steps = [step.get("run", "") for job in workflow["jobs"].values() for step in job["steps"]]
    files = re.findall(r"(?:packaging|tests)/[\w./]+|\.ci/run", " ".join(steps))
    assert files and all((ROOT / file).is_file() for file in files)


def test_the_container_copies_what_is_there():
    copied = re.findall(r"^COPY (?!--from)(.+) \S+$", text("packaging/Containerfile"), re.MULTILINE)
    names = [name for line in copied for name in line.split()]
    assert {"pyproject.toml", "src"} <= set(names) and all((ROOT / name).exists() for name in names)


def test_the_wheel_carries_the_text_of_every_key():
    wheel = PROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]
    assert wheel["force-include"] == {"docs/spec.md": "orthaug/commands/spec.md"}
    found = [
        line for line in text("docs/spec.md").rstrip().split("\n") if not line.startswith("<!--")
    ]
    keys = run("schema", "keys").out.rstrip()
    assert keys.split("\n") == found  # which init's specs and the app point at
    properties = json.loads(run("schema", "spec").out)["properties"]
    assert {"data", "baseline", "motion", "learner", "structure", "training"} <= set(properties)
    assert {name for name in properties if f"## [{name}]" not in keys.replace("[[", "[")} == set()


@pytest.mark.parametrize("page", ["docs/start.md", "docs/install.md"])
def test_every_extra_is_reported(page):
    extras = set(PROJECT["project"]["optional-dependencies"]) - {"dev"}
    names = set(
        re.findall(
            r"`(\w+)`",
            text(page).partition("xtra")[2].partition("\n\n[")[0].partition("\nWhere an extra")[0],
        )
    )
    assert extras <= names


def test_the_image_sees_what_it_copies():
    kept = [line[1:] for line in text(".dockerignore").splitlines() if line.startswith("!")]
    (line,) = [
        line
        for line in text("packaging/Containerfile").splitlines()
        if line.startswith("COPY pyproject")
    ]
    assert {*line.split()[1:-1], "packaging/about.md", "docs/spec.md", "src"} == set(kept)


def test_the_suite_runs_on_the_python_that_is_set_up():
    suite = yaml.safe_load(text(".github/workflows/test.yml"))["jobs"]["suite"]["steps"]
    (python,) = [
        step["with"]["python-version"] for step in suite if "python-version" in step.get("with", {})
    ]
    (pythons,) = [step["env"]["PYTHONS"] for step in suite if step.get("run") == ".ci/run"]
    assert pythons == f"python{python}" and re.search(
        r"^PYTHONS \?= ", text("Makefile"), re.MULTILINE
    )


def test_lines_end_alike_on_every_system():
    assert text(".gitattributes").startswith("* text=auto eol=lf\n")


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion(shell, tmp_path):
    words = {
        "COMP_WORDS": "orthaug fit --r",
        "COMP_CWORD": "2",
        "_TYPER_COMPLETE_ARGS": "orthaug fit --r",
    }
    homes = dict.fromkeys(("HOME", "USERPROFILE"), str(tmp_path))
    system = {
        name: os.environ[name] for name in ("SYSTEMROOT",) if name in os.environ
    }  # Windows starts none without
    settings = {"PATH": "", "PYTHONPATH": str(ROOT / "src"), **homes, **system, **words}
    settings |= {
        "_ORTHAUG_COMPLETE": f"complete_{shell}",
        "_TYPER_COMPLETE_FISH_ACTION": "get-args",
    }
    command = [sys.executable, "-m", "orthaug"]
    done = subprocess.run(
        command, env=settings, capture_output=True, text=True, timeout=60, check=False
    )
    assert "--resume" in done.stdout and done.stderr == ""
