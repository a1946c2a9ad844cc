"""Commands on saved models: simulate, predict, split, explain, export, linearize, track."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from orthaug._base.checks import check_count
from orthaug.commands import streams
from orthaug.commands.program import (
    AsJson,
    Columns,
    DataPath,
    Every,
    Force,
    Initial,
    Missing,
    ModelPath,
    OutFile,
    Prepare,
    Rows,
    Which,
    app,
    missing_cells,
    out_folder,
    prepare_jax,
    print_result,
)

if TYPE_CHECKING:
    from orthaug.commands.run import ModelOnData, ReadOptions
    from orthaug.models.response import Response


@app.command(epilog="Example: orthaug simulate result run.csv --out simulated.csv")
def simulate(
    model: ModelPath,
    data: DataPath,
    out: OutFile = None,
    initial: Initial = None,
    missing: Missing = "error",
    rows: Rows = None,
    every: Every = 1,
    column: Columns = None,
    prepare: Prepare = None,
    which: Which = "fitted",
    force: Force = False,
) -> None:
    """Simulate a saved model in free run on a data file."""
    from orthaug.commands import run
    from orthaug.commands.folder import check_file, chosen_model

    model = chosen_model(model, which)
    reading = run.ReadOptions.of(missing, rows, every, column or (), prepare)
    if initial is None and _written_long(model, data, reading, out, force, free=True):
        return
    opened = run.open_run(model, data, reading=reading)
    start = run.read_initial(initial, opened)
    check_file(out, model, data, Path(initial or data), force=force)
    prepare_jax()
    response = opened.model.simulate(opened.record, initial=start)
    _write_response(response, opened, out, force, run.notes(opened, initial))


@app.command(epilog="Example: orthaug predict result run.csv --horizon 10 --out predicted.csv")
def predict(
    model: ModelPath,
    data: DataPath,
    horizon: Annotated[int, typer.Option("--horizon", metavar="H", help="Steps ahead.")] = 1,
    out: OutFile = None,
    initial: Initial = None,
    observer: Annotated[
        bool,
        typer.Option(
            "--observer",
            help="Start from an estimated state, with 95 % bands; outputs may be missing.",
        ),
    ] = False,
    missing: Missing = "error",
    rows: Rows = None,
    every: Every = 1,
    column: Columns = None,
    prepare: Prepare = None,
    which: Which = "fitted",
    force: Force = False,
) -> None:
    """Predict a data file with a saved model, some steps ahead."""
    from orthaug.commands import run
    from orthaug.commands.folder import check_file, chosen_model

    model = chosen_model(model, which)
    reading = run.ReadOptions.of(missing, rows, every, column or (), prepare)
    plain = horizon == 1 and initial is None and not observer
    if plain and _written_long(model, data, reading, out, force, free=False):
        return
    opened = run.open_ahead(model, data, reading, horizon, initial, observer=observer)
    check_file(out, model, data, Path(initial or data), force=force)
    prepare_jax()
    if observer:
        response, notes = run.observe_outputs(opened, horizon)
    else:
        response, notes = opened.model.predict(opened.record, horizon=horizon), []
    _write_response(response, opened, out, force, [*opened.notes, *notes])


@app.command(epilog="Example: orthaug split result train.csv --measure symmetrized")
def split(
    model: ModelPath,
    data: Annotated[
        list[Path],
        typer.Argument(metavar="DATA...", help="The files that the model was trained on."),
    ],
    measure: Annotated[
        str,
        typer.Option(
            "--measure",
            metavar="KIND",
            help="training, symmetrized, uniform, samples or weighted; `kind` in the spec's "
            "[structure.measure].",
        ),
    ] = "training",
    rows: Annotated[
        str | None,
        typer.Option(
            "--rows", metavar="A:B", help="Rows of each file, half-open.", show_default="all"
        ),
    ] = None,
    box: Annotated[
        list[str] | None,
        typer.Option(
            "--box",
            metavar="LAG=LOW:HIGH",
            help="Limits of the uniform measure.",
            show_default="the range of the data",
        ),
    ] = None,
    samples: Annotated[
        str | None,
        typer.Option(
            "--samples", metavar="FILE", help="Points, a column per lag.", show_default="none"
        ),
    ] = None,
    weights: Annotated[
        str | None,
        typer.Option(
            "--weights",
            metavar="FILE",
            help="A column `weight`, a row per row of DATA.",
            show_default="none",
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Split the parameters of a saved model by another measure.

    The model is not trained again.
    """
    from orthaug.commands import split as splitting
    from orthaug.commands.run import read_rows
    from orthaug.reports.text import split_text

    opened = splitting.open_training(model, data, read_rows(rows))
    given = {
        "box": box or [],
        "samples": [samples] if samples else [],
        "weights": [weights] if weights else [],
    }
    chosen = splitting.read_measure(measure, given, opened)
    prepare_jax()
    for line in opened.notes:
        streams.say(line)
    result = splitting.split_model(opened, chosen)
    print_result(result, split_text(result), as_json)


