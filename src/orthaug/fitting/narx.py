"""Time series as an estimator of scikit-learn: physics in lags, and a correction."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from orthaug._base.checks import as_signal, check_choice
from orthaug._base.errors import InputError
from orthaug.data.record import Experiment, Record
from orthaug.data.regressors import Lags, Layout
from orthaug.fitting.scikit_learn import (
    Augmented,
    Physics,
    baseline_of,
    check_arrays,
    checked_again,
    input_names,
    learner_of,
    output_names,
)

_FIRST = Lags(na=1, nb=1, nk=1)  # of physics "linear" where no lags are given
SCORED_ON = ("simulation", "prediction")


class Group(NamedTuple):
    """One experiment: its label, and its rows in X."""

    label: Any
    rows: np.ndarray


class AugmentedNARX(Augmented):
    """`y_k = φ(x_k)θ + learner(x_k) + e_k`, as an estimator of scikit-learn.

    x_k are past outputs and inputs; records are arrays, experiments are groups.

    The rows of X are inputs at successive samples and those of y the outputs measured with them.
    `groups` labels the experiments; rows of one label belong together in their order, and lags
    never reach into another. It passes on to `estimate` and gives the same numbers.

    The first `first_row_` rows of every experiment have no prediction, for there is no past that it
    could be made from: they are NaN in what `predict` and `simulate` return, and no score counts
    them.

    Args:
        physics: "linear", a line in every lag with an intercept; expressions such as
            `["y[k-1]", "x0[k-1]*abs(x0[k-1])"]`, of parameters theta1, theta2, …; a mapping
            `{"pole": "y[k-1]"}`; `Term`s; a `Baseline`; or a JAX function of the regressor,
            returning (n_outputs, n_parameters). Inputs are named by the columns of a DataFrame,
            else x0, x1, …; the output is y, or y0, y1, … of several.
        lags: a `Lags`, the learner's regressor; None for what the physics reads, of "linear" one
            sample back.
        learner: a declaration; "auto" for `MLP()`, None for physics alone.
        structure: as of `estimate`; None for `Orthogonal()`.
        criterion: `Prediction(…)` or `Simulation(…)`; None for one step ahead.
        regularization: as of `estimate`.
        solver: as of `estimate`; None for `LevenbergMarquardt()`.
        restarts: runs from different initial weights.
        output_weights: as of `estimate`.
        sampling_time: seconds between rows.
        score_on: whether `score` is that of the free run, "simulation", or one step ahead,
            "prediction".
        random_state: seed of the initial weights; a RandomState or None draws it.

    Attributes:
        theta_: θ̂ (n_parameters,).
        theta_interval_: 95 % intervals (n_parameters, 2); None where there are none.
        coef_table_: both as a table, with names.
        noise_std_: standard deviation of the noise one step ahead (n_outputs,).
        estimate_: the `Estimate`, with summary, warnings, model and splits.
        first_row_: rows at the start of an experiment that have no prediction.
        n_features_in_, feature_names_in_: columns of X.
        output_names_: the outputs as expressions name them.

    Examples:
        >>> import numpy as np
        >>> u, y = np.sin(np.arange(300.0) ** 1.5)[:, None], np.zeros(300)
        >>> for k in range(1, 300):
        ...     y[k] = 0.8 * y[k - 1] + 0.5 * u[k - 1, 0]
        >>> narx = AugmentedNARX({"pole": "y[k-1]", "gain": "x0[k-1]"}, learner=None).fit(u, y)
        >>> [f"{value:.3f}" for value in narx.theta_]
        ['0.800', '0.500']
    """

    _ordered = True

    def __init__(
        self,
        physics: Physics = "linear",
        *,
        lags: Any = None,
        learner: Any = "auto",
        structure: Any = None,
        criterion: Any = None,
        regularization: Any = "auto",
        solver: Any = None,
        restarts: int = 1,
        output_weights: Any = "auto",
        sampling_time: float = 1.0,
        score_on: str = "simulation",
        random_state: Any = 0,
    ) -> None:
        self.physics = physics
        self.lags = lags
        self.learner = learner
        self.structure = structure
        self.criterion = criterion
        self.regularization = regularization
        self.solver = solver
        self.restarts = restarts
        self.output_weights = output_weights
        self.sampling_time = sampling_time
        self.score_on = score_on
        self.random_state = random_state

    def fit(self, X: Any, y: Any, groups: Any = None) -> AugmentedNARX:
        """Fit to inputs X (n, n_features) and outputs y (n,) or (n, n_outputs).

        Args:
            X: inputs.
            y: outputs.
            groups: the experiment of every row (n,); None for one.

        Raises:
            InputError (a ValueError): data and physics that do not fit together, a signal that does
                not move, too short an experiment; RankError where the rows do not determine θ.
                TrainingError where training gives no finite model.
        """
        check_choice(self.score_on, SCORED_ON, "`score_on`")
        given = y
        X, y = check_arrays(self, X, y)
        names = input_names(self)
        self.output_names_ = output_names(given, y.shape[1], names)
        baseline = baseline_of(self.physics, self._layout(names), self.output_names_)
        record = self._record(X, y, [*_groups(groups, len(X))])
        lags = _FIRST if self.lags is None and isinstance(self.physics, str) else self.lags
        self._estimate(record, baseline, lags, learner_of(self.learner), criterion=self.criterion)
        self.first_row_ = self.estimate_.model.form.first_row
        return self

    def predict(self, X: Any, y: Any, groups: Any = None) -> np.ndarray:
        """Return ŷ one step ahead from measured inputs and outputs.

        Its shape, (n,) or (n, n_outputs), is that of y in the fit.

        Raises:
            InputError (a ValueError): other columns than in the fit, too short an experiment.
        """
        model = self._fitted_estimate().model
        X = checked_again(self, X)
        y = self._outputs(y, len(X))
        found = np.full(y.shape, np.nan)
        for group in _groups(groups, len(X)):
            found[group.rows] = model.predict(self._record(X, y, [group])).model
        return self._shape(found)

    def simulate(self, X: Any, initial: Any = None, groups: Any = None) -> np.ndarray:
        """Return ŷ of the free run, whose past outputs are the model's own.

        Its shape, (n,) or (n, n_outputs), is that of y in the fit.

        Args:
            X: inputs.
            initial: outputs before the first prediction: y itself, (n,) or (n, n_outputs), of which
                only the first `first_row_` rows of each experiment are looked at; or these rows
                alone, the same for every experiment; None for zero.
            groups: the experiment of every row (n,); None for one.

        Raises:
            InputError (a ValueError): other columns than in the fit, too short an experiment or
                `initial`.
        """
        model = self._fitted_estimate().model
        X = checked_again(self, X)
        found = np.full((len(X), len(self.output_names_)), np.nan)
        whole = initial is not None and np.ndim(initial) > 0 and len(initial) == len(X)
        for group in _groups(groups, len(X)):
            begin: Any = "zero"
            if initial is not None:  # what lies behind the first rows may hold anything
                given = np.asarray(initial)[group.rows] if whole else initial
                begin = as_signal(given[: self.first_row_] if np.ndim(given) else given, "initial")
            found[group.rows] = model.simulate(self._record(X, None, [group]), initial=begin).model
        return self._shape(found)

    def score(self, X: Any, y: Any, groups: Any = None) -> float:
        """Return R² on all rows that have a prediction, the mean over outputs.

        Of the free run, or as `score_on` says.

        The free run starts from the measured outputs; one that leaves all bounds scores −inf.

        Raises:
            InputError (a ValueError): as `predict` and `simulate`, another `score_on`.
        """
        from sklearn.metrics import r2_score

        check_choice(self.score_on, SCORED_ON, "`score_on`")
        found = (
            self.simulate(X, y, groups)
            if self.score_on == "simulation"
            else self.predict(X, y, groups)
        )
        measured = self._outputs(y, len(found))
        found = found.reshape(measured.shape)
        scored = np.concatenate(
            [group.rows[self.first_row_ :] for group in _groups(groups, len(found))]
        )
        if not np.isfinite(found[scored]).all():
            return -np.inf
        return float(r2_score(measured[scored], found[scored]))

    def _layout(self, names: tuple[str, ...]) -> Layout:
        """Return the regressor, for physics that depend on it."""
        lags = _FIRST if self.lags is None else self.lags
        return lags.layout(self.output_names_, names) if isinstance(lags, Lags) else ()

    def _record(self, x: np.ndarray, y: np.ndarray | None, groups: list[Group]) -> Record:
        """Return the experiments, with outputs where they are given."""
        outputs = np.empty((len(x), 0)) if y is None else y
        experiments = [
            Experiment(
                x[group.rows],
                outputs[group.rows],
                "" if group.label is None else f"group {group.label}",
            )
            for group in groups
        ]
        named = () if y is None else self.output_names_
        return Record(input_names(self), named, self.sampling_time, tuple(experiments))  # type: ignore[arg-type]

    def _outputs(self, y: Any, rows: int) -> np.ndarray:
        """Return measured outputs (rows, n_outputs)."""
        y = as_signal(y, "y")
        if y.shape != (rows, len(self.output_names_)):
            raise InputError(
                f"`y` has the shape {y.shape}; expected {(rows, len(self.output_names_))}, "
                "rows as in X."
            )
        return y


def _groups(groups: Any, rows: int) -> Iterator[Group]:
    """Yield the experiments in order of first appearance.

    `groups` (rows,) labels them, None is one.

    Raises:
        InputError: not one label for every row.
    """
    if groups is None:
        yield Group(None, np.arange(rows))
        return
    labels = np.asarray(groups)
    if labels.shape != (rows,):
        raise InputError(
            f"`groups` has the shape {labels.shape}; expected one label for each of {rows} rows."
        )
    bare = [k for k, label in enumerate(labels.tolist()) if label is None or label != label]
    if bare:
        raise InputError(
            f"`groups` has no label at row {bare[0]}: found {labels[bare[0]]}; every row needs one."
        )
    try:
        found, first = np.unique(labels, return_index=True)
    except TypeError:
        kinds = sorted({type(label).__name__ for label in labels})
        raise InputError(
            f"`groups` mixes labels of the types {', '.join(kinds)}; take one type."
        ) from None
    for label in found[np.argsort(first)]:
        yield Group(label, np.flatnonzero(labels == label))
