"""The verb `export`: a folder with the code of a model, its test vectors and how to run it.

The folder is written whole or not at all.
"""

from __future__ import annotations

import keyword
import os
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from orthaug import __version__
from orthaug._base.checks import Vector, check_type, nearest
from orthaug._base.errors import InputError, show
from orthaug._base.folders import check_replaceable, whole_folder
from orthaug._base.jax import Array, jax
from orthaug.export.kinds import TARGETS, VECTORS, Target
from orthaug.export.lowering import program_of
from orthaug.export.program import WRITTEN, Program, Signal, Vectors
from orthaug.models import storage
from orthaug.models.model import HoldsModel, Model, model_of
from orthaug.physics.source_kinds import SOURCES
from orthaug.physics.sources import FileSource

_LONGEST = 40  # characters of a name, which is put in front of others
_TAKEN = (
    "check",
    "numpy",
    "casadi",
    "math",
    "main",
    "real",
    "int",
    "double",
    "float",
    "void",
    "char",
    "control",
    "onnx",
)


_ROWS, _SEED = 64, 0  # of the test vectors
_INSIDE = 0.7  # of the half-width of a feature, at which a run of them begins
_HELD = 8  # rows of each level: under a new one in every row an inertia hardly moves


def check_target(to: str) -> str:
    """Return `to` if it is a target.

    Raises:
        InputError: none of that name; the nearest is named.
    """
    if isinstance(to, str) and to not in TARGETS and to not in source_targets():
        TARGETS.discover()
    known = (*TARGETS, *source_targets())
    if not isinstance(to, str) or to not in known:
        hint = nearest(to, known) if isinstance(to, str) else ""
        raise InputError(f"no export to {show(to)}{hint}; known are {', '.join(known)}.")
    return to


def check_export(to: str, folder: Path, name: str = "model", *, force: bool = False) -> None:
    """Raise InputError early where there is no such target, name or place."""
    check_target(to)
    plain = (
        isinstance(name, str)
        and re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name)
        and len(name) <= _LONGEST
    )
    if not plain or keyword.iskeyword(name) or name in _TAKEN:
        raise InputError(
            f"{show(name)} cannot name the exported code; use ASCII letters, digits and "
            f"underscores, at most {_LONGEST}, starting with a letter, and no word of a "
            "language or library."
        )
    check_replaceable(folder, force=force)


def export(
    model: Model | HoldsModel,
    folder: str | Path,
    to: str,
    *,
    name: str = "model",
    force: bool = False,
) -> Program | None:
    """Write a model as code that needs no orthaug, and return the program that was written.

    Targets of a source, such as fmu-parameters, write estimates, and no program.

    Args:
        model: what to write; of a fit its model.
        folder: a new one, or one that holds an export.
        to: c, casadi, control, fmu, numpy, onnx or latex; of a source fmu-parameters or mjcf.
        name: is put in front of the functions in C, and names the files.
        force: replace the folder whatever it holds.

    Raises:
        InputError: an unknown target, a model that has no code (a Python function, an ensemble, a
            spline hold), or a folder that cannot be written.

    Examples:
        >>> import tempfile
        >>> import numpy as np
        >>> import orthaug as oa
        >>> record = oa.Record.from_arrays(u=np.sin(np.arange(50.0)), y=2 * np.sin(np.arange(50.0)))
        >>> physics = oa.Baseline.from_terms([oa.Term("gain", "u[k]")])
        >>> fit = oa.estimate(record, physics, learner=None)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = export(fit, Path(folder, "code"), to="c", name="plant")
        ...     sorted(file.name for file in Path(folder, "code").iterdir())
        ['README.md', 'check.c', 'manifest.json', 'plant.c', 'plant.h', 'vectors.csv']
    """
    model = model_of(model)
    check_type(folder, str | os.PathLike, "folder", "a folder's name")
    _check_order(folder, to)
    folder = Path(folder)
    check_export(to, folder, name, force=force)
    if to not in TARGETS:
        write_back(model, folder, to, force=force)
        return None
    target: Target = TARGETS[to]()
    digest, in_loop = storage.digest(model), model.plant is not model
    model = model.plant
    program = program_of(model, name, digest)
    if program.scheme is not None and program.scheme.kind not in WRITTEN:
        raise InputError(
            f"the integrator '{program.scheme.kind}' cannot be written as code; known are "
            f"{', '.join(WRITTEN)}. `model.step` and `oa.numpy_step` take any integrator."
        )
    vectors = _vectors_of(model, program)
    files = dict(target.files(program, vectors))
    files |= {
        VECTORS: vectors.csv(program),
        "README.md": _readme(program, target, len(vectors.outputs), in_loop=in_loop),
    }
    with whole_folder(folder, force=force) as partial:
        for file, content in files.items():
            (partial / file).write_bytes(
                content if isinstance(content, bytes) else content.encode("utf-8")
            )
    return program


def _check_order(folder: Any, to: Any) -> None:
    """Raise InputError where the folder and the target are exchanged."""
    if to not in TARGETS and str(folder) in TARGETS:
        raise InputError(
            "the folder comes before the target: write "
            f"`export(model, {show(to)}, {show(str(folder))})`."
        )