@app.command(epilog="Example: orthaug explain result train.csv --degree 2")
def explain(
    model: ModelPath,
    data: Annotated[
        list[Path],
        typer.Argument(metavar="DATA...", help="Data files, best those of the training."),
    ],
    degree: Annotated[
        int,
        typer.Option(
            "--degree", metavar="D", help="Highest degree of products of the learner's inputs."
        ),
    ] = 3,
    functions: Annotated[
        list[str] | None,
        typer.Option(
            "--function",
            metavar="NAME",
            help="Function in products, such as abs; may be repeated.",
            show_default="none",
        ),
    ] = None,
    most: Annotated[int, typer.Option("--terms", metavar="N", help="Terms at most.")] = 6,
    missing: Annotated[str | None, missing_cells("as in training, otherwise keep or skip")] = None,
    rows: Rows = None,
    as_json: AsJson = False,
) -> None:
    """Explain which terms the learner of a saved model has found.

    And print what to write into the physics.
    """
    check_count(degree, "--degree", of="factors")
    check_count(most, "--terms", of="terms")
    from orthaug.commands.run import explain_model, explain_notes, open_explained, read_rows
    from orthaug.reports.explanation import explain_text

    opened = open_explained(model, data, read_rows(rows), missing)
    prepare_jax()
    for line in opened.notes:
        streams.say(line)
    result = explain_model(opened, degree=degree, functions=functions or (), most=most)
    for line in explain_notes(model) if result.spec else ():
        streams.say(line)
    print_result(result, explain_text(result), as_json)


@app.command(epilog="Example: orthaug export result --to c --out code")
def export(
    model: ModelPath,
    to: Annotated[
        str,
        typer.Option(
            "--to",
            metavar="TARGET",
            help="c, casadi, control, fmu, numpy, onnx, latex, fmu-parameters or mjcf.",
        ),
    ],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the code.")],
    name: Annotated[
        str, typer.Option("--name", metavar="NAME", help="Name of files and functions.")
    ] = "model",
    which: Which = "fitted",
    force: Force = False,
) -> None:
    """Export a saved model as code that needs no orthaug."""
    from orthaug.commands import export as exporting
    from orthaug.commands.folder import chosen_model

    model = chosen_model(model, which)
    exporting.check(model, to, out, name, force=force)
    prepare_jax()
    for line in exporting.run(model, to, out, name, force=force):
        streams.say(line)
    streams.echo(f"written to {out}")


