"""The command line: arguments in, text out. Results go to standard output, progress and errors to standard error."""

from __future__ import annotations

import json
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
import typer.core

from orthaug import __version__
from orthaug._base.checks import check_choice
from orthaug._base.errors import InputError, TrainingError

if TYPE_CHECKING:
    from orthaug.commands.jobs import Progress
    from orthaug.models.response import Response


class Interrupted(Exception):
    """Ctrl-C, with what it stopped; typer would turn a KeyboardInterrupt into a bare exit code."""


class _Group(typer.core.TyperGroup):
    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except (Interrupted, KeyboardInterrupt) as interrupt:
            raise Interrupted(*interrupt.args) from None


app = typer.Typer(
    name="orthaug",
    cls=_Group,
    help="Fit physics together with a learned correction, so that the physics keeps all that physics can explain.",
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
SpecPath = Annotated[Path, typer.Argument(metavar="SPEC", help="Spec file (TOML).")]
ModelPath = Annotated[Path, typer.Argument(metavar="MODEL", help="Result folder of `fit`, or its model/.")]
DataPath = Annotated[Path, typer.Argument(metavar="DATA", help="Data file with the model's channels.")]
OutFolder = Annotated[Path | None, typer.Option("--out", metavar="DIR", help="Result folder.")]
OutFile = Annotated[Path | None, typer.Option("--out", metavar="FILE", help="CSV file; standard output without it.")]
Initial = Annotated[
    str | None,
    typer.Option("--initial", metavar="measured|zero|INIT", help="Outputs before the first step; INIT is a CSV."),
]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON instead of the summary.")]


def main() -> None:
    """Entry point: runs the command and turns errors into one line and an exit code."""
    try:
        code = app(standalone_mode=False)
    except InputError as error:
        _fail(f"error: {error}", 2)
    except TrainingError as error:
        _fail(f"training failed: {error}", 1)
    except (Interrupted, KeyboardInterrupt) as interrupt:
        _fail(f"interrupted{''.join(f' during {text}' for text in interrupt.args)}; nothing was written", 130)
    except BrokenPipeError:
        sys.stderr.close()
        sys.exit(0)
    except Exception as error:
        complaint = getattr(error, "format_message", None)  # typer's own, about arguments
        if complaint is None:
            raise
        text = complaint()
        line = text if text.startswith("Usage") else f"error: {' '.join(text.split())}"
        _fail(line, getattr(error, "exit_code", 2))
    sys.exit(code if isinstance(code, int) else 0)


def _version(show: bool) -> None:
    if show:
        typer.echo(f"orthaug {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    pass


@app.command()
def demo(out: OutFolder = None) -> None:
    """Fit the paper's example and compare with the truth."""
    from orthaug.commands.outcome import check_output

    folder = out or Path("orthaug-out/demo")
    check_output(folder)
    _prepare_jax()
    from orthaug.commands import demo as demonstration

    with _progress(2 * demonstration.RESTARTS, demonstration.ITERATIONS) as progress:
        text = demonstration.run(folder, progress)
    typer.echo(text)
    typer.echo(f"\nwritten to {folder}")


@app.command()
def check(
    spec: SpecPath,
    as_json: AsJson = False,
    figure: Annotated[Path | None, typer.Option("--figure", metavar="PNG", help="Heat map of the biases.")] = None,
) -> None:
    """Report excitation and identifiability; trains nothing."""
    from orthaug.commands import jobs, outcome
    from orthaug.physics.excitation import require_rank
    from orthaug.reports import report

    job = jobs.open_job(spec, require_full_rank=False)
    found = outcome.plain(outcome.check_report(job))
    typer.echo(_json(found) if as_json else report.check_text(found))
    if figure is not None and found["bias"]:
        from orthaug.commands import runs
        from orthaug.reports import plots

        runs.check_output(figure, *job.files)
        plots.save(outcome.bias_heat_map(found["bias"]), figure)
    try:
        require_rank(job.problem.excitation, job.problem.rows.y.size)
    except InputError as error:
        raise type(error)(f"{spec}: {error}") from None


@app.command()
def fit(spec: SpecPath, out: OutFolder = None, as_json: AsJson = False) -> None:
    """Fit a spec, print a summary and write the result folder."""
    from orthaug.commands import jobs, outcome
    from orthaug.reports import report

    folder = out or Path("orthaug-out") / spec.stem
    outcome.check_output(folder)
    job = jobs.open_job(spec)
    outcome.check_inputs_kept(job, folder)
    _prepare_jax()
    with _progress(job.run_count, job.iterations, job.spec.declared_learner() is not None) as progress:
        fitted = outcome.fit_job(job, progress)
    outcome.write_result(fitted, folder)
    if as_json:
        typer.echo(_json(fitted.result))
    else:
        typer.echo(report.fit_text(fitted.fit, fitted.result))
        typer.echo(f"\nwritten to {folder}")
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
) -> None:
    """Physics alone and every structure, one table."""
    from orthaug.commands import jobs, outcome

    folder = out or Path("orthaug-out") / spec.stem
    outcome.check_output(folder)
    job = jobs.open_job(spec)
    outcome.check_inputs_kept(job, folder)
    _prepare_jax()
    from orthaug.commands import compare as comparing

    with _progress(job.run_count * len(comparing.compared()), job.iterations) as progress:
        found = comparing.compare(job, model or (), progress)
    comparing.write(found, folder)
    typer.echo(_json(found.result) if as_json else f"{comparing.text(found)}\n\nwritten to {folder}")


@app.command()
def simulate(
    model: ModelPath,
    data: DataPath,
    out: OutFile = None,
    initial: Initial = None,
) -> None:
    """Free run of a saved model on a data file."""
    from orthaug.commands import runs

    opened = runs.open_run(model, data)
    start = runs.read_initial(initial, opened)
    runs.check_output(out, data, Path(initial or data))
    _prepare_jax()
    _write_response(opened.model.simulate(opened.record, initial=start), out)


@app.command()
def predict(
    model: ModelPath,
    data: DataPath,
    horizon: Annotated[int, typer.Option("--horizon", metavar="H", help="Steps ahead.")] = 1,
    out: OutFile = None,
    initial: Initial = None,
) -> None:
    """H-step-ahead prediction of a saved model."""
    from orthaug.commands import runs

    opened = runs.open_run(model, data, need_outputs=True)
    record = runs.with_initial(opened, runs.read_initial(initial, opened))
    runs.check_output(out, data, Path(initial or data))
    _prepare_jax()
    _write_response(opened.model.predict(record, horizon=horizon), out)


@app.command()
def split(
    model: ModelPath,
    data: Annotated[list[Path], typer.Argument(metavar="DATA…", help="The files that the model was trained on.")],
    measure: Annotated[
        str, typer.Option("--measure", metavar="KIND", help="training, symmetrized, uniform, samples or weighted.")
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
    from orthaug.commands import measure_options, runs

    opened = runs.open_training(model, data, runs.read_rows(rows))
    given = {"box": box or [], "samples": [samples] if samples else [], "weights": [weights] if weights else []}
    place = measure_options.split_place(opened.model, opened.record)
    chosen = measure_options.read_measure(measure, given, place)
    _prepare_jax()
    found = runs.split(opened, chosen)
    typer.echo(_json(found) if as_json else runs.split_text(found))


@app.command()
def design(
    spec: SpecPath,
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="CSV file for the input.")],
    as_json: AsJson = False,
) -> None:
    """An input within limits under which suspected terms and noise disturb the parameters least."""
    from orthaug.commands import designing, jobs, outcome, runs

    job = jobs.open_job(spec, require_full_rank=False)
    runs.check_output(out, *job.files)
    found = designing.design(job)
    designing.write(job, found, out)
    typer.echo(_json(outcome.plain(found.as_dict())) if as_json else f"{designing.text(found)}\n\nwritten to {out}")


@app.command()
def reproduce(
    name: Annotated[str | None, typer.Argument(metavar="[NAME]", help="One study; all without it.")] = None,
    out: OutFolder = None,
    pipeline: Annotated[str, typer.Option("--pipeline", metavar="ours|paper", help="Who trains.")] = "ours",
    small: Annotated[bool, typer.Option("--small", help="The reduced size that the tests run.")] = False,
) -> None:
    """The paper's figures and tables, each number beside the published one; goes on where it was interrupted."""
    from orthaug.studies import reproduction

    folder = out or Path("orthaug-out/reproduction")
    reproduction.check_output(folder)
    entries = reproduction.chosen(name)
    check_choice(pipeline, reproduction.PIPELINES, "--pipeline")
    _prepare_jax()
    with _study_progress() as progress:
        found = reproduction.reproduce(entries, pipeline=pipeline, small=small, progress=progress)
    reproduction.write(found, folder, pipeline)
    typer.echo(f"{reproduction.text(found)}\n\nwritten to {folder}/index.html")


def _unbuilt(name: str) -> None:
    @app.command(name, hidden=True, context_settings={"ignore_unknown_options": True, "allow_extra_args": True})
    def refuse(context: typer.Context) -> None:
        raise InputError(f"`orthaug {name}` is not built yet in this version.")


for _name in ("export",):
    _unbuilt(_name)


def _prepare_jax() -> None:
    from orthaug._base.jax import use_compilation_cache

    use_compilation_cache()


def _fail(message: str, code: int) -> None:
    sys.stderr.write(message + "\n")
    sys.exit(code)


@contextmanager
def _progress(runs: int, iterations: int, wanted: bool = True) -> Iterator[Progress | None]:
    """A progress bar on standard error where that is a terminal; Ctrl-C is told what it stopped."""
    if not wanted:
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    reached = "the start of training"
    with (
        _deferred_interrupt() as interrupted,
        Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar,
    ):
        task = bar.add_task("compiling", total=runs * iterations)
        done: dict[int, int] = {}

        def tell(run: int, iteration: int, loss: float) -> None:
            nonlocal reached
            done[run] = iteration
            reached = f"run {run + 1} of {runs}, iteration {iteration}, loss {loss:.3g}"
            bar.update(task, completed=sum(done.values()), description=reached)
            if interrupted.is_set():
                raise KeyboardInterrupt(reached)

        try:
            yield tell
        except KeyboardInterrupt:
            raise KeyboardInterrupt(reached) from None
        if interrupted.is_set():
            raise KeyboardInterrupt("the scoring of the model")


@contextmanager
def _study_progress() -> Iterator[Callable[[str, int, int], None]]:
    """A bar per study on standard error where that is a terminal; Ctrl-C stops after the run at hand."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with (
        _deferred_interrupt() as interrupted,
        Progress(*columns, console=console, disable=not console.is_terminal) as bar,
    ):
        tasks: dict[str, Any] = {}

        def tell(title: str, done: int, total: int) -> None:
            if title not in tasks:
                tasks[title] = bar.add_task(title, total=total)
            bar.update(tasks[title], completed=done)
            if interrupted.is_set():
                raise KeyboardInterrupt(f"'{title}', {done} of {total} runs done and kept for the next time")

        yield tell


@contextmanager
def _deferred_interrupt() -> Iterator[threading.Event]:
    """Ctrl-C sets the event, so that it never lands inside compiled code; a second one interrupts at once."""
    event = threading.Event()

    def note(signum: int, frame: object) -> None:
        if event.is_set():
            raise KeyboardInterrupt
        event.set()

    previous = signal.signal(signal.SIGINT, note)
    try:
        yield event
    finally:
        signal.signal(signal.SIGINT, previous)


def _write_response(response: Response, out: Path | None) -> None:
    from orthaug.commands import runs

    for text in runs.warnings(response):
        sys.stderr.write(f"warning: {text}\n")
    runs.write_csv(response, out)


def _json(content: Any) -> str:
    return json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False)
