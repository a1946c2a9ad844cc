"""What residuals say about the noise: the verdicts on systems whose noise is known, and what their texts tell."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from functools import cache, partial
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import lfilter

import orthaug as oa
from orthaug import (
    MLP,
    Additive,
    Baseline,
    Channel,
    Lags,
    LevenbergMarquardt,
    Model,
    Prediction,
    Record,
    Simulation,
    Term,
    diagnose,
    estimate,
    synthetic,
)
from orthaug.analysis.findings import DiagnosisResult
from orthaug.analysis.predictability import Predictable
from orthaug.analysis.verdict_text import _shares
from orthaug.fitting.held_out import Candidate, Focus
from orthaug.fitting.inconsistency import inconsistency

estimate = partial(estimate, standard_errors="plain")  # robust ones are asked for here

PHYSICS = Baseline.from_terms([Term("a", "y[k-1]"), Term("b", "y[k-2]"), Term("g", "u[k-1]")])
EVIDENCE = {
    "learner": MLP(hidden=(8,)),
    "regularization": "evidence",
    "solver": LevenbergMarquardt(100),
}
MISSING = {
    "cubic": lambda y, u, k: -0.02 * y[k - 1] ** 3,
    "lag of u": lambda y, u, k: 0.5 * u[k - 2],
    "lag of y": lambda y, u, k: 0.15 * y[k - 3],
    "cubic of u": lambda y, u, k: 0.2 * u[k - 1] ** 3,
    "hardly a lag of u": lambda y, u, k: 0.015 * u[k - 2],
}
HELPS = {"cubic": "learner", "lag of u": "u[k-2]", "lag of y": "y[k-3]", "cubic of u": "learner"}


def second_order(seed, rows=800, equation=0.0, sensor=0.0, missing=None, hold=1):
    """A second-order system under white noise of deviation 1, after its start; noise in the equation or the sensor."""
    rng = np.random.default_rng([7, seed])
    u = np.repeat(rng.normal(size=rows // hold + 60), hold)[: rows + 50]
    e, y = equation * rng.normal(size=rows + 50), np.zeros(rows + 50)
    for k in range(3, rows + 50):
        y[k] = 1.5 * y[k - 1] - 0.7 * y[k - 2] + u[k - 1] + e[k]
        y[k] += MISSING[missing](y, u, k) if missing else 0.0
    return Record.from_arrays(
        u[50:], (y + sensor * rng.normal(size=rows + 50))[50:], sampling_time=0.1
    )


@cache
def spring(rows, seed):
    """A mass-spring-damper by backward Euler at 2 ms, measured with 30 dB of noise."""
    m, c, k, step = 1.0, 100.0, 1000.0, 0.002
    gamma = m + c * step + k * step**2
    rng = np.random.default_rng(seed)
    u, y = rng.normal(0, 100, rows), np.zeros(rows)
    for i in range(2, rows):
        y[i] = ((2 * m + c * step) * y[i - 1] - m * y[i - 2] + step**2 * u[i - 1]) / gamma
    return Record.from_arrays(u, y + rng.normal(0, y.std() * 10**-1.5, rows), sampling_time=step)


def of(record, physics=PHYSICS, **options):
    """The diagnosis of a fit, of the physics alone unless told otherwise, which must be JSON without NaN."""
    found = diagnose(estimate(record, physics, **{"learner": None, **options}))
    assert json.loads(DiagnosisResult.model_validate(found).to_json())["verdict"] == found.verdict
    return found


# --- the verdicts


@pytest.mark.parametrize("seed", range(4))
def test_white_noise_on_a_static_map(seed):
    u, e = np.random.default_rng(seed).normal(size=(2, 400))
    found = of(Record.from_arrays(u, 2 * u + 0.1 * e), Baseline.from_terms([Term("gain", "u[k]")]))
    assert (found.verdict, found.warnings, found.free_run, found.ratio) == ("white", (), None, None)
    assert "residual is white: the intervals hold" in found.text


def test_a_missing_square_of_a_static_map_is_unmodelled():
    """The residual of independent samples is white whatever is missing: it depends nonlinearly on the input."""
    example = synthetic.static(1, noise=True)
    found = of(example.train, example.baseline)
    assert found.one_step[0].curved_regressors == ("u[k]",)
    assert found.verdict == "unmodelled" and "depends nonlinearly on u[k]" in found.text


def test_what_no_single_input_shows_is_found_between_neighbours():
    """An interaction whose mean over each input is flat, of independent samples: neither lags nor curves see it."""
    a, b, e = np.random.default_rng(0).uniform(-1, 1, (3, 800))
    physics = Baseline.from_terms([Term("a", "a[k]"), Term("b", "b[k]")])
    u, names = np.column_stack([a, b]), ["a", "b"]
    found = of(
        Record.from_arrays(u, a - 2 * b + np.sin(4 * a) * b + 0.05 * e, inputs=names), physics
    )
    assert found.one_step[0].white and not found.one_step[0].curved_regressors
    assert found.verdict == "unmodelled" and found.predictable[0].functions > 0.9
    assert found.changes[0].kind == "learner" and found.changes[0].fall > 0.7
    noise = of(Record.from_arrays(u, a - 2 * b + 0.05 * e, inputs=names), physics)
    # Two standard errors are exceeded by chance, and then by little
    assert noise.verdict == "white" and noise.predictable[0].functions < 0.02


@pytest.mark.parametrize("noise", [0.01, 0.1, 1.0])
@pytest.mark.parametrize("seed", [0, 1, 3])
def test_equation_noise(seed, noise):
    found = of(second_order(seed, equation=noise))
    assert (found.verdict, found.warnings, found.changes) == ("equation_noise", (), ())
    assert found.one_step[0].white and not found.free_run[0].white and found.ratio > 2
    assert "the noise enters the equation" in found.text and "precise" not in found.text


def test_equation_noise_with_a_learner():
    assert of(second_order(0, equation=0.1), **EVIDENCE).verdict == "equation_noise"


@pytest.mark.parametrize("seed", range(4))
def test_sensor_noise(seed):
    found = of(second_order(seed, sensor=0.3))
    assert found.verdict == "sensor_noise" and found.ratio < 1
    change = found.changes[0]
    assert (change.kind, change.what, change.of) == ("criterion", "simulation", "simulation")
    assert (
        f"predicted to lower the error of the free run by {100 * change.fall:.2g} %" in found.text
    )


@pytest.mark.parametrize(
    ("rows", "seed"),
    [
        (4000, 0),
        (10000, 0),
        *(
            pytest.param(*draw, marks=pytest.mark.proof)
            for draw in ((4000, 1), (4000, 8), (6000, 2), (10000, 1))
        ),
    ],
)
def test_sensor_noise_of_the_mass_spring_damper(rows, seed):
    assert of(spring(rows, seed)).verdict == "sensor_noise"


@pytest.mark.parametrize(
    ("rows", "seed"),
    [
        (4000, 0),
        (10000, 0),
        *(
            pytest.param(*draw, marks=pytest.mark.proof)
            for draw in ((4000, 2), (4000, 5), (10000, 1))
        ),
    ],
)
def test_sensor_noise_of_the_mass_spring_damper_with_a_learner(rows, seed):
    assert of(spring(rows, seed), **EVIDENCE).verdict == "sensor_noise"


@pytest.mark.parametrize("missing", HELPS)
@pytest.mark.parametrize("seed", range(3))
def test_what_the_physics_lacks_is_unmodelled_and_named(missing, seed):
    found = of(second_order(seed, equation=0.1, missing=missing))
    assert (found.verdict, found.noise_in_lags) == ("unmodelled", None)
    change = found.changes[0]
    assert HELPS[missing] in (change.kind, change.what) and change.of == "prediction"
    assert f"is predicted to fall by {100 * change.fall:.2g} %." in found.text


@pytest.mark.parametrize(("missing", "learner"), [("lag of u", None), ("cubic", MLP(hidden=(8,)))])
def test_the_change_lowers_the_error_elsewhere_by_as_much_as_predicted(missing, learner):
    given, other = (second_order(seed, 1500, equation=0.1, missing=missing) for seed in (0, 1))
    change = of(given).changes[0]
    terms = (
        PHYSICS if learner else Baseline.from_terms([*PHYSICS.terms, Term("further", change.what)])
    )
    fits = [
        estimate(given, p, learner=n, solver=LevenbergMarquardt(60))
        for p, n in ((PHYSICS, None), (terms, learner))
    ]
    before, after = (fit.model.predict(other).scores().rmse[0] for fit in fits)
    assert 1 - after / before == pytest.approx(change.fall, abs=0.05)


def test_a_lag_that_explains_hardly_anything_is_not_called_unmodelled():
    """The tests reject on 20 000 rows; less than 1 % of the residual's variance could be predicted."""
    found = of(second_order(0, 20000, equation=0.1, missing="hardly a lag of u"))
    assert found.one_step[0].correlated_inputs == ("u",) and found.one_step[0].largest_cross > 0.05
    assert (found.verdict, found.changes) == ("equation_noise", ())
    assert 0.002 < found.predictable[0].inputs < 0.02
    assert "is noise by all tests" in found.text and "it is the noise floor" in found.text


