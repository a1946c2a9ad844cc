"""Common parts of the scikit-learn estimators: base classes, columns as channels."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from orthaug._base.checks import check_count, free_name, nearest
from orthaug._base.errors import InputError, TrainingError, show
from orthaug._base.jax import jax
from orthaug.data.expressions import RESERVED, SAMPLING_TIME, is_name
from orthaug.data.record import Record
from orthaug.data.regressors import Lags, Layout
from orthaug.fitting.estimation import estimate
from orthaug.fitting.lagged_estimate import LaggedEstimate
from orthaug.fitting.solvers.levenberg_marquardt import LevenbergMarquardt
from orthaug.fitting.structures import Orthogonal
from orthaug.models.learners import MLP
from orthaug.physics.baseline import Baseline, Term

if TYPE_CHECKING:
    import pandas as pd

try:
    from sklearn.base import BaseEstimator, MultiOutputMixin, RegressorMixin  # type: ignore[assignment]
except ImportError:  # the names are there without the extra, and say so when they are used

    class MultiOutputMixin:
        """Replaces the class of scikit-learn where that is not installed."""

    class RegressorMixin:
        """Replaces the class of scikit-learn where that is not installed."""

    class BaseEstimator:
        """Replaces the class of scikit-learn where that is not installed."""

        def __new__(cls, *_: Any, **__: Any) -> Any:
            """Raise MissingDependency: scikit-learn is not installed.

            Raises:
                InputError: scikit-learn is not there.
            """
            raise InputError(f"{cls.__name__} needs scikit-learn; install orthaug[sklearn].")


Physics = str | Sequence[str | Term] | Mapping[str, str] | Baseline | Callable[[Any], Any]
_SEEN = ("inputs", "terms", "exclude")  # fields of a learner that hold expressions
_TAKEN = ("time",)  # no name of an output


class Augmented(MultiOutputMixin, RegressorMixin, BaseEstimator):
    """Physics with a learned correction, as an estimator of scikit-learn."""

    physics: Any
    learner: Any
    structure: Any
    regularization: Any
    solver: Any
    restarts: int
    output_weights: Any
    random_state: Any
    _one_column: bool
    _ordered: ClassVar[bool]

    def _estimate(
        self, record: Record, baseline: Baseline, lags: Lags | None, learner: Any, **more: Any
    ) -> None:
        """Fit, and set the attributes.

        Raises:
            InputError: as `estimate`; TrainingError where there is no finite model.
        """
        from sklearn.utils import check_random_state

        seed = self.random_state
        if seed is None or isinstance(seed, np.random.RandomState):
            seed = int(check_random_state(seed).randint(2**31 - 1))
        options: dict[str, Any] = {
            "lags": lags,
            "learner": learner,
            "regularization": self.regularization,
            **more,
        }
        options |= {"restarts": self.restarts, "output_weights": self.output_weights}
        options["structure"] = Orthogonal() if self.structure is None else self.structure
        options["solver"] = LevenbergMarquardt() if self.solver is None else self.solver
        try:
            fit = estimate(
                record, baseline, seed=check_count(seed, "random_state", least=0), **options
            )
        except InputError as error:
            if not any(f"'{name}' is constant (1)" in str(error) for name in input_names(self)):
                raise
            hint = (
                "A column of ones is what PolynomialFeatures adds first: give it "
                "include_bias=False."
            )
            raise InputError(f"{error} {hint}") from None
        if fit.model.form.first_row and not self._ordered:
            raise InputError(
                "the rows of X have no order, so there are no lags of them; use an AugmentedNARX."
            )
        if not fit.status.ok:
            raise TrainingError(fit.status.message)
        self.estimate_: LaggedEstimate = fit
        self.theta_ = fit.theta
        self.theta_interval_ = fit.interval

    @property
    def coef_table_(self) -> pd.DataFrame:
        """Table with a row per parameter: unit, initial, value, std, and the 95 % interval."""
        return self._fitted_estimate().parameters

    @property
    def noise_std_(self) -> np.ndarray | None:
        """Standard deviation of the noise of each output (n_outputs,).

        None where no degrees of freedom are left.
        """
        noise = self._fitted_estimate().model.statistics.noise
        return None if noise is None else np.sqrt(np.diag(noise))

    def set_params(self, **params: Any) -> Any:
        """Set parameters, as scikit-learn does.

        Raises:
            InputError (a ValueError): a field of a declaration, which is exchanged whole: no
                `learner__hidden`.
        """
        for name in params:
            own, field, rest = name.partition("__")
            value = getattr(self, own, None)
            if field and is_dataclass(value) and not isinstance(value, type):
                kind = type(value).__name__
                raise InputError(
                    f"`{name}`: {kind} is one object, without parameters of its own; set "
                    f'`{own}` itself, in a grid {{"{own}": [oa.{kind}({rest}=…), …]}}.'
                )
        return super().set_params(**params)  # type: ignore[misc]

    def _shape(self, values: np.ndarray) -> np.ndarray:
        """Return values (n, n_outputs) with as many axes as y had."""
        return values[:, 0] if self._one_column else values

    def _fitted_estimate(self) -> LaggedEstimate:
        """Return the estimate; NotFittedError where there is none."""
        from sklearn.utils.validation import check_is_fitted

        check_is_fitted(self, "estimate_")
        return self.estimate_


def check_arrays(estimator: Augmented, x: Any, y: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return X (n, n_features) and y (n, n_outputs) for a fit, by scikit-learn's checks.

    Raises:
        ValueError: anything but finite real numbers of two samples or more.
    """
    from sklearn.utils.validation import validate_data

    limits: dict[str, Any] = {"dtype": np.float64, "ensure_min_samples": 2}
    x, y = validate_data(estimator, x, y, multi_output=True, y_numeric=True, **limits)
    y = np.asarray(y, dtype=float)
    estimator._one_column = y.ndim == 1
    return x, y.reshape(len(y), -1)