def _readme(program: Program, target: Target, rows: int, *, in_loop: bool) -> str:
    state = "What the state holds at a sample k:" if program.scheme is None else "The state:"
    hold = ""
    if program.scheme is not None and program.scheme.kind != "discrete" and program.inputs:
        hold = "\nInputs are held from one sample to the next.\n"
        if program.ends == 2:
            hold = (
                "\nInputs run straight from one sample to the next, so that a step takes those "
                "of the next sample too. It can be made when the next inputs are known.\n"
            )
    if in_loop:
        hold += "\nIt is the plant: the controller that it was fitted with is no part of it.\n"
    prepared = _of_prepared(program)
    return f"""# {program.name}

A step of a fitted model, {target.summary}. Written by orthaug {__version__}.

Model sha256: `{program.digest}` (`checksum` in `model.json`)

{prepared}Sampling time: {program.sampling_time:.9g} s.
A step takes the inputs of one sample and gives its outputs.

{_list_signals("Inputs, in order:", program.inputs)}
{_list_signals("Outputs:", program.outputs)}
{_list_signals(state, program.states)}{hold}
## Use

{target.usage(program)}

## Test vectors

`{VECTORS}` has {rows} steps of a free run of the model in double precision.
Each row has the inputs, the state before the step and the
outputs. Each row can be checked by itself.
"""


def _of_prepared(program: Program) -> str:
    if not program.preparation:
        return ""
    return (
        f"**The model was fitted to prepared data: {program.preparation}.** Inputs and outputs "
        "here are data after these steps. What a `shift` delays comes late by as much; after "
        "`detrend` they are deviations.\n\n"
    )


def _list_signals(head: str, signals: Sequence[Signal]) -> str:
    lines = [f"- `{signal.name}`{f' [{signal.unit}]' if signal.unit else ''}" for signal in signals]
    return "\n".join([head, "", *(lines or ["- none"]), ""])


def _vectors_of(model: Model, program: Program) -> Vectors:
    """Return a free run under random levels of the inputs.

    The levels are in the range that the model was trained on, where that is known.

    Of the starts it takes the one from which the outputs stay finite for longest.
    """
    rng = np.random.default_rng(_SEED)
    middle, reach = _range(model, program)
    drawn = middle + reach * np.repeat(
        rng.uniform(-1, 1, (_ROWS // _HELD, program.held)), _HELD, axis=0
    )
    inputs = (
        drawn if program.ends == 1 else np.concatenate([drawn, np.roll(drawn, -1, axis=0)], axis=1)
    )

    def run(state: Array, rows: Array) -> Any:
        def one(state: Array, row: Array) -> Any:
            following, y = model.step(state, row)
            return following, (state, y)

        return jax.lax.scan(one, state, rows)[1]

    run, found = jax.jit(run), []
    for start in _starts(model, program):
        states, outputs = map(np.asarray, run(start, inputs))
        finite = np.asarray(np.isfinite(np.concatenate([states, outputs], axis=1)).all(axis=1))
        count = finite.size if finite.all() else int(np.argmin(finite))
        found.append(Vectors(inputs[:count], states[:count], outputs[:count]))
    return max(found, key=lambda vectors: len(vectors.outputs))  # the first of equal ones


def _starts(model: Model, program: Program) -> Iterator[np.ndarray]:
    """Return initial states: within and in the middle of the learner's features, zero, one."""
    zero, numbers = np.zeros(len(program.states)), model.numbers
    names = [entry.text.partition("[")[0] for entry in model.form.entries]
    own = [signal.name.partition("[")[0] for signal in program.states]
    centres, widths = (
        dict(zip(names, map(float, values), strict=True))
        for values in (numbers.centre, numbers.halfwidth)
    )
    middle, reach = (np.array([one.get(name, 0.0) for name in own]) for one in (centres, widths))
    yield middle + _INSIDE * reach
    yield middle
    yield zero
    yield zero + 1


def _range(model: Model, program: Program) -> tuple[Vector, Vector]:
    """Return middle and half width of each input in the learner's features; 0 and 1 elsewhere."""
    middle, reach = np.zeros(program.held), np.ones(program.held)
    entries = model.form.entries
    names = [signal.name for signal in program.inputs[: program.held]]
    for entry, centre, width in zip(
        entries, model.numbers.centre, model.numbers.halfwidth, strict=True
    ):
        name = entry.text.partition("[")[0]
        if name in names and (
            entry.text == name or str(entry.lags[0] if entry.lags else "") == entry.text
        ):
            middle[names.index(name)], reach[names.index(name)] = float(centre), float(width)
    return middle, reach


def source_targets() -> tuple[str, ...]:
    """Return the targets of all sources that can write estimates back."""
    found = (getattr(source, "target", "") for source in SOURCES.values())
    return tuple(target for target in found if target)


def write_back(model: Model, folder: Path, to: str, *, force: bool = False) -> None:
    """Write the estimates into a folder, as the program takes them whose file has the physics.

    What a learner adds is not among them.

    Raises:
        InputError: a model whose physics are not of the kind that the target is for.
    """
    motion: Any = getattr(model.form, "motion", None)
    source: Any = getattr(motion, "source", None)
    if not isinstance(source, FileSource) or source.target != to:
        own = f"; its own is {source.target}" if isinstance(source, FileSource) else ""
        raise InputError(f"the physics do not come from a file that {to} writes{own}.")
    values = np.asarray(motion.coordinates.physical(np.asarray(model.numbers.theta))).tolist()
    units = {parameter.name: parameter.unit for parameter in motion.parameters}
    files = source.write_back(dict(zip(motion.names, values, strict=True)), units)
    with whole_folder(folder, force=force) as partial:
        for name, content in files.items():
            (partial / name).write_text(content, encoding="utf-8")
