"""Seeded hostile runs: forged models, wrong arguments, spoilt states, folders of others, and exports of hostile names.

Each trial ends as those of `fuzzing.py`: "refused", "equal", or a fault in words.
"""

from __future__ import annotations

import contextlib
import io
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
from fuzzing import _json_changed, mutated, refusal_or, signals

WORDS = (
    *(
        "fit",
        "check",
        "init",
        "simulate",
        "predict",
        "explain",
        "split",
        "export",
        "compare",
        "select",
        "design",
    ),
    *(
        "linearize",
        "track",
        "schema",
        "keys",
        "model",
        "run.csv",
        "spec.toml",
        "out",
        "nowhere",
        "--out",
        "--to",
    ),
    *(
        "c",
        "numpy",
        "latex",
        "--json",
        "--force",
        "--rows",
        "1:5",
        "5:1",
        "--every",
        "0",
        "-1",
        "nan",
        "--column",
    ),
    *(
        "y=u",
        "y=",
        "--initial",
        "zero",
        "x",
        "--missing",
        "skip",
        "--model",
        "physics",
        "--observer",
        "--horizon",
    ),
    *(
        "",
        "\u00e9",
        "--",
        "-",
        "--nonsense",
        "9" * 30,
        "/",
        ".",
        "..",
        "\u202e",
        "' ; rm",
        "--name",
        "1a",
    ),
)
NOT_RUN = {
    "fit",
    "compare",
    "select",
    "app",
    "demo",
    "reproduce",
}  # they train, or serve, where the arguments are right
LETTERS = (
    *"ab_{}\\~^%&#$|<>\"`'*/;\n\0\u00e9\u03b8\u2028",
    "*/",
    "\\input{x}",
    "^^5c",
    '"""',
    "{{",
    "%s",
    "<script>",
)


def try_forged(seed: int, original: dict[str, bytes], folder: Path) -> str:
    """One change of a declaration, or of the arrays, with the checksums made right: refused, or a model that runs."""
    import orthaug as oa
    from orthaug.models import storage

    rng = np.random.default_rng([300, seed])
    for name, content in original.items():
        (folder / name).write_bytes(content)
    place, numbers = folder / "model.json", folder / "arrays.safetensors"
    declared, arrays = storage.read_packed(place, numbers, storage.FORMAT, "model", "")
    if seed % 3:
        changed = _json_changed({k: v for k, v in declared.items() if k != "arrays_sha256"}, rng)
        declared = changed if isinstance(changed, dict) else {}
    else:
        name = sorted(arrays)[rng.integers(len(arrays))]
        values = np.array(arrays[name])
        arrays[name] = (
            np.full_like(values, np.nan),
            np.full_like(values, np.inf),
            values[..., None],
            np.zeros(0),
            values.ravel()[:1],
            -values,
        )[rng.integers(6)]
    said = {k: v for k, v in declared.items() if k not in ("format", "orthaug", "arrays_sha256")}
    storage.write_packed(storage.pack(storage.FORMAT, said, arrays), place, numbers)
    u, y = signals()

    def judge() -> str:
        model = storage.load(folder)
        record = oa.Record.from_arrays(
            u, y, inputs=[c.name for c in model.inputs], outputs=[c.name for c in model.outputs]
        )
        repr(model)
        model.simulate(record)
        model.predict(record)
        return "equal"

    return refusal_or(judge)


def try_command(seed: int, folder: Path) -> str:
    """A line of words that are seldom right: an exit code and one line, never a traceback."""
    from orthaug.commands import cli

    rng = np.random.default_rng([400, seed])
    words = [WORDS[i] for i in rng.integers(len(WORDS), size=rng.integers(1, 7))]
    if NOT_RUN & {words[0]} and "spec.toml" in words:
        words[0] = "check"
    out, err = io.StringIO(), io.StringIO()

    def judge() -> str:
        code = None
        with contextlib.ExitStack() as stack:
            stack.enter_context(patch.object(sys, "argv", ["orthaug", *words]))
            for context in (
                contextlib.chdir(folder),
                contextlib.redirect_stdout(out),
                contextlib.redirect_stderr(err),
            ):
                stack.enter_context(context)
            try:
                cli.main()
            except SystemExit as stop:
                code = stop.code
        text = err.getvalue()
        if "Traceback" in text or code not in (0, 1, 2):
            return f"exit {code}: {words} {text}"[:300]
        return "equal" if code == 0 else "refused" if text.strip() else f"not a word: {words}"

    return refusal_or(judge)


