"""The frame of the commands: meaning of arguments, and errors as one line and an exit code."""

from __future__ import annotations

import errno
import os
import re
import sys
import warnings
from collections.abc import Sequence, Set
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
import typer.core

from orthaug import __version__
from orthaug._base.checks import check_choice
from orthaug._base.errors import InputError, TrainingError, show
from orthaug._base.folders import PARTIALS
from orthaug.commands import streams
from orthaug.commands.signals import WATCH, ending_message

if TYPE_CHECKING:
    from orthaug._base.content import Content


class Interrupted(Exception):
    """Ctrl-C, with what it stopped; typer would turn a KeyboardInterrupt into a bare exit code."""


class OutputClosed(Exception):
    """The reader of the output has closed it, as after `| head`.

    Typer would turn a BrokenPipeError into exit code 1.
    """


class _Group(typer.core.TyperGroup):
    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the commands in groups, each with the first line of its help."""
        width = max(map(len, self.commands))
        for heading, names in GROUPS.items():
            with formatter.section(heading):
                formatter.write_dl(
                    [
                        (f"{name:<{width}}", self.commands[name].get_short_help_str(_SHORT))
                        for name in names
                    ]
                )

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except (Interrupted, KeyboardInterrupt) as interrupt:
            raise Interrupted(*interrupt.args) from None
        except OSError as error:
            if error.errno in _NO_READER and error.filename is None:
                raise OutputClosed from None
            raise


class PlainCommand(typer.core.TyperCommand):
    """A command whose help names arguments as one types them: `DATA...`, `[SPEC]`, no types."""

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        return [_plain_usage(piece) for piece in super().collect_usage_pieces(ctx)]

    def format_options(self, ctx: Any, formatter: Any) -> None:
        write = formatter.write_dl

        def write_plain(rows: Sequence[tuple[str, str]], *args: object, **options: object) -> None:
            write([(_TYPE.sub("", name), text) for name, text in rows], *args, **options)

        formatter.write_dl = write_plain
        super().format_options(ctx, formatter)
        formatter.write_dl = write


def _plain_usage(piece: str) -> str:
    """Return an argument of a usage line without the marks that versions of typer add.

    Examples:
        >>> [_plain_usage(piece) for piece in ("{DATA...}...", "[[SPEC]]", "[NAME...]", "{MODEL}")]
        ['DATA...', '[SPEC]', '[NAME...]', 'MODEL']
    """
    name = re.sub(r"[{}\[\]]|\.\.\.", "", piece) + "..." * ("..." in piece)
    return f"[{name}]" if piece.startswith("[") else name


class ListOptionCommand(PlainCommand):
    """A command whose repeatable options take several values too: `--inputs a b`."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        valued = {
            name: option for option in self.params for name in option.opts if name.startswith("-")
        }
        valued = {
            name: option for name, option in valued.items() if not getattr(option, "is_flag", False)
        }
        lists = {name for name, option in valued.items() if getattr(option, "multiple", False)}
        return super().parse_args(ctx, _repeat_options(args, lists, set(valued)))


