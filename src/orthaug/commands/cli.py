"""The command line: arguments in, text out.

Results go to standard output, progress and errors to standard error.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from orthaug._base.checks import check_choice
from orthaug._base.errors import TrainingError
from orthaug._base.lines import fold
from orthaug.commands import streams
from orthaug.commands.bars import GO_ON, on_terminal, study_bars, training_bar
from orthaug.commands.program import (
    AsJson,
    Force,
    OneFileCommand,
    SpecPath,
    app,
    arguments,
    main,
    other_writes,
    out_folder,
    prepare_jax,
    print_result,
)
from orthaug.commands.signals import WATCH

if TYPE_CHECKING:
    from orthaug.commands.fit import FitReport

__all__ = ["main"]
_LARGE = 20e6  # bytes of a data file from which on `init` reports its stage


@app.command(epilog="Example: orthaug demo --out first")
def demo(
    out: Annotated[Path | None, out_folder("orthaug-out/demo")] = None, force: Force = False
) -> None:
    """Fit the paper's example and compare with the truth."""
    from orthaug.commands.folder import check_folder

    folder = out or Path("orthaug-out/demo")
    check_folder(folder, force=force)
    prepare_jax()
    from orthaug.commands import demo as demonstration

    with training_bar(2 * demonstration.RESTARTS, demonstration.ITERATIONS) as progress:
        text = demonstration.run(folder, progress, force=force)
    streams.echo(text)
    streams.echo(f"\nwritten to {folder}")


@app.command(epilog="Example: orthaug check spec.toml")
def check(
    spec: SpecPath,
    as_json: AsJson = False,
    figure: Annotated[
        Path | None,
        typer.Option(
            "--figure", metavar="PNG", help="Heat map of the biases.", show_default="none"
        ),
    ] = None,
    force: Force = False,
) -> None:
    """Report excitation and identifiability; trains nothing."""
    from orthaug.commands.folder import check_figure, save_figure
    from orthaug.commands.job_result import check as check_job
    from orthaug.commands.opening import open_job
    from orthaug.reports.text import check_text

    job = open_job(spec, require_full_rank=False)
    check_figure(figure, *job.files, force=force)
    if job.physics.runs_in_check:
        prepare_jax()
    if note := job.physics.slow_note(job):
        streams.say(note)
    result = check_job(job)
    refused = job.physics.refusal(job, result)
    failure = None if refused is None else type(refused)(f"{spec}: {refused}")
    print_result(result, check_text(result), as_json, failure=failure)
    if figure is not None and result.bias:
        from orthaug.reports.finding_plots import bias_figure

        save_figure(bias_figure(result.bias), figure, force=force)
    if failure is not None:
        raise failure