def try_state(seed: int, folder: Path) -> str:
    """A state of training that was spoilt is dropped, and said; one that was not comes back as it was."""
    import jax

    from orthaug.fitting.checkpoints import OF_DESCENT, Checkpoints

    rng = np.random.default_rng([500, seed])
    shutil.rmtree(folder / "kept", ignore_errors=True)
    checkpoints = Checkpoints(folder / "kept", "fuzz", every=0.0)
    kept = checkpoints.of_run("x", form=OF_DESCENT)
    form = jax.tree.structure(OF_DESCENT)
    leaves = [rng.normal(size=rng.integers(1, 5)) for _ in range(form.num_leaves)]
    state = jax.tree.unflatten(form, leaves)
    kept.keep(state)
    content = kept.path.read_bytes()
    kept.path.write_bytes(content if seed % 10 == 0 else mutated(content, rng))
    same = kept.path.read_bytes() == content

    def judge() -> str:
        found = kept.state()
        if found is None:
            return "refused" if checkpoints.spoilt and not same else "a sound state was dropped"
        held = jax.tree.leaves(found)
        return (
            "equal"
            if same and all(map(np.array_equal, held, leaves))
            else "a spoilt state was taken"
        )

    return refusal_or(judge)


def try_folder(seed: int, folder: Path) -> str:
    """What someone wrote, changed or added in a folder is there afterwards, unless it was forced."""
    from orthaug._base.folders import whole_folder

    rng = np.random.default_rng([600, seed])
    place = folder / "result"
    shutil.rmtree(place, ignore_errors=True)
    with whole_folder(place) as partial:
        (partial / "result.json").write_text('{"schema": 1, "orthaug": "0"}')
        (partial / "model").mkdir()
        (partial / "model" / "model.json").write_text("{}")
    names = (
        "result.json",
        "model/model.json",
        "manifest.json",
        "train.csv",
        "spec.toml",
        "figures/a.png",
        "report.html",
    )
    own: dict[Path, bytes] = {}
    for _ in range(rng.integers(0, 4)):
        path = place / names[rng.integers(len(names))]
        path.parent.mkdir(exist_ok=True)
        if path.exists() and rng.random() < 0.3:
            path.unlink()
            own.pop(path, None)
        else:
            path.write_bytes(own.setdefault(path, rng.bytes(8)))
    kept = {path: content for path, content in own.items() if path.name != "manifest.json"}

    def judge() -> str:
        with whole_folder(place) as partial:
            (partial / "result.json").write_text("new")
        return "a file of someone was replaced" if kept else "equal"

    end = refusal_or(judge)
    lost = [
        path.name
        for path, content in kept.items()
        if not path.exists() or path.read_bytes() != content
    ]
    return f"lost {lost}" if lost else end


def try_export(seed: int, model, folder: Path) -> str:
    """A model with hostile units as code: refused, or text that compiles as Python and closes what it opens in TeX."""
    import orthaug as oa

    rng = np.random.default_rng([700, seed])
    unit = "".join(LETTERS[i] for i in rng.integers(len(LETTERS), size=rng.integers(1, 8)))
    target = ("numpy", "latex", "c")[seed % 3]

    def judge() -> str:
        baseline = model.form.baseline
        parameters = (replace(baseline.parameters[0], unit=unit), *baseline.parameters[1:])
        form = replace(model.form, baseline=replace(baseline, parameters=parameters))
        oa.export(replace(model, form=form), folder / "code", target, force=True)
        return _safe(target, folder / "code")

    return refusal_or(judge)


def _safe(target: str, code: Path) -> str:
    if target == "numpy":
        for path in code.glob("*.py"):
            compile(path.read_text(encoding="utf-8"), path.name, "exec")
    elif target == "latex":
        text = (code / "model.tex").read_text(encoding="utf-8")
        rows = text[text.index(r"\begin{tabular}") : text.index(r"\end{tabular}")].splitlines()[1:]
        for row in rows:
            plain = row.replace(r"\{", "").replace(r"\}", "")
            if (
                plain.count("{") != plain.count("}")
                or r"\input" in row
                or row.count(r" & ") < 2
                or "^^" in row
            ):
                return f"not text: {row!r}"
    else:
        for path in code.glob("*.[ch]"):
            for line in path.read_text(encoding="utf-8").splitlines():
                if line.startswith("static const real") and "/*" in line and line.count("*/") != 1:
                    return f"not a comment: {line!r}"
    return "equal"


def model_of(folder: Path) -> tuple[dict[str, bytes], object]:
    """The files of a small fitted model, and the model."""
    from fuzzing import model_files

    import orthaug as oa

    content = model_files(folder)
    return content, oa.load(folder)
