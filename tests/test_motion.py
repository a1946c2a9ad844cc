"""The declaration of a motion: what it takes, what it refuses in words."""

from __future__ import annotations

import numpy as np
import pytest

import orthaug as oa
from orthaug.physics.problem import pose_motion

M = oa.PhysicalParameter("m", 2.0, "kg", min=0)
K = oa.PhysicalParameter("k", 8.0)


def motion(**changed) -> oa.Motion:
    given = {
        "states": [
            oa.State("x", "v", start="y"),
            oa.State("v", "(u - k*x)/m", start="derivative of y"),
        ],
        "outputs": [oa.Output("y", "x")],
        "parameters": [M, K],
        "inputs": ["u"],
    }
    return oa.Motion.from_equations(**given | changed)


def record(**changed) -> oa.Record:
    rng = np.random.default_rng(0)
    given = {"u": rng.normal(size=50), "y": rng.normal(size=50), "sampling_time": 0.1}
    return oa.Record.from_arrays(**given | changed)


def test_equations_are_evaluated_with_definitions_in_any_order() -> None:
    made = motion(
        states=[oa.State("x", "v"), oa.State("v", "force/m")],
        define={"force": "u - spring", "spring": "k*x"},
        constants={"unused": 3.0},
    )
    x, u = np.array([0.5, -1.0]), np.array([2.0])
    np.testing.assert_allclose(made.rates(x, u, made.initial, np), [-1.0, (2.0 - 8.0 * 0.5) / 2.0])
    np.testing.assert_allclose(made.observed(x, u, made.initial, np), [0.5])
    assert hash(made) == hash(made) and made == made


def test_positive_parameters_are_estimated_as_logarithms() -> None:
    coordinates = motion().coordinates
    assert coordinates.positive.tolist() == [True, False]
    np.testing.assert_allclose(coordinates.initial, [np.log(2.0), 8.0])
    np.testing.assert_allclose(coordinates.physical(np.array([0.0, -3.0])), [1.0, -3.0])
    np.testing.assert_allclose(coordinates.slopes(np.array([0.0, -3.0])), [1.0, 1.0])
    low, high = coordinates.bounds
    assert np.exp(low[0]) < 1e-12 and high[0] == np.inf and low[1] == -np.inf


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"states": [oa.State("x", "w")]}, "the equation of 'x' = w: unknown name 'w'"),
        (
            {"states": [oa.State("x", "sin(pi*x)")]},
            "the equation of 'x' = sin(pi*x): unknown name 'pi'; write 3.141592653589793",
        ),
        ({"states": [oa.State("x")]}, "the state 'x' has no `derivative`"),
        ({"states": []}, "the motion has no states"),
        ({"outputs": []}, "the motion has no outputs"),
        (
            {"outputs": [oa.Output("y", "u*k*m")]},
            "the output 'y' = u*k*m contains no state",
        ),
        ({"outputs": [oa.Output("y")]}, "the output 'y' has no expression"),
        ({"define": {"a": "b + 1", "b": "2*a"}}, "motion.define: an algebraic loop, a → b → a"),
        (
            {"parameters": [M, K, oa.PhysicalParameter("c", 1.0)]},
            "the parameter 'c' is in no equation and no output",
        ),
        (
            {"parameters": [oa.PhysicalParameter("m", -1.0, min=0), K]},
            "the initial value of 'm' is -1; its bounds are",
        ),
        ({"states": [oa.State("x", "k*m*u", start="z")]}, "the state 'x' starts from 'z'"),
        (
            {"states": [oa.State("x", "k*m*u", start="derivative of z")]},
            "the state 'x' starts from 'derivative of z'",
        ),
        (
            {"states": [oa.State("x", "k*m*u", start=np.inf)]},
            "the start of 'x' must be a finite number",
        ),
        ({"inputs": ["x"]}, "'x' is a state and an input"),
        ({"inputs": ["a b"]}, "'a b' cannot name an input"),
        (
            {"inputs": ["Ts"]},
            "'Ts' cannot name an input: expressions read it as the sampling time of the data",
        ),
        (
            {"states": [oa.State("Ts", "k*m*u")]},
            "'Ts' cannot name a state: expressions read it as the sampling time",
        ),
        (
            {"define": {"Ts": "k*m"}},
            "'Ts' cannot name a definition: expressions read it as the sampling time",
        ),
        (
            {"parameters": [M, K, oa.PhysicalParameter("Ts", 1.0)]},
            "'Ts' cannot name a parameter: expressions read it as the sampling time of the data",
        ),
        ({"integrator": "euler"}, "`integrator`"),
        ({"hold": "cubic"}, "`hold`"),
        ({"substeps": 0}, "`substeps` must be a whole number from 1"),
        (
            {"integrator": "discrete", "hold": "spline"},
            "a discrete motion has no input between samples",
        ),
        (
            {"states": [oa.State("x", "y[k-1]")]},
            "the equation of 'x' = y[k-1]: a signal such as",
        ),
    ],
)
def test_what_is_no_motion_is_refused_in_words(changed: dict, message: str) -> None:
    with pytest.raises(oa.InputError) as error:
        motion(**changed)
    assert str(error.value).startswith(message)