@app.command(epilog="Example: orthaug fit spec.toml --out result")
def fit(
    spec: SpecPath,
    out: Annotated[Path | None, out_folder("orthaug-out/SPEC")] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Continue an earlier fit from its last state.")
    ] = False,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Fit a spec, print a summary and write the result folder."""
    from orthaug.commands.fit import fit_job, import_drawing, keep_states, write_result
    from orthaug.commands.folder import check_folder, check_inputs_kept
    from orthaug.commands.opening import open_job
    from orthaug.reports.text import fit_text

    folder = out or Path("orthaug-out") / spec.stem
    check_folder(folder, force=force)
    job = open_job(spec)
    check_inputs_kept(job, folder)
    prepare_jax()
    asked = arguments("fit", spec, out=out, resume=resume, json=as_json, force=force)
    job = replace(keep_states(job, folder, resume=resume), arguments=asked)
    learns, rows = job.spec.declared_learner() is not None, job.problem.count
    takes_a_while = learns or not job.problem.linear

    def keep_finished(finished: FitReport) -> None:
        WATCH.rescue = partial(write_result, finished, folder, force=force)

    with training_bar(job.run_count, job.iterations, takes_a_while, rows) as progress:
        before = WATCH.rescue
        import_drawing()
        fitted = fit_job(job, progress, keep_finished)
        WATCH.rescue = before
    if other_writes():
        return
    write_result(fitted, folder, force=force)
    failure = None
    if not fitted.fit.status.ok:
        failure = TrainingError(
            f"{fitted.result.status.message.removesuffix('.')}. The details are in "
            f"{folder / 'result.json'}."
        )
    text = fit_text(fitted.fit, fitted.result)
    print_result(fitted.result, text, as_json, folder, failure)
    if failure is not None:
        raise failure


@app.command(epilog="Example: orthaug compare spec.toml --out comparison")
def compare(
    what: Annotated[
        list[Path],
        typer.Argument(
            metavar="SPEC|RESULT...",
            help="A spec file, or the result folders of two fits or more.",
        ),
    ],
    out: Annotated[
        Path | None,
        out_folder(
            "orthaug-out/SPEC, or orthaug-out/SPEC-comparison beside a fit; of results "
            "orthaug-out/comparison"
        ),
    ] = None,
    model: Annotated[
        list[Path] | None,
        typer.Option(
            "--model",
            metavar="MODEL",
            help="A saved model to compare with a spec; may be repeated.",
            show_default="none",
        ),
    ] = None,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Compare physics alone and every structure, or saved results, in one table.

    Two saved results of the same data: orthaug compare result other-result
    """
    if len(what) > 1 or os.path.isdir(what[0]):
        _compare_results(what, out, model or [], as_json=as_json, force=force)
        return
    from orthaug.commands.folder import check_folder, check_inputs_kept
    from orthaug.commands.opening import open_job
    from orthaug.reports.text import compare_text

    spec = what[0]
    folder = out or _beside_fit(Path("orthaug-out") / spec.stem)
    check_folder(folder, force=force)
    job = open_job(spec)
    check_inputs_kept(job, folder, model or ())
    prepare_jax()
    from orthaug.commands import compare as comparing

    asked = arguments("compare", spec, out=out, model=model, json=as_json, force=force)
    job = replace(job, arguments=asked)
    with training_bar(job.run_count * len(job.compared), job.iterations) as progress:
        comparison = comparing.compare(job, model or (), progress)
    if other_writes():
        return
    comparing.write(comparison, folder, force=force)
    print_result(
        comparison.result, compare_text(comparison.result, comparison.verdicts), as_json, folder
    )


def _beside_fit(folder: Path) -> Path:
    """Return the folder, or one beside it where it holds the model of a fit."""
    kept = os.path.isdir(folder / "model")
    return folder.with_name(f"{folder.name}-comparison") if kept else folder


def _compare_results(
    results: list[Path], out: Path | None, model: list[Path], *, as_json: bool, force: bool
) -> None:
    """Compare saved results: nothing is trained."""
    from orthaug._base.errors import InputError
    from orthaug.commands.folder import check_folder, check_kept

    if model:
        raise InputError("--model: belongs to a spec; give its result folder among the others.")
    folder = out or Path("orthaug-out") / "comparison"
    check_folder(folder, force=force)
    check_kept(folder, *results)
    prepare_jax()
    from orthaug.commands import saved_results

    found = saved_results.read_results(results)
    asked = arguments("compare", *results, out=out, json=as_json, force=force)
    comparison = saved_results.compare_results(found, asked)
    saved_results.write(comparison, folder, force=force)
    print_result(comparison.result, comparison.summary(), as_json, folder)


