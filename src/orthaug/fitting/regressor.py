"""Static data as a regressor of scikit-learn: physics in the columns of X, and a correction."""

from __future__ import annotations

from typing import Any

import numpy as np

from orthaug.data.record import Record
from orthaug.data.regressors import Lags
from orthaug.fitting.scikit_learn import (
    Augmented,
    Physics,
    baseline_of,
    check_arrays,
    check_there,
    checked_again,
    input_names,
    learner_of,
    output_names,
)
from orthaug.inference.covariance import prediction_std

_NOW = Lags(nb=1, nk=0)  # every column, at the row itself


class AugmentedRegressor(Augmented):
    """`y = φ(x)θ + learner(x) + e` for rows of X that have no order, as a scikit-learn regressor.

    It passes on to `estimate`, with the columns of X as inputs, and gives the same numbers. By
    default the physics is a line in every column with an intercept, and a network of 16 neurons
    adds what is not linear; θ is then that of ordinary least squares.

    Args:
        physics: "linear"; expressions of columns such as `["speed", "sin(angle)*speed**2"]`, of
            parameters theta1, theta2, …; a mapping `{"drag": "speed**2"}`; `Term`s; a `Baseline`,
            whose columns are written `speed[k]`; or a JAX function of a row (n_features,),
            returning (n_outputs, n_parameters). Columns of an array are x0, x1, …, and so are those
            whose names are no identifiers. With several outputs an expression has a parameter for
            each, `drag_y0`.
        learner: a declaration such as `MLP(hidden=(8,), inputs=("speed",))`; "auto" for `MLP()` on
            all columns; None for physics alone.
        structure: as of `estimate`; None for `Orthogonal()`.
        regularization: as of `estimate`.
        solver: as of `estimate`; None for `LevenbergMarquardt()`.
        restarts: runs from different initial weights.
        output_weights: as of `estimate`.
        random_state: seed of the initial weights; a RandomState or None draws it.

    Attributes:
        theta_: θ̂ (n_parameters,).
        theta_interval_: 95 % intervals (n_parameters, 2); None where there are none.
        coef_table_: both as a table, with names.
        noise_std_: standard deviation of the noise (n_outputs,).
        estimate_: the `Estimate`, with summary, warnings, model and splits.
        n_features_in_, feature_names_in_: columns of X.
        output_names_: the outputs as `Term`s name them.

    Examples:
        >>> import numpy as np
        >>> from orthaug.models.learners import MLP
        >>> x = np.linspace(-1, 1, 200)[:, None]
        >>> regressor = AugmentedRegressor({"gain": "x0"}, learner=MLP(hidden=(4,)))
        >>> fitted = regressor.fit(x, 2 * x[:, 0] + x[:, 0] ** 2)
        >>> f"{fitted.theta_[0]:.3f}"
        '2.000'
    """

    _ordered = False

    def __init__(
        self,
        physics: Physics = "linear",
        *,
        learner: Any = "auto",
        structure: Any = None,
        regularization: Any = "auto",
        solver: Any = None,
        restarts: int = 1,
        output_weights: Any = "auto",
        random_state: Any = 0,
    ) -> None:
        self.physics = physics
        self.learner = learner
        self.structure = structure
        self.regularization = regularization
        self.solver = solver
        self.restarts = restarts
        self.output_weights = output_weights
        self.random_state = random_state

    def fit(self, X: Any, y: Any) -> AugmentedRegressor:
        """Fit to X (n, n_features) and y (n,) or (n, n_outputs).

        Raises:
            InputError (a ValueError): data and physics that do not fit together, a column that does
                not move; RankError where the rows do not determine θ. TrainingError where training
                gives no finite model.
        """
        given = y
        X, y = check_arrays(self, X, y)
        names = input_names(self)
        outputs = output_names(given, y.shape[1], names)
        record = Record.from_arrays(X, y, inputs=names, outputs=outputs)
        baseline = baseline_of(self.physics, _NOW.layout(outputs, names), outputs, names)
        learner = learner_of(self.learner, names)
        self._estimate(record, baseline, _NOW, learner, standard_errors="unordered")
        self.output_names_ = outputs
        return self

    def predict(self, X: Any, return_std: bool = False) -> Any:
        """Return ŷ, (n,) or (n, n_outputs) as y was in the fit.

        With `return_std` also its standard error, of the same shape.

        The standard error is that of the fitted function, as a Gaussian process without a noise
        kernel gives it; a new measurement adds `noise_std_`.

        Raises:
            InputError (a ValueError): other columns than in the fit, values that are not finite, an
                expression without a value on a row; standard errors of a fit that has none.
        """
        model = self._fitted_estimate().model
        X = checked_again(self, X)
        nothing = np.zeros((len(X), len(self.output_names_)))
        record = Record.from_arrays(
            X, nothing, inputs=input_names(self), outputs=self.output_names_
        )
        response = model.predict(record).model
        check_there(response)
        if not return_std:
            return self._shape(response)
        return self._shape(response), self._shape(prediction_std(model, record)[0])
