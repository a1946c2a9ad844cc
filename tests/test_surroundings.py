"""The program in surroundings that do not suit it; benchmarks/surroundings.py tries more of them."""

from __future__ import annotations

import io
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from test_cli import SPEC, make_project, one_line, run

from orthaug import InputError
from orthaug._base.jax import ChecksummedCache
from orthaug.commands import streams
from orthaug.commands.folder import check_figure, check_folder

MAIN = "from orthaug.commands.entry import main; main()"


def shell(script: str, cwd: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """A script in which `$O` is the program."""
    command = ["bash", "-c", script.replace("$O", f"{sys.executable} -c '{MAIN}'")]
    settings = {**os.environ, **environment}
    return subprocess.run(
        command, cwd=cwd, env=settings, capture_output=True, text=True, timeout=120, check=False
    )


def test_the_user_s_settings_do_not_matter(tmp_path):
    make_project(tmp_path, SPEC.replace('"a"', '"θ"'))
    (tmp_path / "matplotlibrc").write_text(
        "text.usetex: true\nbanana: 1\nno colon\nlines.linewidth: x\n"
    )
    (tmp_path / "cache").touch()
    done = shell(
        "$O fit plant.toml --out out",
        tmp_path,
        MPLBACKEND="banana",
        PYTHONWARNINGS="error",
        PYTHONIOENCODING="latin-1",
        HOME=str(tmp_path / "cache"),
        JAX_COMPILATION_CACHE_DIR=str(tmp_path / "cache"),
        JAX_NUMPY_DTYPE_PROMOTION="strict",
        JAX_NUMPY_RANK_PROMOTION="raise",
        JAX_DEBUG_NANS="1",
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert (
        "\ntheta  " in done.stdout and (tmp_path / "out" / "figures" / "simulation.png").is_file()
    )
    assert list(json.loads((tmp_path / "out" / "manifest.json").read_text())) == [
        "orthaug",
        "files",
    ]


ENDS = [
    (
        "$O schema >/dev/full",
        "standard output: cannot be read or written (No space left on device)",
    ),
    ("$O schema >&-", "standard output"),
    ("$O fit absent.toml 2>&-", None),
    ("mkdir w; cd w; rmdir ../w; $O schema", "the working folder is gone"),
    ("ulimit -v 1500000; $O schema", "the memory limit (ulimit -v) is 1.43 GiB"),
]


@pytest.mark.parametrize(("script", "words"), ENDS, ids=[script for script, _ in ENDS])
def test_what_cannot_be_done_is_one_line_and_exit_code_2(tmp_path, script, words):
    done = shell(script, tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert one_line(done.stderr, "error: ", words) if words else not done.stderr
    assert not list(tmp_path.iterdir())


def ended_by(number, program, folder):
    """Send a signal to a program that has printed "ready"; its code, its errors, and how long it took, s."""
    process = subprocess.Popen(
        [sys.executable, "-c", program],
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        assert process.stdout is not None and process.stdout.readline() == "ready\n"
        began = time.monotonic()
        process.send_signal(number)
        _, err = process.communicate(timeout=60)
    finally:
        process.kill()
    return process.returncode, err, time.monotonic() - began


@pytest.mark.parametrize(
    ("number", "words"), [(signal.SIGINT, "interrupted"), (signal.SIGTERM, "terminated")]
)
def test_a_signal_while_a_folder_is_written(tmp_path, number, words):
    """It ends at once though the main thread takes no notice of it."""
    program = (
        "from pathlib import Path; import signal, time; from orthaug.commands.signals import "
        "WATCH\nsignal.signal(signal.SIGINT, signal.default_int_handler)  # children of a "
        "background job ignore it\nWATCH.start()\nfrom orthaug._base.folders import "
        "whole_folder\nwith whole_folder(Path('deep/out')) as partial:\n    (partial / "
        "'half').touch(); print('ready', flush=True)\n    while True:\n        try: "
        "time.sleep(100)\n        except BaseException: pass\n"
    )
    code, err, seconds = ended_by(number, program, tmp_path)
    assert seconds < 5
    assert (code, err) == (128 + number, f"{words}; nothing is written\n")
    assert not list(tmp_path.iterdir())


def test_a_signal_during_the_trials_leaves_the_finished_fit(tmp_path):
    make_project(tmp_path)
    program = (
        "import sys, time; import orthaug.commands.advice as advice\n"
        "def wait(*_):\n    print('ready', flush=True); time.sleep(100)\n"
        "advice.advise = wait\nsys.argv = ['orthaug', 'fit', 'plant.toml', '--out', 'out']\n"
        "from orthaug.commands.entry import main\nmain()\n"
    )
    code, err, _ = ended_by(signal.SIGTERM, program, tmp_path)
    assert code == 128 + signal.SIGTERM and "; out is written" in err
    result = json.loads((tmp_path / "out" / "result.json").read_text(encoding="utf-8"))
    assert result["parameters"] and result["advice"] == [] and result["advice_trials"] is None
    assert (tmp_path / "out" / "model").is_dir() and (tmp_path / "out" / "report.html").is_file()


# --- in this process


def test_a_model_is_not_lost_to_what_is_computed_from_it(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    make_project(tmp_path)
    assert run("fit", "plant.toml", "--out", "out").code == 0
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    for words, *arguments in (
        (
            "holds the model out",
            "compare",
            "plant.toml",
            "--model",
            "out",
            "--out",
            "out",
            "--force",
        ),
        (
            "is read by this run",
            "simulate",
            "out",
            "run.csv",
            "--out",
            "out/model/model.json",
            "--force",
        ),
        (
            "exists; give another name, or replace it with --force",
            "predict",
            "out",
            "run.csv",
            "--out",
            "steps.csv",
        ),
        ("expected .png, .pdf or .svg", "check", "plant.toml", "--figure", "x.xyz"),
        ("exists", "check", "plant.toml", "--figure", "out/figures/simulation.png"),
    ):
        done = run(*arguments)
        assert (done.code, done.out) == (2, "") and one_line(done.err, "error: ", words)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before
    assert run("simulate", "out", "run.csv", "--out", "steps.csv", "--force").code == 0
    assert Path("steps.csv").read_text().startswith("time,y,y_model")


def test_a_folder_with_the_two_keys_and_more_is_not_ours(tmp_path):
    (tmp_path / "result.json").write_text('{"schema": 2, "orthaug": "0.1.0"}')
    (tmp_path / "thesis.tex").touch()
    with pytest.raises(
        InputError,
        match="holds .* and no manifest.json which shows that orthaug wrote it; .* --force",
    ):
        check_folder(tmp_path)
    (tmp_path / "thesis.tex").unlink()
    (tmp_path / "result.json").write_text("[" * 100_000)
    with pytest.raises(InputError, match=r"holds result\.json"):
        check_folder(tmp_path)


@pytest.mark.parametrize("name", ["x.xyz", "x", "png"])
def test_figures_have_a_known_ending(name):
    with pytest.raises(
        InputError, match=f"{name}: found the ending '.*'; expected .png, .pdf or .svg"
    ):
        check_figure(Path(name))


@pytest.mark.parametrize(
    ("encoding", "text", "expected"),
    [
        ("ascii", "‖θ̂ − Φ‖ ± 1 …", b"||theta^ - Phi|| +- 1 ..."),
        ("latin-1", "θ ± é", b"theta \xb1 \xe9"),
        ("cp437", "‖θ‖ Θ ✗", b"||theta|| \xe9 \\u2717"),
        ("ascii", '{"θ": "𝛩"}', b'{"\\u03b8": "\\ud835\\udee9"}'),
    ],
)
def test_letters_that_an_encoding_lacks(encoding, text, expected):
    streams.prepare()
    buffer = io.BytesIO()
    stream = io.TextIOWrapper(buffer, encoding=encoding, errors="orthaug.plain")
    stream.write(text)
    stream.flush()
    assert buffer.getvalue() == expected


class Store(dict):
    """A cache as JAX makes one."""

    put = dict.__setitem__


def test_programs_that_were_exchanged_or_cut_are_not_used(tmp_path):
    store = Store()
    cache = ChecksummedCache(store, str(tmp_path))
    cache.put("one", b"first")
    cache.put("two", b"second")
    assert cache.get("one") == b"first" and cache.get("three") is None
    store["one"], store["two"] = store["two"], store["one"]
    (tmp_path / "one-cache").touch()
    assert cache.get("one") is None and cache.get("two") is None and not list(tmp_path.iterdir())
    for content in (b"", b"first", b"x" * 40):
        store["one"] = content
        assert cache.get("one") is None