@app.command(epilog="Example: orthaug design spec.toml --out input.csv")
def design(
    spec: SpecPath,
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="CSV file for the input.")],
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Design an input that biases the parameters least.

    [design] of the spec has the limits, suspected terms and noise.
    """
    from orthaug.commands import design as designing
    from orthaug.commands.folder import check_file
    from orthaug.commands.opening import open_job
    from orthaug.reports.result import DesignResult
    from orthaug.reports.text import design_text

    job = open_job(spec, require_full_rank=False)
    check_file(out, *job.files, force=force)
    designed = designing.design_for(job)
    designing.write(job, designed, out, force=force)
    for line in designing.notes(job):
        streams.say(line)
    result = DesignResult.of(designed)
    print_result(result, design_text(result), as_json, out)


@app.command(epilog="Example: orthaug recover spec.toml --draws 40")
def recover(
    spec: SpecPath,
    out: Annotated[Path | None, out_folder("orthaug-out/SPEC-recovery")] = None,
    draws: Annotated[
        int, typer.Option("--draws", metavar="N", help="Data sets to simulate and fit.")
    ] = 20,
    seed: Annotated[int, typer.Option("--seed", metavar="N", help="Of all random numbers.")] = 0,
    share: Annotated[
        float | None,
        typer.Option(
            "--share",
            metavar="S",
            help="Size of the planted term over that of the physics.",
            show_default="as the learner's",
        ),
    ] = None,
    terms: Annotated[
        str,
        typer.Option(
            "--terms",
            metavar="declared,usual,memory",
            help="Groups of planted terms: [[suspects]], the usual ones, one with memory.",
        ),
    ] = "declared,usual,memory",
    choices: Annotated[
        int | None,
        typer.Option(
            "--choices",
            metavar="N",
            help="Draws on which other choices are fitted too.",
            show_default="4",
        ),
    ] = None,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Rehearse the fit on simulated data with a known truth.

    An interrupted run continues where it stopped.
    """
    from orthaug.commands.folder import check_inputs_kept
    from orthaug.commands.opening import open_job
    from orthaug.commands.recover import Asked, DrawFolder, rehearse, write
    from orthaug.reports.recovery import recover_text

    groups = [word.strip() for word in terms.split(",") if word.strip()]
    asked = Asked(draws, seed, share, groups, choices)
    folder = out or Path("orthaug-out") / f"{spec.stem}-recovery"
    job = open_job(spec)
    check_inputs_kept(job, folder)
    draw_folder = DrawFolder(folder, force)
    draw_folder.check(job)
    prepare_jax()
    with study_bars() as progress:
        made = rehearse(job, asked, draw_folder, partial(progress, "rehearsal"), streams.say)
    write(made, folder)
    print_result(made.result, recover_text(made.result), as_json, folder)