@app.command(epilog="Example: orthaug linearize result --at 'force = 2' --out linear")
def linearize(
    model: ModelPath,
    at: Annotated[
        str | None,
        typer.Option(
            "--at",
            metavar="'NAME=VALUE, …'",
            help="Held inputs; outputs or states to fix.",
            show_default="inputs at 0",
        ),
    ] = None,
    data: Annotated[
        Path | None,
        typer.Option(
            "--data",
            metavar="DATA|SPEC",
            help="Measured data to compare with.",
            show_default="none",
        ),
    ] = None,
    continuous: Annotated[
        str,
        typer.Option(
            "--continuous", metavar="zoh|tustin", help="How to convert to continuous time."
        ),
    ] = "zoh",
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            metavar="DIR|FILE",
            help="Folder; or a .json, .png, .pdf or .svg.",
            show_default="none",
        ),
    ] = None,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Linearize a saved model: operating points, poles and gains.

    All with intervals, and the frequency response.
    """
    from orthaug.commands import linearize as linearizing

    linearizing.check_place(out, model, *([data] if data else []), force=force)
    opened, record, notes = linearizing.open_linear(model, data)
    prepare_jax()
    for line in notes:
        streams.say(line)
    from orthaug.analysis.linearization import linearize as linearized

    found = linearized(opened, at, record, continuous=continuous)
    if out is not None:
        linearizing.write(found, out, force=force)
    streams.echo(linearizing.output_text(found, as_json=as_json))
    if out is not None and not as_json:
        streams.echo(f"\nwritten to {out}")


@app.command(epilog="Example: orthaug track result --data new.csv --training train.csv")
def track(
    model: ModelPath,
    data: Annotated[
        list[Path] | None,
        typer.Option(
            "--data",
            metavar="FILE",
            help="New data, with a gap between files; may be repeated.",
            show_default="none",
        ),
    ] = None,
    training: Annotated[
        list[Path] | None,
        typer.Option(
            "--training",
            metavar="FILE",
            help="The files that the model was trained on.",
            show_default="those of --state",
        ),
    ] = None,
    rows: Annotated[
        str | None,
        typer.Option(
            "--rows", metavar="A:B", help="Rows of each training file.", show_default="all"
        ),
    ] = None,
    forgetting: Annotated[
        float | None,
        typer.Option(
            "--forgetting",
            metavar="λ",
            help="Weight of a row relative to the next one.",
            show_default="1",
        ),
    ] = None,
    memory: Annotated[
        float | None,
        typer.Option(
            "--memory",
            metavar="S",
            help="The same as a time in seconds.",
            show_default="without end",
        ),
    ] = None,
    state: Annotated[
        Path | None,
        typer.Option(
            "--state",
            metavar="DIR",
            help="Result of an earlier run, to continue from.",
            show_default="none",
        ),
    ] = None,
    follows: Annotated[
        bool,
        typer.Option(
            "--follows", help="The new data follow on the state's last row without a gap."
        ),
    ] = False,
    out: Annotated[Path | None, out_folder("orthaug-out/track")] = None,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Track the parameters of a saved model over new data.

    It uses recursive least squares with forgetting.
    """
    from orthaug.commands import track as tracking
    from orthaug.commands.folder import check_folder, check_kept
    from orthaug.commands.run import read_rows
    from orthaug.reports.tracking import track_text

    folder = out or Path("orthaug-out/track")
    check_folder(folder, force=force)
    check_kept(folder, *(data or ()), *(training or ()), model)
    opened = tracking.open_track(model, data or (), training or (), read_rows(rows), state)
    prepare_jax()
    for line in opened.notes:
        streams.say(line)
    tracked = tracking.track(
        opened, forgetting=forgetting, memory=memory, state=state, follows=follows
    )
    text = track_text(tracked.result)
    tracking.write_tracked(tracked, folder, text, force=force)
    print_result(tracked.result, text, as_json, folder)


def _written_long(
    model: Path, data: Path, reading: ReadOptions, out: Path | None, force: bool, *, free: bool
) -> bool:
    """Return whether the file is one that is read piece by piece.

    Its table is then written piece by piece.
    """
    from orthaug.commands import long_run
    from orthaug.commands.folder import check_file
    from orthaug.commands.run import prepared_notes
    from orthaug.reports.text import scores_text

    run = long_run.long_run(model, data, reading, free=free)
    if run is None:
        return False
    check_file(out, model, data, force=force)
    prepare_jax()
    scored, warnings = long_run.write(run, out, force=force)
    for line in (*prepared_notes(run.model), *(f"warning: {warning.text}" for warning in warnings)):
        streams.say(line)
    say = streams.say if out is None else streams.echo
    if scored is not None:
        say(scores_text(scored, run.model.outputs, None if free else 1))
    if out is not None:
        streams.echo(f"written to {out}")
    return True


def _write_response(
    response: Response,
    opened: ModelOnData,
    out: Path | None,
    force: bool,
    notes: Sequence[str] = (),
) -> None:
    """Write the CSV, and print scores where the CSV does not go."""
    from orthaug.commands import run
    from orthaug.reports.text import response_text

    for line in (*notes, *(f"warning: {warning.text}" for warning in run.warnings(response))):
        streams.say(line)
    run.write_csv(response, opened, out, force=force)
    scores = response_text(response)
    if scores:
        (streams.say if out is None else streams.echo)(scores)
    if out is not None:
        streams.echo(f"written to {out}")