def checked_again(estimator: Augmented, x: Any) -> np.ndarray:
    """Return X (n, n_features) with the columns that the fit had.

    Raises:
        ValueError: other columns, anything but finite real numbers.
    """
    from sklearn.utils.validation import validate_data

    return np.asarray(validate_data(estimator, x, reset=False, dtype=np.float64))


def check_there(values: np.ndarray) -> None:
    """Raise InputError for a row (n, n_outputs) on which the model has no value."""
    bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
    if bad.size:
        raise InputError(
            f"the model has no finite value at row {bad[0]} of X; check the physics there."
        )


def input_names(estimator: Any) -> tuple[str, ...]:
    """Return the columns of X as expressions name them: own names, or x0, x1, ….

    The latter where the own names cannot be used.
    """
    given = getattr(estimator, "feature_names_in_", [""] * estimator.n_features_in_)
    good = [str(name) if is_name(str(name)) else "" for name in given]
    return tuple(name or free_name(f"x{j}", good) for j, name in enumerate(good))


def output_names(y: Any, columns: int, inputs: Sequence[str]) -> tuple[str, ...]:
    """Return the outputs as expressions name them.

    Names of a Series or DataFrame, or y (y0, y1, … of several).

    Args:
        y: as the user gave it.
        columns: how many there are.
        inputs: names that are taken.
    """
    given = getattr(y, "columns", [getattr(y, "name", None)])
    named = [str(name) for name in given]
    if len(set(named)) == columns and all(
        is_name(n) and n not in (*inputs, *_TAKEN, "None") for n in named
    ):
        return tuple(named)
    return tuple(free_name("y" if columns == 1 else f"y{j}", inputs) for j in range(columns))


def at_now(text: str, names: Sequence[str]) -> str:
    """Return an expression of columns as one of channels: `speed**2` becomes `speed[k]**2`."""
    if not names or not isinstance(text, str):  # what is no text is refused where it is read
        return text
    columns = "|".join(map(re.escape, names))
    return re.sub(rf"\b({columns})\b(?!\s*\[)", r"\1[k]", text)


def learner_of(given: Any, names: Sequence[str] = ()) -> Any:
    """Return the learner of an estimator's argument; `MLP()` for "auto".

    The columns `names` in its expressions become channels.
    """
    if isinstance(given, str) and given == "auto":
        return MLP()
    if not is_dataclass(given) or isinstance(given, type):
        return given
    changed = {}
    for name in (field.name for field in fields(given)):
        value = getattr(given, name)
        if name in _SEEN and isinstance(value, tuple):
            changed[name] = tuple(at_now(text, names) for text in value)
    return replace(given, **changed) if changed else given


def baseline_of(
    physics: Any, layout: Layout, outputs: Sequence[str], names: Sequence[str] = ()
) -> Baseline:
    """Return the physics of an estimator's argument.

    Args:
        physics: "linear", expressions, `Term`s, a mapping of parameters to expressions, a
            Baseline, or a JAX function.
        layout: the regressor, for "linear" and for a function.
        outputs: with several, every expression has a parameter of its own for each, `gain_y0`.
        names: columns that expressions may use without an instant.

    Raises:
        InputError: none of these.
    """
    if isinstance(physics, Baseline):
        return physics
    if callable(physics) and not isinstance(physics, type):
        shape = np.shape(jax.eval_shape(physics, jax.ShapeDtypeStruct((len(layout),), float)))
        if len(shape) != 2 or shape[0] != len(outputs):
            raise InputError(
                f"the physics function returned shape {shape} for one row; "
                f"expected (n_outputs, n_parameters), n_outputs = {len(outputs)}."
            )
        return Baseline.from_function(physics, [f"theta{i + 1}" for i in range(shape[1])])
    if isinstance(physics, str) and physics == "linear":
        line = {
            (f"{lag.channel}_{lag.lag}" if lag.lag else lag.channel): str(lag) for lag in layout
        }
        physics = {free_name("intercept", [*line]): "1"} | line
    elif (
        not isinstance(physics, str)
        and isinstance(physics, Sequence)
        and all(isinstance(t, str) for t in physics)
    ):
        physics = {f"theta{i + 1}": text for i, text in enumerate(physics)}
    if isinstance(physics, Mapping) and all(isinstance(text, str) for text in physics.values()):
        several = len(outputs) > 1
        physics = [
            Term(f"{parameter}_{output}" if several else parameter, text, output=output)
            for parameter, text in physics.items()
            for output in outputs
        ]
    if (
        isinstance(physics, str)
        or not isinstance(physics, Sequence)
        or not all(isinstance(t, Term) for t in physics)
    ):
        raise InputError(
            "`physics` must be 'linear', a list of expressions or Terms, a mapping of "
            "parameters to expressions, a Baseline, or a function of a row; got "
            f"{show(physics)}."
        )
    for term in physics:
        _check_columns(term.regressor, names)
    return Baseline.from_terms([replace(t, regressor=at_now(t.regressor, names)) for t in physics])


def _check_columns(text: Any, names: Sequence[str]) -> None:
    """Raise InputError for a name in an expression that is not a column."""
    found = (
        re.findall(r"(?<![\w.])[A-Za-z_]\w*\b(?!\s*[\[(])", text)
        if names and isinstance(text, str)
        else []
    )
    for name in found:
        if name not in (*names, *RESERVED, SAMPLING_TIME):
            known = ", ".join(names)
            raise InputError(
                f"physics '{text}': unknown column '{name}'{nearest(name, names)}; the columns "
                f"are {known}."
            )