@app.command(epilog="Example: orthaug select spec.toml --out selected")
def select(
    spec: SpecPath,
    out: Annotated[Path | None, out_folder("orthaug-out/SPEC-selected")] = None,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Choose orders, delay and terms, and write a spec with them.

    It can also choose a network's width and inputs: [selection] of the spec.
    """
    from orthaug.commands.bars import selection_bar
    from orthaug.commands.folder import check_folder, check_inputs_kept
    from orthaug.commands.select import open_select, select_for, steps_at_most, write_selected
    from orthaug.reports.selection import selection_text

    folder = out or Path("orthaug-out") / f"{spec.stem}-selected"
    check_folder(folder, force=force)
    job, given = open_select(spec)
    check_inputs_kept(job, folder)
    prepare_jax()
    with selection_bar(steps_at_most(given.selection.terms)) as report_model:
        selected = select_for(job, given, folder, report_model)
    write_selected(selected, folder, force=force)
    output = selected.job.train.record.outputs[0]
    place = f"{folder}\nnext: orthaug fit {folder / 'spec.toml'}"
    print_result(selected.result, selection_text(selected.result, output), as_json, place)


@app.command(
    cls=OneFileCommand, epilog="Example: orthaug init run.csv --inputs force --outputs position"
)
def init(
    data: Annotated[Path, typer.Argument(metavar="DATA", help="Data file.")],
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="The spec to write.")] = Path(
        "spec.toml"
    ),
    inputs: Annotated[
        list[str] | None,
        typer.Option(
            "--inputs",
            metavar="A B",
            help="Columns of the inputs; A,B for several.",
            show_default="by their names, or asked for",
        ),
    ] = None,
    outputs: Annotated[
        list[str] | None,
        typer.Option(
            "--outputs",
            metavar="Y",
            help="Columns of the outputs.",
            show_default="by their names, or asked for",
        ),
    ] = None,
    sampling_time: Annotated[
        float | None,
        typer.Option(
            "--sampling-time",
            metavar="S",
            help="Between rows.",
            show_default="by the column of the time",
        ),
    ] = None,
    system: Annotated[
        str | None,
        typer.Option(
            "--system",
            metavar="KIND[,KEY=VALUE]",
            help="Physics of the spec, such as hammerstein_wiener,order=3.",
            show_default="linear lags",
        ),
    ] = None,
    force: Force = False,
) -> None:
    """Look at a data file, and write a first spec that runs.

    Asks for the columns where it is on a terminal and they are not given.
    """
    from orthaug._base.errors import InputError
    from orthaug.commands.folder import check_file
    from orthaug.commands.init import assign, draft, look, question, write_spec
    from orthaug.commands.written_motion import system_of
    from orthaug.data.record import check_step

    check_file(out, data, force=force)
    declared = None if system is None else system_of(system)
    if sampling_time is not None:
        check_step(sampling_time)
    large = data.is_file() and data.stat().st_size > _LARGE
    report_stage = streams.say if large and on_terminal() else _silent
    report_stage(f"reading {data.name}")
    found = look(data)
    roles = assign(found, inputs, outputs, sampling_time)
    if roles is None:
        asked = question(found, inputs, outputs)
        if not sys.stdin.isatty():
            raise InputError(asked)
        streams.say("columns: " + ", ".join(column.header for column in found.signals))
        if inputs is None:
            check = partial(assign, found, outputs=outputs, sampling_time=sampling_time)
            inputs = [_ask("inputs, separated by commas (none: press enter)", check)]
        if outputs is None:
            outputs = [_ask("outputs", partial(assign, found, inputs), default=None)]
        roles = assign(found, inputs, outputs, sampling_time)
    if (
        roles is not None
        and sampling_time is None
        and found.clock.step is None
        and sys.stdin.isatty()
    ):
        roles = replace(
            roles,
            sampling_time=check_step(typer.prompt("seconds between rows", type=float, default=1.0)),
        )
    assert roles is not None  # both are given
    report_stage("looking at signals, delays and orders")
    spec = draft(found, roles, out, declared)
    report_stage("opening the spec as a fit would")
    write_spec(spec, out, force=force)
    account = "\n".join(fold([spec.account]))
    streams.echo(f"{account}\n\nwritten to {out}\nnext: orthaug fit {out}")


def _silent(line: str) -> None:
    """Show nothing: the file is read too quickly for a message."""


def _ask(text: str, check: Callable[[str], object], default: str | None = "") -> str:
    """Return an answer that `check` accepts.

    Another answer is refused with the reason, and the question is repeated.
    """
    from orthaug._base.errors import InputError

    while True:
        answer = str(typer.prompt(text, default=default, show_default=False))
        try:
            check(answer)
        except InputError as error:
            streams.say(str(error))
        else:
            return answer


@app.command("app", epilog="Example: orthaug app spec.toml")
def page(
    spec: Annotated[
        Path | None,
        typer.Argument(
            metavar="SPEC", help="Spec to start with; it is not changed.", show_default="none"
        ),
    ] = None,
    port: Annotated[
        int | None,
        typer.Option("--port", metavar="N", help="Port to listen on.", show_default="a free one"),
    ] = None,
    browser: Annotated[
        bool, typer.Option("--browser/--no-browser", help="Open it in the browser.")
    ] = True,
) -> None:
    """Open a page on this machine to do all of this in a browser.

    Look at data, write physics, train, compare and export.
    """
    from orthaug.commands.app.server import serve

    serve(spec, port=port, browser=browser)


@app.command(epilog="Example: orthaug schema keys")
def schema(
    command: Annotated[
        str,
        typer.Argument(
            metavar="WHAT",
            help="A command with --json: what it writes; error: what it prints where it fails; "
            "spec: a spec file; keys: every key of a spec, in words.",
        ),
    ] = "fit",
) -> None:
    """Print the JSON schema of a result or a spec; keys: in words."""
    from orthaug.commands.schema import RESULTS, keys_of_a_spec, schema_of, schema_of_a_spec

    if check_choice(command, (*RESULTS, "spec", "keys"), "WHAT") == "keys":
        streams.echo(keys_of_a_spec())
    else:
        content = schema_of_a_spec() if command == "spec" else schema_of(command)
        streams.echo(json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False))


@app.command(epilog="Example: orthaug reproduce --small")
def reproduce(
    name: Annotated[
        str | None, typer.Argument(metavar="NAME", help="One study.", show_default="all")
    ] = None,
    out: Annotated[Path | None, out_folder("orthaug-out/reproduction")] = None,
    pipeline: Annotated[
        str,
        typer.Option(
            "--pipeline",
            metavar="ours|paper|scripts",
            help="Who trains the networks; scripts: as published.",
        ),
    ] = "ours",
    small: Annotated[
        bool, typer.Option("--small", help="Run the reduced size of the tests.")
    ] = False,
    scheduler: Annotated[
        str | None,
        typer.Option(
            "--scheduler",
            metavar="ADDRESS",
            help="Dask cluster whose workers do the runs.",
            show_default="none",
        ),
    ] = None,
    force: Force = False,
) -> None:
    """Compute the paper's figures and tables again.

    An interrupted run continues where it stopped.
    """
    from orthaug.studies import reproduction

    folder = out or Path("orthaug-out/reproduction")
    reproduction.check_output(folder, force=force)
    entries = reproduction.choose_studies(name)
    check_choice(pipeline, reproduction.PIPELINES, "--pipeline")
    prepare_jax()
    client = None
    if scheduler is not None:
        from orthaug.models.cluster import connect

        client = connect(scheduler, None)
    with study_bars() as progress:
        reproduced = reproduction.reproduce(
            entries, pipeline=pipeline, small=small, progress=progress, client=client
        )
    with WATCH.report_stop(lambda: "the writing of the page", then=GO_ON):
        reproduction.write(reproduced, folder, pipeline, force=force)
    streams.echo(f"{reproduction.text(reproduced)}\n\nwritten to {folder}/index.html")


@app.command(epilog="Example: orthaug benchmark silverbox --data sets")
def benchmark(
    names: Annotated[
        list[str] | None,
        typer.Argument(metavar="NAME...", help="Sets to measure.", show_default="all"),
    ] = None,
    data: Annotated[
        Path | None,
        typer.Option(
            "--data",
            metavar="DIR",
            help="Folder of the sets' files.",
            show_default="the variable ORTHAUG_DATA",
        ),
    ] = None,
    out: Annotated[Path | None, out_folder("orthaug-out/benchmark")] = None,
    beside: Annotated[
        list[str] | None,
        typer.Option(
            "--beside",
            metavar="PACKAGE",
            help="Another package on the same rows: sysidentpy or jax-sysid; none for no other.",
            show_default="all",
        ),
    ] = None,
    defaults: Annotated[
        bool,
        typer.Option(
            "--defaults",
            help="Fit the first model also with nothing chosen beyond its physics, which may "
            "take longer than all the rest.",
        ),
    ] = False,
    listed: Annotated[
        bool, typer.Option("--list", help="Print the sets and their protocols; measure nothing.")
    ] = False,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Measure public data sets beside the published figures.

    The data are not part of the package: `--list` prints the source of every set.
    """
    from orthaug.reports.benchmark import benchmark_text, list_text
    from orthaug.studies.other_packages import choose_packages
    from orthaug.studies.public_sets import choose_sets

    sets = choose_sets(names or [])
    packages = choose_packages(beside or [])
    if listed:
        if as_json:
            from orthaug._base.errors import InputError

            raise InputError(
                "--json: found beside --list, which prints text; leave one of them out."
            )
        streams.echo(list_text([one.result() for one in sets]))
        return
    from orthaug.commands import benchmark as records

    place, folder = records.data_folder(data), out or Path("orthaug-out/benchmark")
    records.check_output(folder, place, force=force)
    prepare_jax()
    result = records.benchmark(sets, place, packages, training_bar, streams.say, defaults=defaults)
    with WATCH.report_stop(lambda: "the writing of the folder"):
        records.write(result, folder, place, force=force)
    print_result(result, benchmark_text(result), as_json, folder)


from orthaug.commands import model_cli  # noqa: E402, F401  (its commands come after these)
