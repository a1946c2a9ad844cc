"""The command line: arguments in, text out. Results go to standard output, progress and errors to standard error."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from orthaug._base.checks import check_choice
from orthaug._base.errors import TrainingError
from orthaug.commands import streams
from orthaug.commands.bars import study_bars, training_bar
from orthaug.commands.program import (
    AsJson,
    DataPath,
    Force,
    Initial,
    ModelPath,
    OutFile,
    OutFolder,
    SpecPath,
    app,
    main,
)

if TYPE_CHECKING:
    from orthaug.models.response import Response

__all__ = ["main"]


@app.command()
def demo(out: OutFolder = None, force: Force = False) -> None:
    """Fit the paper's example and compare with the truth."""
    from orthaug.commands.folder import check_folder

    folder = out or Path("orthaug-out/demo")
    check_folder(folder, force=force)
    _prepare_jax()
    from orthaug.commands import demo as demonstration

    with training_bar(2 * demonstration.RESTARTS, demonstration.ITERATIONS) as progress:
        text = demonstration.run(folder, progress, force=force)
    streams.echo(text)
    streams.echo(f"\nwritten to {folder}")


@app.command()
def check(
    spec: SpecPath,
    as_json: AsJson = False,
    figure: Annotated[Path | None, typer.Option("--figure", metavar="PNG", help="Heat map of the biases.")] = None,
    force: Force = False,
) -> None:
    """Report excitation and identifiability; trains nothing."""
    from orthaug.commands.check import check_job, refusal, write_figure
    from orthaug.commands.folder import check_figure
    from orthaug.commands.opening import open_job
    from orthaug.reports.text import check_text

    job = open_job(spec, require_full_rank=False)
    check_figure(figure, *job.files, force=force)
    if job.spec.motion is not None:  # its runs are computed
        _prepare_jax()
    result = check_job(job)
    streams.echo(result.to_json() if as_json else check_text(result))
    if figure is not None and result.bias:
        write_figure(result.bias, figure, force=force)
    refused = refusal(job, result)
    if refused is not None:
        raise type(refused)(f"{spec}: {refused}")


@app.command()
def fit(spec: SpecPath, out: OutFolder = None, as_json: AsJson = False, force: Force = False) -> None:
    """Fit a spec, print a summary and write the result folder."""
    from orthaug.commands.fit import fit_job, write_result
    from orthaug.commands.folder import check_folder, check_inputs_kept
    from orthaug.commands.opening import open_job
    from orthaug.reports.text import fit_text

    folder = out or Path("orthaug-out") / spec.stem
    check_folder(folder, force=force)
    job = open_job(spec)
    check_inputs_kept(job, folder)
    _prepare_jax()
    with training_bar(job.run_count, job.iterations, job.spec.declared_learner() is not None) as progress:
        fitted = fit_job(job, progress)
    write_result(fitted, folder, force=force)
    if as_json:
        streams.echo(fitted.result.to_json())
    else:
        streams.echo(fit_text(fitted.fit, fitted.result))
        streams.echo(f"\nwritten to {folder}")
    if not fitted.fit.status.ok:
        raise TrainingError(f"{fitted.fit.status.message}. The account is in {folder / 'result.json'}.")