@pytest.mark.parametrize(
    ("made", "data", "inputs", "message"),
    [
        (motion(), record(outputs=["z"]), None, "the output 'z' has no expression in the motion"),
        (motion(), record(y=np.ones(50)), None, "channel 'y' is constant"),
        (
            motion(constants={"Ts": 0.5}),
            record(),
            None,
            "the constant 'Ts' is 0.5, but the data are sampled every",
        ),
        (motion(), record(), ["m*v"], "learner input = m*v: unknown name 'm'"),
        (
            motion(define={"a": "k*x"}),
            record(),
            ["a"],
            "learner input = a: 'a' contains parameters",
        ),
        (
            motion(states=[oa.State("x", "k*m*log(x - 100)", start="y")]),
            record(),
            None,
            "the equation of 'x' is not finite at the start (x = ",
        ),
        (
            motion(),
            record(sampling_time=1e3),
            None,
            "the sampling time of 1000 s is too long for the fastest mode",
        ),
    ],
)
def test_data_and_motion_that_do_not_fit_are_refused_in_words(
    made, data, inputs, message: str
) -> None:
    with pytest.raises(oa.InputError) as error:
        pose_motion(data, made, inputs)
    assert str(error.value).startswith(message)


def test_a_motion_of_functions() -> None:
    made = oa.Motion.from_functions(
        lambda x, u, p: -p[0] * x + u,
        lambda x, u, p: x,
        ["x"],
        ["y"],
        [oa.PhysicalParameter("a", 1.0)],
        ["u"],
    )
    np.testing.assert_allclose(
        made.rates(np.array([2.0]), np.array([3.0]), made.initial, np), [1.0]
    )
    with pytest.raises(oa.InputError, match="must be a function"):
        oa.Motion.from_functions(None, None, ["x"], ["y"], [oa.PhysicalParameter("a", 1.0)])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"learner": oa.MLP((2,))},
            "there is a learner, but no state and no output of the motion is learned",
        ),
        ({"learner": None, "criterion": oa.Prediction()}, "a motion is trained on its free run"),
        ({"learner": None, "structure": oa.Additive()}, "a motion has the orthogonal structure"),
        ({"learner": None, "lags": oa.Lags(1, 1, 1)}, "a motion has no `lags`"),
        (
            {"learner": None, "solver": oa.AdamLBFGS()},
            "a motion is trained by `LevenbergMarquardt`",
        ),
    ],
)
def test_options_that_a_motion_does_not_have_are_refused_in_words(
    options: dict, message: str
) -> None:
    with pytest.raises(oa.InputError) as error:
        oa.estimate(record(), motion(), **options)
    assert str(error.value).startswith(message)


def test_definitions_may_need_each_other_in_a_long_chain():
    chain = {"d0": "x"} | {f"d{i}": f"d{i - 1} + 1" for i in reversed(range(1, 3000))}
    states, outputs, k = (
        [oa.State("x", "-k*d2999")],
        [oa.Output("y", "x")],
        oa.PhysicalParameter("k", 2.0),
    )
    long = oa.Motion.from_equations(states, outputs, [k], define=chain)
    assert long.rates(np.array([1.0]), np.zeros(0), long.initial, np) == pytest.approx(-2 * 3000.0)
    assert long.observed(np.array([1.0]), np.zeros(0), long.initial, np) == 1.0


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ({"outputs": ["y"]}, '`outputs` must be a list such as [Output("y", "x")]; got \'y\''),
        ({"states": {"x": "u"}}, "`states` must be a list such as"),
        ({"parameters": ["a"]}, "`parameters` must be a list such as"),
        ({"inputs": "u"}, '`inputs` must be a list such as ["u"]'),
    ],
)
def test_what_is_no_list_of_declarations_is_named(given, text):
    options = {
        "states": [oa.State("x", "u - a*x", start="y")],
        "outputs": [oa.Output("y", "x")],
        "inputs": ["u"],
        "parameters": [oa.PhysicalParameter("a", 1.0)],
    }
    with pytest.raises(oa.InputError) as error:
        oa.Motion.from_equations(**options | given)
    assert text in str(error.value)
