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

MAKERS: dict[str, Callable[..., Any]] = {}
"""What packages above make: html, plot, report, progress, diagnose, findings, intervals."""


class NotebookView:
    """Object that a notebook shows as a table."""

    def _repr_html_(self) -> str:
        return MAKERS["html"](self)


class FitView(NotebookView):
    """A fit with figures and a page."""

    @property
    def plot(self) -> Any:
        """Figures on matplotlib axes, such as `fit.plot.free_run()`; `fit.plot()` is an overview.

        `orthaug.reports.FitPlots` lists them.
        """
        return MAKERS["plot"](self)

    def diagnose(
        self,
        *,
        validation: Any = None,
        tests: Any = None,
        suspects: Any = (),
        physics: Any = None,
        profiles: bool = False,
        blocks: int | None = None,
        skip: int = 0,
    ) -> Any:
        """Return everything that `orthaug fit` says of a fit: what it is worth, and why.

        Print it for the text of the command. Nothing is fitted to other data, but physics alone
        and blocks of the training data are, where these judge the learner.

        Args:
            validation: a record that was not fitted; None for the one that `estimate` chose by.
            tests: further records by their names, to score and judge the model on.
            suspects: terms that the physics may lack, a `Suspect` or `MotionSuspect` each.
            physics: from physical parameters to θ of lagged physics, a `PhysicsMap`.
            profiles: whether physical parameters get profile-likelihood intervals, too.
            blocks: of cross-validation of the learner, 0 for none; None for 4 where no record is
                held out.
            skip: leading samples of each held-out experiment that are not scored.

        Returns:
            The `Findings`: `parameters` with their biases and intervals, `scores`, `residuals`,
            `unexplained`, `bias` by suspects, `stability`, `validation` with the verdict on the
            learner, `warnings` with their codes, `verdict` on the model in words; `content()` is
            what result.json has.

        Raises:
            InputError: records, suspects or a map that do not fit the model.

        Examples:
            >>> import numpy as np
            >>> import orthaug as oa
            >>> u = np.random.default_rng(0).uniform(-1, 1, 300)
            >>> noise = 0.05 * np.random.default_rng(1).normal(size=300)
            >>> record = oa.Record.from_arrays(u, 2 * u + u**3 + noise)
            >>> gain = oa.Baseline.from_terms([oa.Term("gain", "u[k]")])
            >>> found = oa.estimate(record, gain, learner=None).diagnose()
            >>> found.residuals.verdict, [warning.code for warning in found.warnings]
            ('unmodelled', ['unexplained'])
        """
        return MAKERS["diagnose"](
            self,
            validation=validation,
            tests=tests,
            suspects=suspects,
            physics=physics,
            profiles=profiles,
            blocks=blocks,
            skip=skip,
        )

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
