"""SysIdentPy's FROLS and jax-sysid on the rows of a public set, where they are installed."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import io
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from typing import Any

import numpy as np

from orthaug._base.checks import Matrix, check_choice
from orthaug._base.errors import InputError
from orthaug.data.record import Record
from orthaug.reports.benchmark import BesideResult, ErrorResult
from orthaug.studies.public_sets import PublicSet

NONE = "none"
Simulate = Callable[[Matrix, Matrix], Matrix]
"""Inputs (N, nu) and measured outputs (N, ny) of a test give the free run (N, ny)."""


@dataclass(frozen=True)
class OtherPackage:
    """A package of others: `train` gives a free run and the number of its unknowns."""

    module: str
    train: Callable[[Record, Mapping[str, Any]], tuple[Simulate, int]]
    what: Callable[[Mapping[str, Any]], str]


def choose_packages(names: Sequence[str]) -> list[str]:
    """Return names of packages; all where none is given, none for `none`.

    Raises:
        InputError: no package of that name, or `none` beside others.
    """
    for name in names:
        check_choice(name, (*PACKAGES, NONE), "--beside")
    if NONE in names:
        if len(set(names)) > 1:
            raise InputError(f"--beside: found {', '.join(names)}; none stands alone.")
        return []
    return list(dict.fromkeys(names or PACKAGES))


def measure_beside(
    name: str, one: PublicSet, train: Record, tests: Mapping[str, tuple[Record, int]]
) -> BesideResult:
    """Train another package on the training rows of a set, and score its free run on every test.

    Args:
        tests: record and leading samples that are not scored, by test.
    """
    package, options = PACKAGES[name], one.options(name)
    if importlib.util.find_spec(package.module) is None:
        return BesideResult(package=name, text="not installed")
    own = partial(BesideResult, package=name, version=importlib.metadata.version(name))
    if options is None:
        return own(text="not compared on this set")
    began = time.monotonic()
    try:
        with redirect_stdout(io.StringIO()):  # both packages print while they train
            simulate, unknowns = package.train(train, options)
            errors = [
                error
                for test, (record, skip) in tests.items()
                for error in _errors(one, test, record, skip, simulate)
            ]
    except Exception as error:  # of a foreign package, whatever it raises
        return own(text=f"failed: {type(error).__name__}: {error}")
    seconds = time.monotonic() - began
    return own(what=package.what(options), errors=errors, unknowns=unknowns, seconds=seconds)


def _errors(
    one: PublicSet, test: str, record: Record, skip: int, simulate: Simulate
) -> list[ErrorResult]:
    """Return the RMSE over the scored rows of all experiments of a test."""
    squares = [
        (experiment.outputs - simulate(experiment.inputs, experiment.outputs))[skip:] ** 2
        for experiment in record.experiments
    ]
    rmse = np.sqrt(np.mean(np.concatenate(squares), axis=0))
    return one.errors_of(test, record.outputs, rmse)


def _train_frols(record: Record, options: Mapping[str, Any]) -> tuple[Simulate, int]:
    """Train FROLS on the first experiment, terms chosen by the BIC as the package does."""
    basis = import_module("sysidentpy.basis_function")
    structure = import_module("sysidentpy.model_structure_selection")
    estimation = import_module("sysidentpy.parameter_estimation")

    experiment, inputs = record.experiments[0], len(record.inputs)
    lags = list(range(1, options["inputs"] + 1))
    model = structure.FROLS(
        ylag=options["outputs"],
        xlag=lags if inputs == 1 else [lags] * inputs,
        basis_function=basis.Polynomial(degree=options["degree"]),
        estimator=estimation.LeastSquares(),
        order_selection=True,
        n_info_values=options["terms"],
        info_criteria="bic",
        err_tol=None,
    )
    shift = options.get("advance", 0)  # its inputs begin one sample before the output
    model.fit(X=_advanced(experiment.inputs, shift), y=experiment.outputs)
    return lambda u, y: model.predict(X=_advanced(u, shift), y=y), len(model.theta)


def _advanced(u: Matrix, samples: int) -> Matrix:
    """Return inputs so many samples earlier; the last sample is repeated at the end."""
    return u if not samples else np.concatenate([u[samples:], np.repeat(u[-1:], samples, axis=0)])


def _train_states(record: Record, options: Mapping[str, Any]) -> tuple[Simulate, int]:
    """Train a neural state space of jax-sysid, `x⁺ = A x + B u + C tanh(D x + E u + e)`.

    Adam, then L-BFGS; the initial state of a test is its own estimate, as the package makes it.
    """
    import jax.numpy as jnp

    models = import_module("jax_sysid.models")

    nx, width = options["states"], options["hidden"]
    nu, ny = len(record.inputs), len(record.outputs)
    every = [(e.inputs, e.outputs) for e in record.experiments]
    u_mean, u_std, y_mean, y_std = _scales(every)

    def next_state(x: Any, u: Any, params: Any) -> Any:  # the package gives them by name
        a, b, c, d, e, bias, *_ = params
        return a @ x + b @ u + c @ jnp.tanh(d @ x + e @ u + bias)

    def output(x: Any, u: Any, params: Any) -> Any:
        return params[6] @ x + params[7] @ u

    rng = np.random.default_rng(0)
    shapes = ((nx, nu), (nx, width), (width, nx), (width, nu), (width,), (ny, nx), (ny, nu))
    start = [0.5 * np.eye(nx), *(0.3 * rng.standard_normal(shape) for shape in shapes)]
    model = models.Model(nx, ny, nu, state_fcn=next_state, output_fcn=output)
    model.init(params=start)
    model.loss(rho_x0=1e-4, rho_th=1e-6)
    model.optimization(adam_epochs=options["adam"], lbfgs_epochs=options["lbfgs"], iprint=-1)
    scaled = [((u - u_mean) / u_std, (y - y_mean) / y_std) for u, y in every]
    model.fit([y for _, y in scaled], [u for u, _ in scaled])

    def simulate(u: Matrix, y: Matrix) -> Matrix:
        u, y = (u - u_mean) / u_std, (y - y_mean) / y_std
        first = slice(0, options["start"])
        x0 = model.learn_x0(u[first], y[first], verbosity=False)
        run, _ = model.predict(x0, u)
        return y_mean + y_std * np.asarray(run)

    return simulate, sum(int(np.size(one)) for one in model.params)


def _scales(every: Sequence[tuple[Matrix, Matrix]]) -> tuple[Any, Any, Any, Any]:
    u, y = (np.concatenate([pair[i] for pair in every]) for i in (0, 1))
    return u.mean(axis=0), u.std(axis=0), y.mean(axis=0), y.std(axis=0)


PACKAGES = {
    "sysidentpy": OtherPackage(
        "sysidentpy", _train_frols, lambda options: f"FROLS, degree {options['degree']}"
    ),
    "jax-sysid": OtherPackage(
        "jax_sysid", _train_states, lambda options: f"{options['states']} states"
    ),
}
"""By the name under which a package is installed."""