@app.command()
def compare(
    spec: SpecPath,
    out: OutFolder = None,
    model: Annotated[
        list[Path] | None, typer.Option("--model", metavar="MODEL", help="A saved model to put beside; any number.")
    ] = None,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Physics alone and every structure, one table."""
    from orthaug.commands.folder import check_folder, check_inputs_kept
    from orthaug.commands.opening import open_job
    from orthaug.reports.text import compare_text

    folder = out or Path("orthaug-out") / spec.stem
    check_folder(folder, force=force)
    job = open_job(spec)
    check_inputs_kept(job, folder, model or ())
    _prepare_jax()
    from orthaug.commands import compare as comparing

    with training_bar(job.run_count * len(job.compared), job.iterations) as progress:
        comparison = comparing.compare(job, model or (), progress)
    comparing.write(comparison, folder, force=force)
    text = compare_text(comparison.result, comparison.verdicts)
    streams.echo(comparison.result.to_json() if as_json else f"{text}\n\nwritten to {folder}")


@app.command()
def simulate(
    model: ModelPath,
    data: DataPath,
    out: OutFile = None,
    initial: Initial = None,
    force: Force = False,
) -> None:
    """Free run of a saved model on a data file."""
    from orthaug.commands import run
    from orthaug.commands.folder import check_file

    opened = run.open_run(model, data)
    start = run.read_initial(initial, opened)
    check_file(out, model, data, Path(initial or data), force=force)
    _prepare_jax()
    _write_response(opened.model.simulate(opened.record, initial=start), out, force, run.notes(opened, initial))


@app.command()
def predict(
    model: ModelPath,
    data: DataPath,
    horizon: Annotated[int, typer.Option("--horizon", metavar="H", help="Steps ahead.")] = 1,
    out: OutFile = None,
    initial: Initial = None,
    force: Force = False,
) -> None:
    """H-step-ahead prediction of a saved model."""
    from orthaug.commands import run
    from orthaug.commands.folder import check_file

    opened = run.open_run(model, data, need_outputs=True)
    record = run.with_initial(opened, run.read_initial(initial, opened))
    check_file(out, model, data, Path(initial or data), force=force)
    _prepare_jax()
    _write_response(opened.model.predict(record, horizon=horizon), out, force)


@app.command()
def split(
    model: ModelPath,
    data: Annotated[list[Path], typer.Argument(metavar="DATA…", help="The files that the model was trained on.")],
    measure: Annotated[
        str, typer.Option("--measure", metavar="KIND", help="As `kind` in the spec's [structure.measure].")
    ] = "training",
    rows: Annotated[str | None, typer.Option("--rows", metavar="A:B", help="Rows of each file, half-open.")] = None,
    box: Annotated[
        list[str] | None, typer.Option("--box", metavar="LAG=LOW:HIGH", help="Limits of the uniform measure.")
    ] = None,
    samples: Annotated[str | None, typer.Option("--samples", metavar="FILE", help="Points, a column per lag.")] = None,
    weights: Annotated[
        str | None, typer.Option("--weights", metavar="FILE", help="A column `weight`, a row per row of DATA.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Parameters of a saved model under another measure, without training again."""
    from orthaug.commands import split as splitting
    from orthaug.commands.measure_options import read_measure, split_place
    from orthaug.reports.text import split_text

    opened = splitting.open_training(model, data, splitting.read_rows(rows))
    given = {"box": box or [], "samples": [samples] if samples else [], "weights": [weights] if weights else []}
    chosen = read_measure(measure, given, split_place(opened.model, opened.record))
    _prepare_jax()
    result = splitting.split_model(opened, chosen)
    streams.echo(result.to_json() if as_json else split_text(result))


@app.command()
def explain(
    model: ModelPath,
    data: DataPath,
    degree: Annotated[int, typer.Option("--degree", metavar="D", help="Of products of what the learner sees.")] = 3,
    functions: Annotated[
        list[str] | None, typer.Option("--function", metavar="NAME", help="In products, such as abs; any number.")
    ] = None,
    most: Annotated[int, typer.Option("--terms", metavar="N", help="Terms at most.")] = 6,
    as_json: AsJson = False,
) -> None:
    """Which terms the learner of a saved model has found, and what to write into the physics."""
    from orthaug.commands.explain import explain_model
    from orthaug.commands.run import open_run
    from orthaug.reports.explanation_text import explain_text

    opened = open_run(model, data)
    _prepare_jax()
    result = explain_model(opened, degree=degree, functions=functions or (), most=most)
    streams.echo(result.to_json() if as_json else explain_text(result))


@app.command()
def export(
    model: ModelPath,
    to: Annotated[str, typer.Option("--to", metavar="TARGET", help="c, casadi, control, fmu, numpy, onnx or latex.")],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the code.")],
    name: Annotated[str, typer.Option("--name", help="Of files and functions.")] = "model",
    force: Force = False,
) -> None:
    """A saved model as code that needs no orthaug."""
    from orthaug.commands import export as exporting

    exporting.check(model, to, out, name, force=force)
    _prepare_jax()
    exporting.run(model, to, out, name, force=force)
    streams.echo(f"written to {out}")


@app.command()
def track(
    model: ModelPath,
    data: Annotated[
        list[Path] | None, typer.Option("--data", metavar="FILE", help="New data; any number, a gap between them.")
    ] = None,
    training: Annotated[
        list[Path] | None, typer.Option("--training", metavar="FILE", help="The files that the model was trained on.")
    ] = None,
    rows: Annotated[str | None, typer.Option("--rows", metavar="A:B", help="Rows of each training file.")] = None,
    forgetting: Annotated[
        float | None, typer.Option("--forgetting", metavar="λ", help="Weight of a row against the next one.")
    ] = None,
    memory: Annotated[float | None, typer.Option("--memory", metavar="S", help="The same in seconds.")] = None,
    state: Annotated[
        Path | None, typer.Option("--state", metavar="DIR", help="Result of an earlier run, to go on from.")
    ] = None,
    follows: Annotated[
        bool, typer.Option("--follows", help="The new data follow on the state's last row without a gap.")
    ] = False,
    out: OutFolder = None,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Parameters of a saved model over new data by recursive least squares, with an alarm."""
    from orthaug.commands import track as tracking
    from orthaug.commands.folder import check_folder, check_kept
    from orthaug.commands.split import read_rows
    from orthaug.reports.tracking import track_text

    folder = out or Path("orthaug-out/track")
    check_folder(folder, force=force)
    check_kept(folder, *(data or ()), *(training or ()), model)
    opened = tracking.open_track(model, data or (), training or (), read_rows(rows), state)
    _prepare_jax()
    tracked = tracking.track(opened, forgetting=forgetting, memory=memory, state=state, follows=follows)
    text = track_text(tracked.result)
    tracking.write_tracked(tracked, folder, text, force=force)
    streams.echo(tracked.result.to_json() if as_json else f"{text}\n\nwritten to {folder}")


@app.command()
def design(
    spec: SpecPath,
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="CSV file for the input.")],
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """An input within limits under which suspected terms and noise disturb the parameters least."""
    from orthaug.commands import design as designing
    from orthaug.commands.folder import check_file
    from orthaug.commands.opening import open_job
    from orthaug.reports.result import DesignResult
    from orthaug.reports.text import design_text

    job = open_job(spec, require_full_rank=False)
    check_file(out, *job.files, force=force)
    designed = designing.design_for(job)
    designing.write(job, designed, out, force=force)
    result = DesignResult.of(designed)
    streams.echo(result.to_json() if as_json else f"{design_text(result)}\n\nwritten to {out}")


@app.command()
def select(spec: SpecPath, out: OutFolder = None, as_json: AsJson = False, force: Force = False) -> None:
    """Choose orders, delay and terms (or a network's width and inputs), and write a spec with the choice."""
    from orthaug.commands.bars import selection_bar
    from orthaug.commands.folder import check_folder, check_inputs_kept
    from orthaug.commands.select import open_select, select_for, steps_at_most, write_selected
    from orthaug.reports.selection import selection_text

    folder = out or Path("orthaug-out") / f"{spec.stem}-selected"
    check_folder(folder, force=force)
    job, given = open_select(spec)
    check_inputs_kept(job, folder)
    _prepare_jax()
    with selection_bar(steps_at_most(given.selection.terms)) as told:
        selected = select_for(job, given, folder, told)
    write_selected(selected, folder, force=force)
    if as_json:
        streams.echo(selected.result.to_json())
    else:
        streams.echo(selection_text(selected.result))
        streams.echo(f"\nwritten to {folder}; next: orthaug fit {folder / 'spec.toml'}")


@app.command()
def schema(
    command: Annotated[
        str, typer.Argument(metavar="[COMMAND]", help="fit, check, compare, split, design, select, explain or track.")
    ] = "fit",
) -> None:
    """The JSON schema of what a command writes."""
    from orthaug.reports.schemas import RESULTS, schema_of

    streams.echo(_json(schema_of(check_choice(command, RESULTS, "COMMAND"))))


@app.command()
def reproduce(
    name: Annotated[str | None, typer.Argument(metavar="[NAME]", help="One study; all without it.")] = None,
    out: OutFolder = None,
    pipeline: Annotated[
        str, typer.Option("--pipeline", metavar="ours|paper|scripts", help="Who trains; scripts: as published.")
    ] = "ours",
    small: Annotated[bool, typer.Option("--small", help="The reduced size that the tests run.")] = False,
    force: Force = False,
) -> None:
    """The paper's figures and tables, each number beside the published one; goes on where it was interrupted."""
    from orthaug.studies import reproduction

    folder = out or Path("orthaug-out/reproduction")
    reproduction.check_output(folder, force=force)
    entries = reproduction.chosen(name)
    check_choice(pipeline, reproduction.PIPELINES, "--pipeline")
    _prepare_jax()
    with study_bars() as progress:
        reproduced = reproduction.reproduce(entries, pipeline=pipeline, small=small, progress=progress)
    reproduction.write(reproduced, folder, pipeline, force=force)
    streams.echo(f"{reproduction.text(reproduced)}\n\nwritten to {folder}/index.html")


def _prepare_jax() -> None:
    from orthaug._base.jax import use_compilation_cache

    use_compilation_cache()


def _write_response(response: Response, out: Path | None, force: bool, notes: Sequence[str] = ()) -> None:
    """The CSV and what is to say about it: scores go where the CSV does not."""
    from orthaug.commands import run
    from orthaug.reports.text import response_text

    for line in (*notes, *(f"warning: {warning.text}" for warning in run.warnings(response))):
        streams.say(line)
    run.write_csv(response, out, force=force)
    told = response_text(response)
    if told:
        (streams.say if out is None else streams.echo)(told)
    if out is not None:
        streams.echo(f"written to {out}")


def _json(content: Any) -> str:
    return json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False)
