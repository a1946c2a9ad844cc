"""Methods that later rooms add to objects of earlier ones: notebook tables, figures, pages.

The package's root, which may name every room, enters the makers here; they import what they need
when they are called.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import wraps
from typing import Any, ParamSpec, TypeVar

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")

MAKERS: dict[str, Callable[..., Any]] = {}  # html, plot, report, progress


class NotebookView:
    """Object that a notebook shows as a table."""

    def _repr_html_(self) -> str:
        return MAKERS["html"](self)


class FitView(NotebookView):
    """A fit with figures and a page."""

    @property
    def plot(self) -> Any:
        """Figures on matplotlib axes, such as `fit.plot.free_run()`.

        `orthaug.reports.FitPlots` lists them.
        """
        return MAKERS["plot"](self)

    def report(self, path: Any = None, *, tests: Any = None) -> Any:
        """Return the page that `orthaug fit` writes, with all figures in one file.

        Args:
            path: HTML file to write, which is replaced; None to get the page as text that a
                notebook shows.
            tests: records to score and judge the model on, by their names; none for the training
                data alone.

        Returns:
            The `Page`: `html` is its text, `path` its file or None.

        Raises:
            InputError: training that failed, a path that cannot be written, a record that does not
                fit the model.
        """
        return MAKERS["report"](self, path, tests)


def with_progress(verb: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Return a verb whose `progress` may also be True or False.

    True shows a bar on a terminal or in a notebook.
    """

    @wraps(verb)
    def with_shown_progress(*arguments: Arguments.args, **options: Arguments.kwargs) -> Result:
        wanted = options.get("progress")
        if not isinstance(wanted, bool):
            return verb(*arguments, **options)
        options.pop("progress")
        if not wanted:
            return verb(*arguments, **options)
        bar: AbstractContextManager[Any] = MAKERS["progress"]()
        with bar as report:
            options["progress"] = report
            return verb(*arguments, **options)

    return with_shown_progress