def test_coloured_noise_on_the_sensor_is_not_unmodelled_on_the_free_run():
    """What could be predicted of it from its own past is of no use to a free run."""
    given, rng = second_order(0, 1500), np.random.default_rng(5)
    noise = lfilter([0.2], [1.0, -0.9], rng.normal(size=1500))
    record = Record.from_arrays(
        given.experiments[0].inputs, given.experiments[0].outputs[:, 0] + noise
    )
    found = of(record, criterion=Simulation(0, 40))
    assert found.verdict == "equation_noise" and found.changes == ()
    assert (
        found.predictable[0].own_past > 0.6
        and "Its autocorrelation is that of the noise" in found.text
    )


def friction(seed, rows=1500):
    """An integrator behind a lag with dry friction, the output in steps of 0.01."""
    rng = np.random.default_rng([9, seed])
    u = np.repeat(rng.uniform(-8, 8, rows // 30 + 1), 30)[:rows]
    y, w = np.zeros(rows), 0.0
    for k in range(1, rows):
        w += 0.1 * (u[k - 1] - w - 2.4 * np.tanh(w / 0.1))
        y[k] = y[k - 1] + 0.1 * w
    return Record.from_arrays(u, np.floor(y / 0.01) * 0.01, sampling_time=0.1)


def test_a_free_run_that_follows_its_inputs_is_no_noise_however_white_one_step_is():
    terms = [*PHYSICS.terms, Term("h", "u[k-2]"), Term("c", "1")]
    found = of(friction(1), Baseline.from_terms(terms), criterion=Simulation(0, 100))
    assert found.one_step[0].practically_white() and found.free_run[0].curved_over(0.05) == [
        "u[k-1]"
    ]
    assert (
        found.verdict == "unmodelled"
        and "depends nonlinearly on u[k-1]" in found.text
        and "noise floor" not in found.text
    )
    assert "the effect of u[k-1] has a form that was not tried" in found.text


def test_a_free_run_that_drifts_is_no_noise():
    """A random walk on the sensor: the physics is right, yet its own past tells nearly all of the error."""
    given, rng = second_order(0, 1500), np.random.default_rng(6)
    walk = 0.01 * np.cumsum(rng.normal(size=1500))
    record = Record.from_arrays(
        given.experiments[0].inputs, given.experiments[0].outputs[:, 0] + walk
    )
    found = of(record, criterion=Simulation(0, 40))
    assert found.predictable[0].own_past > 0.9 and found.verdict == "unmodelled"
    assert "the error drifts" in found.text and "noise floor" not in found.text


@pytest.mark.parametrize("seed", range(3))
def test_a_missing_cubic_under_a_held_input_is_unmodelled(seed):
    assert of(second_order(seed, equation=0.02, missing="cubic", hold=20)).verdict == "unmodelled"


def test_a_learner_that_finds_the_cubic_leaves_the_equation_noise():
    given = {"learner": MLP(hidden=(8,)), "solver": LevenbergMarquardt(60)}
    assert (
        of(second_order(0, 1500, equation=0.1, missing="cubic"), **given).verdict
        == "equation_noise"
    )


# --- the texts


@pytest.mark.parametrize(
    "options", [{"sensor": 0.3}, {"equation": 0.1, "missing": "lag of u"}], ids=str
)
def test_the_text_names_the_largest_autocorrelation(options):
    found = of(second_order(0, **options))
    assert f"its autocorrelation reaches {found.one_step[0].largest_acf:.2f}" in found.text


def two_inputs(own):
    """The physics knows one lag of u1 and u2, the system has a second one of u2; `own` is the share of y[k-1]."""
    rng = np.random.default_rng(0)
    u, y = rng.normal(size=(900, 2)), np.zeros(900)
    for k in range(2, 900):
        y[k] = own * y[k - 1] + u[k - 1, 0] + u[k - 1, 1] + 0.5 * u[k - 2, 1] + 0.1 * rng.normal()
    physics = Baseline.from_terms([Term("a", "y[k-1]"), Term("g", "u1[k-1]"), Term("h", "u2[k-1]")])
    return of(Record.from_arrays(u, y), physics)


def test_the_text_names_the_inputs_that_are_followed():
    found = two_inputs(0.8)
    assert "u2" in found.one_step[0].correlated_inputs
    for name in ("u1", "u2"):
        assert (f"y still follows {name}" in found.text) == (name in found.one_step[0].follows())


def test_a_missing_lag_is_no_sensor_noise_where_the_output_hardly_feeds_back():
    """The free run is then as good as the prediction, but what it leaves follows the input."""
    assert two_inputs(0.0).verdict == "unmodelled"


def test_the_text_names_the_regressor_over_which_the_residual_is_curved():
    found = of(second_order(0, equation=0.1, missing="cubic"))
    assert "y[k-1]" in found.one_step[0].curved_regressors
    assert "depends nonlinearly on y[k-1]" in found.text


def test_an_unmodelled_residual_is_reported_with_its_size_and_advice():
    found = of(second_order(0, equation=0.1, missing="lag of u"))
    share = (
        100
        * found.one_step[0].rms
        / second_order(0, equation=0.1, missing="lag of u").experiments[0].outputs.std()
    )
    assert f"residual, {share:.2g} % of the output's deviation" in found.text
    assert (
        "With the further input lag u[k-2] in the physics (or the learner) its error one step ahead"
        in found.text
    )
    assert "coloured" in dict(found.warnings)["inconsistent"]


def test_a_coloured_disturbance_biases_the_one_step_parameters_and_is_reported():
    """The physics is complete; y_{k−1} holds what the disturbance e_{k−1} tells of e_k."""
    rng = np.random.default_rng(5)
    u, e, y = np.repeat(rng.normal(size=500), 4), np.zeros(2000), np.zeros(2000)
    for k in range(2, 2000):
        e[k] = 0.9 * e[k - 1] + 0.02 * rng.normal()
        y[k] = 1.5 * y[k - 1] - 0.7 * y[k - 2] + u[k - 1] + e[k]
    one, two = (of(Record.from_arrays(u, y), criterion=c) for c in (Prediction(), Simulation()))
    found = dict(one.warnings)["inconsistent"]
    assert (
        "one-step θ is inconsistent" in found
        and "standard errors away" in found
        and 'focus = "simulation"' in found
    )
    compared = tuple(Candidate(focus, False, 0.3) for focus in ("prediction", "simulation"))
    fit = estimate(Record.from_arrays(u, y), PHYSICS, learner=None, criterion=Prediction())
    after = diagnose(replace(fit, focus=Focus("prediction", "", compared)))
    found = dict(after.warnings)["inconsistent"]  # the free run was no better: not advised again
    assert 'focus = "simulation"' not in found
    assert 'a noise model ([noise] model = "auto"): training on the free run was tried' in found
    assert not any("one-step θ" in warning.text for warning in two.warnings)
    assert of(second_order(0, equation=0.1)).warnings == ()


def noisy_equation(seed, colour, rows=3000, delta=0.0):
    """A second-order system under AR(1) noise in its equation, y = 1.35 y₁ − 0.48 y₂ + 0.5 u + δ(v) + e."""
    rng = np.random.default_rng([11, seed])
    u, white, e, y = (
        rng.normal(size=rows),
        0.3 * rng.normal(size=rows),
        np.zeros(rows),
        np.zeros(rows),
    )
    for k in range(2, rows):
        e[k] = colour * e[k - 1] + white[k]
        v = y[k - 1] - y[k - 2]
        y[k] = 1.35 * y[k - 1] - 0.48 * y[k - 2] + 0.5 * u[k - 1] + delta * np.tanh(3 * v) + e[k]
    return Record.from_arrays(u, y)


def test_weak_colour_in_the_equation_is_inconsistent_in_standard_errors():
    """AR(0.2) leaves a residual that is nearly white; θ is six standard errors off, and the cures give its values."""
    for seed in range(3):
        fit = estimate(noisy_equation(seed, 0.2), PHYSICS, learner=None)
        for one in (fit, fit.robust()):  # standard errors of another kind do not silence it
            found = diagnose(one)
            text = dict(found.warnings)["inconsistent"]
            assert "the intervals hold" not in found.text and "`inconsistent`" in found.text
            assert (
                "standard errors away" in text
                and "Instrumental variables" in text
                and 'focus = "simulation"' in text
            )
        tested = inconsistency(
            fit, fit.model.predict(fit.problem.record), fit.model.simulate(fit.problem.record)
        )
        assert abs(tested.apart[0]) > 3 and tested.moved[0] == 0
        for value, std in (
            (tested.modelled, tested.modelled_std),
            (tested.instruments, tested.instruments_std),
        ):
            assert abs(value[0] - 1.35) < 3 * std[0] < 0.05 < 10 * abs(fit.theta[0] - 1.35)


def test_white_noise_in_the_equation_is_consistent():
    p = []
    for seed in range(40):
        fit = estimate(noisy_equation(seed, 0.0, rows=500), PHYSICS, learner=None)
        p.append(inconsistency(fit, fit.model.predict(fit.problem.record)).found)
    assert np.mean(p) <= 0.075  # 1.2 of 40 are expected


def test_a_learner_is_partialled_out_before_the_colour_is_looked_for():
    def found(colour):
        sees = MLP((4,), inputs=("y[k-1] - y[k-2]",))
        fit = estimate(
            noisy_equation(1, colour, delta=0.2),
            PHYSICS,
            learner=sees,
            criterion=Prediction(),
            restarts=1,
        )
        return inconsistency(
            fit, fit.model.predict(fit.problem.record), fit.model.simulate(fit.problem.record)
        )

    white, coloured = found(0.0), found(0.2)
    assert not white.found and coloured.found and coloured.instruments is not None
    assert abs(coloured.modelled[2] - 0.5) < 4 * coloured.modelled_std[2]


# --- the criterion that sensor noise asks for


def test_the_physics_alone_may_start_earlier_than_the_model():
    """The physics reads two lags and the learner four: both are tested on the rows that the model predicts."""
    learned = {
        "learner": MLP(hidden=(3,)),
        "lags": Lags(na=4, nb=4),
        "solver": LevenbergMarquardt(30),
    }
    found = of(second_order(0, sensor=0.3), **learned)
    assert found.verdict == "sensor_noise" and found.one_step[0].n == 796


def told(diagnosis):
    """A diagnosis as a result tells it."""
    return DiagnosisResult.model_validate(diagnosis).content()


def test_responses_that_exist_are_not_computed_again(monkeypatch):
    fit = estimate(second_order(1, equation=0.1), PHYSICS, learner=None)
    responses = {
        "one_step": fit.model.predict(fit.problem.record),
        "free_run": fit.model.simulate(fit.problem.record),
    }
    plain = told(diagnose(fit))
    for verb in ("predict", "simulate"):
        monkeypatch.setattr(Model, verb, lambda *_: pytest.fail("computed again"))
    assert told(diagnose(fit, **responses)) == plain


def test_one_step_with_sensor_noise_is_a_warning_that_names_the_criterion():
    found = of(second_order(0, sensor=0.3))
    (warning,) = found.warnings
    assert warning.code == "sensor_noise" and "intervals do not cover" in warning.text
    assert 'focus = "simulation"' in warning.text
    assert 'those of focus = "simulation" are not' in found.text and "inconsistent" in found.text


@pytest.mark.parametrize(("step", "told"), [(0.3, True), (0.02, False), (None, False)])
def test_steps_of_an_output_are_reported_where_the_one_step_error_has_their_size(step, told):
    """Slow motion in coarse steps, as an encoder tells it; finer ones than the noise are no cause."""
    rng = np.random.default_rng(4)
    u, y = np.repeat(rng.normal(size=60), 30), np.zeros(1800)
    for k in range(2, 1800):
        y[k] = 1.9 * y[k - 1] - 0.905 * y[k - 2] + 0.005 * u[k - 1]
    y = y + (0.05 * rng.normal(size=1800) if step == 0.02 else 0.0)
    y = (
        y + 0.001 * lfilter([1.0, 0.5], [1.0], rng.normal(size=1800))
        if step is None
        else np.round(y / step) * step
    )
    found = of(Record.from_arrays(u, y, sampling_time=0.1))
    assert not found.one_step[0].practically_white()
    assert (found.steps is not None) is told and ("measured in steps of 0.3" in found.text) is told
    if told:
        assert found.steps == {"y": pytest.approx(0.3)} and "a finer measurement" in found.text


def test_sampling_too_fast_is_reported():
    found = of(spring(10000, 0))
    assert found.noise_in_lags > 0.2 and "too fast for one-step estimation" in found.text


def test_sampling_that_is_not_too_fast_is_not_blamed():
    found = of(second_order(0, sensor=0.03))
    assert (
        found.verdict == "sensor_noise"
        and found.noise_in_lags < 0.05
        and "too fast" not in found.text
    )


SIMULATED = {
    "second order": lambda: of(second_order(0, sensor=0.3), criterion=Simulation(0, 40)),
    "mass-spring-damper": lambda: of(spring(4000, 0), criterion=Simulation(0, 100)),
    "in segments": lambda: of(spring(4000, 0), criterion=Simulation(512, 100)),
}


@pytest.mark.parametrize("given", SIMULATED)
def test_trained_on_the_free_run_there_is_no_warning(given):
    """The noise of the sensor is white in the free run, once its start is forgotten."""
    found = SIMULATED[given]()
    assert found.verdict == "sensor_noise" and found.warnings == ()
    assert (
        "simulation criterion is the right one" in found.text and "inconsistent" not in found.text
    )


@pytest.mark.parametrize("missing", ["lag of u", "cubic"])
def test_trained_on_the_free_run_what_is_missing_is_no_sensor_noise(missing):
    assert (
        of(second_order(1, equation=0.1, missing=missing), criterion=Simulation(0, 40)).verdict
        == "unmodelled"
    )


def test_a_free_run_trained_on_equation_noise_names_the_one_step_criterion():
    found = of(second_order(1, equation=0.1), criterion=Simulation(0, 40))
    assert (
        found.verdict == "equation_noise"
        and "The one-step criterion is the more precise one here" in found.text
    )
    (warning,) = found.warnings
    assert warning.code == "coloured_residual" and "standard errors of θ" in warning.text
    assert "errors of the free run are coloured" in warning.text


def test_several_steps_ahead_count_as_trained_on_the_free_run():
    found = of(second_order(0, sensor=0.3), criterion=Prediction(20))
    assert found.verdict == "sensor_noise" and "inconsistent" not in found.text


def test_without_standard_errors_nothing_is_said_about_intervals():
    learned = {
        "learner": MLP(hidden=(3,)),
        "structure": Additive(),
        "solver": LevenbergMarquardt(10),
    }
    found = of(second_order(0, sensor=0.3), **learned)
    assert (found.verdict, found.warnings) == ("sensor_noise", ())


@pytest.mark.parametrize("rows", [5, 12])
def test_too_few_rows_to_test_are_not_called_white(rows):
    fit = estimate(second_order(0, rows, equation=0.1), PHYSICS, learner=None)
    assert diagnose(fit) is None  # not tested


# --- shapes of records


def two_outputs(seed, equation=0.0, sensor=0.0, rows=900):
    """y2 drives y1; returns the record."""
    rng = np.random.default_rng(seed)
    u, y, e = rng.normal(size=(rows, 2)), np.zeros((rows, 2)), rng.normal(size=(2, rows, 2))
    for k in range(1, rows):
        y[k, 0] = 0.8 * y[k - 1, 0] + 0.4 * y[k - 1, 1] + u[k - 1, 0]
        y[k, 1] = 0.5 * y[k - 1, 1] + u[k - 1, 1]
        y[k] += equation * e[0, k]
    return Record.from_arrays(u, y + sensor * e[1])


TWO = {
    "a": Term("a", "y1[k-1]", output="y1"),
    "b": Term("b", "y2[k-1]", output="y1"),
    "c": Term("c", "u1[k-1]", output="y1"),
    "d": Term("d", "y2[k-1]", output="y2"),
    "e": Term("e", "u2[k-1]", output="y2"),
}


@pytest.mark.parametrize(
    ("noise", "verdict"), [("equation", "equation_noise"), ("sensor", "sensor_noise")]
)
def test_two_outputs(noise, verdict):
    found = of(two_outputs(0, **{noise: 0.5}), Baseline.from_terms(list(TWO.values())))
    assert found.verdict == verdict
    assert (
        [test.name for test in found.one_step]
        == [test.name for test in found.free_run]
        == ["y1", "y2"]
    )


def test_two_outputs_without_their_coupling_name_the_one_that_lacks_it():
    physics = Baseline.from_terms([term for name, term in TWO.items() if name != "b"])
    found = of(two_outputs(0, equation=0.1), physics)
    assert found.verdict == "unmodelled"
    assert "y1 still follows u2" in found.text and "y2 still follows" not in found.text


@pytest.mark.parametrize(
    ("noise", "verdict"), [("equation", "equation_noise"), ("sensor", "sensor_noise")]
)
def test_several_experiments(noise, verdict):
    lengths = (400, 40, 500, 7, 3)
    found = of(Record.join([second_order(i, n, **{noise: 0.3}) for i, n in enumerate(lengths)]))
    assert found.verdict == verdict
    assert found.one_step[0].n == sum(n - 2 for n in lengths)


def test_a_free_run_that_diverges():
    """Feedback holds an unstable plant: a free run under the recorded input does not stay with it."""
    rng = np.random.default_rng(0)
    u, y = np.zeros(150), np.zeros(150)
    for k in range(1, 150):
        u[k - 1] = -1.7 * y[k - 1] + rng.normal()
        y[k] = 2 * y[k - 1] + u[k - 1] + 0.1 * rng.normal()
    found = of(
        Record.from_arrays(u, y), Baseline.from_terms([Term("a", "y[k-1]"), Term("g", "u[k-1]")])
    )
    content = DiagnosisResult.model_validate(found).content()
    assert (
        found.free_run is None and content["free_run"] is None and content["noise_in_lags"] is None
    )
    assert found.verdict == "equation_noise"


def test_no_input():
    e, y = np.random.default_rng(1).normal(size=600), np.zeros(600)
    for k in range(2, 600):
        y[k] = 1.5 * y[k - 1] - 0.7 * y[k - 2] + e[k]
    assert (
        of(Record.from_arrays(None, y), Baseline.from_terms(list(PHYSICS.terms[:2]))).verdict
        == "equation_noise"
    )


def test_shares_are_reported_of_the_output_that_follows_something():
    """Of two outputs of which nothing could be predicted, the one whose residual tests reject."""

    def test_of(name, followed):
        return SimpleNamespace(name=name, follows=lambda: followed, curved_over=lambda share: [])

    record = SimpleNamespace(outputs=[Channel("p", "Pa"), Channel("T", "K")])
    seen = SimpleNamespace(
        predictable=[Predictable(name, 1.0, 0.0, 0.0, 0.0) for name in ("p", "T")],
        own=[test_of("p", []), test_of("T", ["q"])],
        fit=SimpleNamespace(problem=SimpleNamespace(record=record)),
    )
    assert _shares(seen).startswith(
        "The predictable share of its variance of T is 0 %"
    ) and "0 K at most" in _shares(seen)


@pytest.mark.parametrize("noise", [0.02, 0.0])
def test_noise_in_the_measured_start_is_no_drift(noise):
    """The right physics of a slow plant was called unmodelled, since its free run began at noisy rows."""
    rng = np.random.default_rng(4)
    u, y = np.repeat(rng.uniform(-1, 1, 30), 40), np.zeros(1200)
    for k in range(2, 1200):
        y[k] = 1.97 * y[k - 1] - 0.9705 * y[k - 2] + 5e-4 * u[k - 1]
    record = oa.Record.from_arrays(u, y + noise * rng.normal(size=1200), sampling_time=1.0)
    lags = {"a1": "y[k-1]", "a2": "y[k-2]", "b": "u[k-1]"}
    physics = oa.Baseline.from_terms([oa.Term(*term) for term in lags.items()])
    fit = oa.estimate(record, physics, learner=None, criterion=oa.Simulation())
    found = oa.diagnose(fit)
    named = [one.code for one in found.warnings] if found is not None else []
    assert "drift" not in named
    assert (noise > 0) == ("noisy_start" in named)
    assert not noise or found.verdict == "sensor_noise"


@pytest.mark.parametrize("learner", [None, oa.MLP((3,), inputs=("y[k-1]",))])
@pytest.mark.parametrize("exchanged", [True, False])
def test_two_inputs_that_are_exchanged_are_named(exchanged, learner):
    """A fit with the columns of two inputs exchanged was explained by a later input and a learner."""
    rng, n = np.random.default_rng(16), 800
    u, w = np.repeat(rng.uniform(-1, 1, n // 5), 5), rng.uniform(0, 1, n)
    y, e = np.zeros(n), 0.01 * rng.normal(size=n)
    for k in range(2, n):
        y[k] = 1.5 * y[k - 1] - 0.62 * y[k - 2] + 0.3 * u[k - 2] + 0.15 * w[k - 1] + e[k]
        y[k] -= 0.03 * y[k - 1] * abs(y[k - 1])
    columns = np.column_stack([w, u] if exchanged else [u, w])
    record = oa.Record.from_arrays(columns, y, inputs=["u", "w"], outputs=["y"])
    terms = {"a1": "y[k-1]", "a2": "y[k-2]", "b": "u[k-2]", "d": "w[k-1]"}
    physics = oa.Baseline.from_terms([oa.Term(*term) for term in terms.items()])
    fit = oa.estimate(record, physics, learner=learner, criterion=oa.Prediction())
    found = {one.code: one.text for one in fit.diagnose(blocks=0).warnings}
    assert ("exchanged_inputs" in found) == exchanged
    assert not exchanged or found["exchanged_inputs"].startswith("u and w may be exchanged")


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_reversed_input_is_named_where_the_start_makes_much_of_the_deviation(sign):
    """Physics alone leaves less than half of the deviation: inputs counted as right."""
    rng, n = np.random.default_rng(5), 300
    slope = np.sign(np.sin(2 * np.pi * np.arange(n) / 60 + 0.4)) + 0.1 * rng.normal(size=n)
    x, v, place = 0.0, 1.0, []
    for u in slope:
        place.append(x)
        for _ in range(5):
            v += 0.01 * (2 * u - 0.5 * v)
            x += 0.01 * v
    record = oa.Record.from_arrays(
        sign * slope,
        np.array(place) + 0.002 * rng.normal(size=n),
        sampling_time=0.05,
        inputs=["slope"],
        outputs=["x"],
    )
    motion = oa.Motion.from_equations(
        [oa.State("x", "v", "x"), oa.State("v", "K*slope - c*v", "derivative of x")],
        [oa.Output("x", "x")],
        [oa.PhysicalParameter("K", 1.4, min=0), oa.PhysicalParameter("c", 0.3, min=0)],
        ["slope"],
    )
    fit = oa.estimate(record, motion, learner=None)
    assert fit.model.simulate(record).scores().fit[0] > 50  # for either sign
    codes = {one.code for one in fit.diagnose(blocks=0).warnings}
    assert ("reversed_input" in codes) == (sign < 0) and "dead_time" not in codes


def heated(u: np.ndarray, noise: float = 0.01) -> np.ndarray:
    """A body's temperature under a heater and ambient air, both (N, 2), in steps of 1 s."""
    rng, x, y = np.random.default_rng(6), 2.0, []
    for power, air in u:
        y.append(x)
        x += 0.15 * power - 0.05 * (x - air)
    return np.array(y) + noise * rng.normal(size=len(y))


@pytest.mark.parametrize(
    ("read", "code", "said"),
    [
        ([[-1, 0], [0, 1]], "reversed_input", "heat may have the other sign: so read, physics"),
        ([[0, 1], [1, 0]], "exchanged_inputs", "heat and air may be exchanged: so read, physics"),
        ([[1, 0], [0, 1]], None, ""),
    ],
)
def test_inputs_of_a_motion_that_are_misread_are_named(read, code, said):
    rng = np.random.default_rng(2)
    u = np.column_stack(
        [np.repeat(rng.uniform(0, 6, 25), 16), np.repeat(rng.uniform(0, 4, 10), 40)]
    )
    record = oa.Record.from_arrays(
        u @ np.array(read), heated(u), sampling_time=1.0, inputs=["heat", "air"], outputs=["y"]
    )
    parameters = [oa.PhysicalParameter("b", 0.1, min=0), oa.PhysicalParameter("k", 0.1, min=0)]
    motion = oa.Motion.from_equations(
        [oa.State("x", "b*heat - k*(x - air)", "y")],
        [oa.Output("y", "x")],
        parameters,
        ["heat", "air"],
    )
    found = oa.estimate(record, motion, learner=None).diagnose()
    texts = {w.code: w.text for w in found.warnings}
    assert code is None or texts[code].startswith(said)
    assert {"reversed_input", "exchanged_inputs"} & texts.keys() == ({code} if code else set())
    if code == "reversed_input":
        assert "Most likely an input is misread: heat may have the other" in found.residuals.text


def clipped(record: oa.Record, channel: str, limit: float) -> oa.Record:
    """The record with one channel clipped to ±limit, as by a sensor whose range ends there."""
    u, y = record.experiments[0].inputs[:, 0], record.experiments[0].outputs[:, 0]
    u, y = (np.clip(x, -limit, limit) if n == channel else x for n, x in (("u", u), ("y", y)))
    return Record.from_arrays(u, y, sampling_time=record.sampling_time)


def test_samples_at_a_limit_come_before_missing_terms():
    record = second_order(0, equation=0.001)
    assert "at a limit" not in of(record).text
    (where,) = re.findall(
        r"First look at samples at a limit: (.*) of the rows, and the model goes beyond",
        (found := of(clipped(record, "y", 4.0))).text,
    )
    assert re.fullmatch(r"y is -4 on [\d.]+ % and 4 on [\d.]+ %", where)
    assert found.text.index("at a limit") < found.text.index("The predictable share")
    read = of(clipped(record, "u", 1.5)).text
    assert "the rows in which u is -1.5 and 1.5, and the next 3, have" in read


def test_samples_at_a_limit_come_before_the_missing_terms_of_a_motion():
    u = np.repeat(np.random.default_rng(2).uniform(0, 6, (60, 2)), 16, axis=0) * [1, 0]
    motion = oa.Motion.from_equations(
        [oa.State("x", "b*u - k*x", "y")],
        [oa.Output("y", "x")],
        [oa.PhysicalParameter("b", 0.1, min=0), oa.PhysicalParameter("k", 0.1, min=0)],
        ["u"],
    )
    texts = {}
    for top in (np.inf, 10.0):
        y = np.minimum(heated(u), top)
        record = Record.from_arrays(u[:, 0], y, sampling_time=1.0)
        texts[top] = of(record, motion).text
    assert "at a limit" not in texts[np.inf]
    assert "First look at samples at a limit: y is 10 on" in texts[10.0]
    limit, term = texts[10.0].index("at a limit"), texts[10.0].index(" Otherwise ")
    assert "most likely" in texts[10.0][term:] and limit < term


@pytest.mark.parametrize("fed_back", [True, False])
def test_under_feedback_no_text_advises_the_free_run(fed_back):
    rng, u, y, d = np.random.default_rng(1), np.zeros(500), np.zeros(500), 0.0
    reference = np.repeat(rng.normal(size=20), 25)
    for k in range(500):
        d = 0.8 * d + 0.1 * rng.normal()
        if k:
            y[k] = 0.8 * y[k - 1] + 0.5 * u[k - 1] + d
        u[k] = 0.6 * (reference[k] - fed_back * y[k]) + 0.05 * rng.normal()
    physics = oa.Baseline.from_terms([oa.Term("a", "y[k-1]"), oa.Term("b", "u[k-1]")])
    record = oa.Record.from_arrays(u, y, inputs=["u"], outputs=["y"])
    found = oa.estimate(record, physics, learner=None, criterion=oa.Prediction()).diagnose()
    text = " ".join([found.residuals.text, *(one.text for one in found.warnings)])
    assert '[noise] model = "auto"' in text
    assert ('focus = "simulation"' in text) != fed_back
    assert not fed_back or "Instrumental variables" not in text
    assert ("no remedy here: the inputs follow the outputs" in text) == fed_back