class OneFileCommand(ListOptionCommand):
    """A command that takes one data file, and says what to do with further ones."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        ctx.allow_extra_args = True
        super().parse_args(ctx, args)
        if ctx.args:
            ctx.fail(
                f"{ctx.info_name} takes one file, and found {show(', '.join(ctx.args))} besides. "
                "Write the spec from one of them, and add the others to `files` of `train` there."
            )
        return []


def _repeat_options(args: Sequence[str], lists: Set[str], valued: Set[str]) -> list[str]:
    """Return arguments with the option of a list repeated before each of its values.

    Where the command would have no argument, one value is left for it: a file that exists, or the
    last.

    Examples:
        >>> given = ["run.csv", "--inputs", "a", "b", "--out", "c"]
        >>> _repeat_options(given, {"--inputs"}, {"--inputs", "--out"})
        ['run.csv', '--inputs', 'a', '--inputs', 'b', '--out', 'c']
    """
    found: list[list[str]] = []
    option, further = "", []
    arguments = list(args)
    while arguments:
        word = arguments.pop(0)
        name = word.partition("=")[0]
        if word.startswith("-") and len(word) > 1:
            found.append([word] if "=" in word or word not in valued else [word, *arguments[:1]])
            arguments = arguments[len(found[-1]) - 1 :]
            option = name if name in lists else ""
        elif option:
            further.append(len(found))
            found.append([option, word])
        else:
            found.append([word])
    if further and all(part[0].startswith("-") for part in found):
        at = next((i for i in further if Path(found[i][1]).is_file()), further[-1])
        found[at] = found[at][1:]
    return [word for part in found for word in part]


GROUPS = {
    "Commands": ("demo", "init", "app"),
    "Commands on a spec": ("check", "fit", "compare", "select", "design", "recover"),
    "Commands on a saved model": (
        *("simulate", "predict", "split", "explain", "linearize", "track", "export"),
    ),
    "Commands on the tool": ("schema", "reproduce", "benchmark"),
}
"""The commands as `orthaug --help` lists them: in the order of work."""
# Words of typer's versions about an option's value
_NO_NUMBER = re.compile(r"valid (integer|number|float)")
_GIVEN = re.compile(r"""(?:input_value=|^)(['"])(.*?)\1""")
_TYPE = re.compile(r" <\S+>$")  # of an argument, which its own help says in words
_SHORT = 100  # characters of the first line of a command's help: none is cut


class _App(typer.Typer):
    def command(self, *args: Any, **options: object) -> Any:
        """Register a command, whose help is plain."""
        return super().command(*args, **{"cls": PlainCommand} | options)


app = _App(
    name="orthaug",
    cls=_Group,
    help="Fit physics together with a learned correction, so that physics keeps what it can "
    "explain.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
_NO_READER = (errno.EPIPE, errno.EINVAL) if os.name == "nt" else (errno.EPIPE,)
SpecPath = Annotated[Path, typer.Argument(metavar="SPEC", help="Spec file (TOML).")]
ModelPath = Annotated[
    Path, typer.Argument(metavar="MODEL", help="Result folder of `fit`, or its model/.")
]
Which = Annotated[
    str,
    typer.Option(
        "--model",
        metavar="fitted|physics",
        help="The fitted model, or the physics without a learner.",
    ),
]
DataPath = Annotated[
    Path, typer.Argument(metavar="DATA", help="Data file with the model's channels.")
]


def out_folder(default: str) -> Any:
    """Return the option `--out` of a command, with its default in words."""
    return typer.Option("--out", metavar="DIR", help="Result folder.", show_default=default)


OutFile = Annotated[
    Path | None,
    typer.Option("--out", metavar="FILE", help="CSV file.", show_default="standard output"),
]
Initial = Annotated[
    str | None,
    typer.Option(
        "--initial",
        metavar="measured|zero|INIT",
        help="Outputs before the first step; INIT is a CSV.",
        show_default="measured",
    ),
]


def missing_cells(default: bool | str = True) -> Any:
    """Return the option `--missing` of a command, with its default in words or as it is."""
    return typer.Option(
        "--missing",
        metavar="error|skip|keep",
        help="Rows with missing cells: skip leaves them out, keep simulates a motion through them.",
        show_default=default,
    )


Missing = Annotated[str, missing_cells()]
Rows = Annotated[
    str | None,
    typer.Option("--rows", metavar="A:B", help="Rows of the file, half-open.", show_default="all"),
]
Every = Annotated[int, typer.Option("--every", metavar="N", help="Keep each N-th row.")]
Columns = Annotated[
    list[str] | None,
    typer.Option(
        "--column",
        metavar="NAME=COLUMN",
        help="The file's column of a channel; may be repeated.",
        show_default="the channel's column in training",
    ),
]
Prepare = Annotated[
    bool | None,
    typer.Option(
        "--prepare/--no-prepare",
        help="Prepare the rows as the training data were, by the model's steps.",
        show_default="no, but for a shift",
    ),
]
Force = Annotated[bool, typer.Option("--force", help="Replace existing files, whoever wrote them.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON instead of the summary.")]


def main() -> None:
    """Run the command and turn errors into one line and an exit code."""
    warnings.filterwarnings("ignore", "the rows of .* are taken to be 1 s apart")  # for Python
    try:
        code = app(prog_name="orthaug", standalone_mode=False)
        sys.stdout.flush()
    except InputError as error:
        fail("error", str(error), 2, None if error.in_result else error.code)
    except TrainingError as error:
        fail("training failed", str(error), 1, None if error.in_result else error.code)
    except (Interrupted, KeyboardInterrupt) as interrupt:
        during, then = (*map(str, interrupt.args), "", "")[:2]
        fail("", ending_message("interrupted", during, then=then), 130, "interrupted")
    except (OutputClosed, BrokenPipeError):
        streams.silence(sys.stdout)
        sys.exit(0)
    except OSError as error:
        if error.filename is None:
            streams.silence(sys.stdout)
        what = error.filename or "standard output"
        text = str(InputError(f"{what}: cannot be read or written ({error.strerror or error})."))
        fail("error", text, 2, "file_failed")
    except Exception as error:
        text = _complaint(error)
        if text is None:
            raise
        usage = hasattr(error, "format_message")
        own = text if text.startswith("Usage") else " ".join(text.split())
        before = "" if text.startswith("Usage") else "error"
        code = "usage" if usage else "no_memory" if "memory" in text else "no_device"
        fail(before, own, getattr(error, "exit_code", 2), code)
    sys.exit(code if isinstance(code, int) else 0)


def _complaint(error: Exception) -> str | None:
    """Return the message for an error of another library; None for one that is not caught."""
    from orthaug._base.jax import starts

    complaint = getattr(error, "format_message", None)  # typer's own, about arguments
    if complaint is not None:
        return _number_complaint(error) or complaint()
    text = str(error)
    if isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in text:
        return "there is not enough memory; take fewer rows, a smaller learner, or every n-th row."
    platforms = os.environ.get("JAX_PLATFORMS", "")
    if platforms not in ("", "cpu") and not starts():
        return f"JAX cannot start with JAX_PLATFORMS={platforms}; unset it, or set it to cpu."
    return None


def _number_complaint(error: Exception) -> str | None:
    """Return the message for an option that takes a number and was given none; None otherwise."""
    kind = _NO_NUMBER.search(str(getattr(error, "message", "")))
    option = next(reversed(getattr(getattr(error, "param", None), "opts", [])), None)
    if kind is None or option is None:
        return None
    given = _GIVEN.search(f"{getattr(error, 'message', '')} {error.__cause__ or ''}")
    found = f"found {show(given[2])}" if given else "found another word"
    expected = "a whole number, such as 3" if kind[1] == "integer" else "a number, such as 0.5"
    return f"{option}: {found}; expected {expected}."


def _version(show: bool) -> None:
    if show:
        streams.echo(f"orthaug {__version__}")
        raise typer.Exit


@app.callback()
def options(
    verbose: Annotated[
        int,
        typer.Option(
            "--verbose",
            "-v",
            count=True,
            help="Log what is done; twice for more.",
            show_default=False,
        ),
    ] = 0,
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
    run_fmu: Annotated[
        bool,
        typer.Option(
            "--run-fmu", help="Run the native code of an FMU in a saved model that you trust."
        ),
    ] = False,
) -> None:
    """Set the options before a command: -v, -vv or ORTHAUG_LOG ask for the log."""
    from orthaug.physics.consent import CONSENTS

    CONSENTS.to_all, CONSENTS.kept = run_fmu, not run_fmu
    level, levels = os.environ.get("ORTHAUG_LOG", "").lower(), ("info", "debug")
    if verbose or level:
        from orthaug._base.progress import show_log

        show_log(
            levels[min(verbose, 2) - 1] if verbose else check_choice(level, levels, "ORTHAUG_LOG")
        )


def fail(before: str, text: str, exit_code: int, code: str | None) -> None:
    """Say an error on standard error, and where `--json` is given on standard output as JSON.

    Args:
        before: the word before it for people.
        code: that for programs; None for an error that a printed result has said already.
    """
    WATCH.hold()
    streams.say(f"{before}: {text}" if before else text)
    if code is not None and _asks_for_json(sys.argv[1:]):
        from orthaug.reports.failure import FailureResult

        with suppress(OSError, ValueError):
            streams.echo(FailureResult.of(code, text).to_json())
    sys.exit(exit_code)


def _asks_for_json(given: Sequence[str]) -> bool:
    """Return whether arguments have `--json` among the options.

    Examples:
        >>> _asks_for_json(["fit", "a.toml", "--json"]), _asks_for_json(["fit", "--", "--json"])
        (True, False)
    """
    return "--json" in given[: given.index("--") if "--" in given else len(given)]


def print_result(
    result: Content,
    text: str,
    as_json: bool,
    place: object = None,
    failure: InputError | TrainingError | None = None,
) -> None:
    """Print a result on standard output, as JSON or in words; then the place that was written.

    A `failure` that the command ends with is its `error` in JSON.
    """
    if failure is not None and as_json:
        from orthaug.reports.failure import FailureResult

        error = FailureResult.of(failure.code, str(failure)).error
        result, failure.in_result = result.model_copy(update={"error": error}), True
    written = f"\n\nwritten to {place}" if place is not None else ""
    if place in PARTIALS.overtaken:
        streams.say(
            f"warning: {place}: another run wrote a result here in the meantime, and this run "
            "has replaced it. Run again with another --out to keep both."
        )
    streams.echo(result.to_json() if as_json else f"{text}{written}")


def other_writes() -> bool:
    """Return whether another one of several processes writes the result; then print that."""
    from orthaug.models.hosts import waits

    text = waits()
    if text is not None:
        streams.echo(text)
    return text is not None


def arguments(command: str, *read: Path, **options: object) -> tuple[str, ...]:
    """Return the arguments of a command, to run it again: the options that were given, by name.

    Examples:
        >>> arguments("fit", Path("a.toml"), out=Path("b"), resume=False, model=None, force=True)
        ('fit', 'a.toml', '--out', 'b', '--force')
    """
    words = [command, *map(str, read)]
    for name, value in options.items():
        if value is True:
            words.append(f"--{name}")
        elif value:
            words += [
                part
                for one in (value if isinstance(value, list) else [value])
                for part in (f"--{name}", str(one))
            ]
    return tuple(words)


def prepare_jax() -> None:
    """Keep compiled programs for the next command."""
    from orthaug._base.jax import keep_programs

    keep_programs()
