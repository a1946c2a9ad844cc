"""A learner of terms: as least squares does it, read as an equation, in the lagged form and in equations of motion."""

from __future__ import annotations

import numpy as np
import pytest
from test_motion_fit import WHOLE, data, spring

import orthaug as oa
from orthaug.data.expressions import parse
from orthaug.data.terms import TermLibrary, products_of
from orthaug.data.writing import coefficient_unit, latex

PHYSICS = oa.Baseline.from_terms([oa.Term("a", "y[k-1]", unit="1"), oa.Term("b", "u[k-1]")])
TERMS = ("y[k-1]**3", "u[k-1]**2")


def cubic(rows: int = 600, noise: float = 0.01) -> oa.Record:
    """y = 0.5 y1 + u1 − 0.1 y1³ − 0.2 u1²."""
    rng = np.random.default_rng(0)
    u, y = rng.uniform(-1, 1, rows), np.zeros(rows)
    for k in range(1, rows):
        y[k] = (
            0.5 * y[k - 1]
            + u[k - 1]
            - 0.1 * y[k - 1] ** 3
            - 0.2 * u[k - 1] ** 2
            + noise * rng.normal()
        )
    channels = {"inputs": [oa.Channel("u", unit="V")], "outputs": [oa.Channel("y", unit="m/s")]}
    return oa.Record.from_arrays(u=u, y=y, **channels)


@pytest.fixture(scope="module")
def fitted() -> oa.Estimate:
    return oa.estimate(cubic(), PHYSICS, learner=oa.Terms(TERMS))


def test_the_library_has_every_product_once():
    library = TermLibrary.of(["u", "v"], 3, ["abs"], ["u - v", "u*v"], ["v*u**2"])
    plain = ["1", "u", "v", "u**2", "u*v", "v**2", "u**3", "u*v**2", "v**3"]
    made = [
        f"{front}abs({s})" for s in "uv" for front in ("", "u*", "v*", "u**2*", "u*v*", "v**2*")
    ]
    assert sorted(library.texts) == sorted([*plain, *made, "u - v"])
    u, v = np.random.default_rng(0).normal(size=(2, 7))
    factors = np.stack([u, v, abs(u), abs(v), u - v])
    values = products_of(factors, library.numbers, np)
    for text, value in zip(library.texts, values, strict=True):
        np.testing.assert_allclose(
            value, eval(text, {"u": u, "v": v, "abs": abs}) * np.ones(7), rtol=1e-14
        )  # noqa: S307


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({}, "needs `terms`, or a `degree` of 1 or more"),
        (
            {"degree": 2, "functions": ("tan",)},
            "a library has no terms of the function 'tan', did you mean 'tanh'",
        ),
        ({"functions": ("abs",), "terms": ("u",)}, "need a `degree` of 1 or more"),
        ({"terms": "u[k-1]**2"}, "`terms` must be a tuple of texts"),
        (
            {"terms": ("u[k-1]",), "exclude": ("u[k-2]",)},
            "`exclude` names the term 'u\\[k-2\\]', which is not among",
        ),
        ({"degree": -1}, "`degree` must be a whole number, 0 or more"),
    ],
)
def test_declarations_that_are_refused(options, words):
    with pytest.raises(oa.InputError, match=words):
        oa.Terms(**options)


def test_too_many_terms_are_refused():
    with pytest.raises(
        oa.InputError, match=r"12 signals to the degree 12 make 2704156 terms; at most 200000"
    ):
        oa.Terms(degree=12).over([f"s{i}" for i in range(12)])


def test_one_step_ahead_it_is_least_squares(fitted):
    u, y = (part[:, 0] for part in (cubic().experiments[0].inputs, cubic().experiments[0].outputs))
    columns = np.column_stack([y[:-1], u[:-1], y[:-1] ** 3, u[:-1] ** 2])
    p, (rss,), _, _ = np.linalg.lstsq(columns, y[1:], rcond=None)
    std = np.sqrt(rss / (len(columns) - 4) * np.diag(np.linalg.inv(columns.T @ columns)))
    np.testing.assert_allclose(fitted.theta, p[:2], rtol=1e-8)
    np.testing.assert_allclose(fitted.std, std[:2], rtol=1e-6)
    table = fitted.terms.loc[list(TERMS)]
    np.testing.assert_allclose(table["coefficient"], p[2:], rtol=1e-7)
    np.testing.assert_allclose(table["std"], std[2:], rtol=1e-6)
    assert list(table["unit"]) == ["1/(m/s)**2", "(m/s)/V**2"]
    assert (table["ci95_low"] < [-0.1, -0.2]).all() and (table["ci95_high"] > [-0.1, -0.2]).all()
    assert not fitted.problem.shared.basis.size  # no combination of the terms is physics


def test_its_equation_is_the_model(fitted):
    record = cubic()
    y, u = record.experiments[0].outputs[:, 0], record.experiments[0].inputs[:, 0]
    predicted = fitted.model.predict(record).trajectories[0].model[1:, 0]
    right = fitted.equation("python").removeprefix("y[k] = ")
    k = np.arange(1, len(y))
    np.testing.assert_allclose(
        eval(right, {"y": y, "u": u, "k": k}), predicted, rtol=1e-12, atol=1e-14
    )  # noqa: S307
    assert fitted.equation().startswith(
        "y[k] = 0.500759*y[k-1] + 1.00048*u[k-1] - 0.0991745*y[k-1]**3 - "
    )
    assert r" - 0.0991745\,y_{k-1}^{3} - " in fitted.equation("latex")
    with pytest.raises(
        oa.InputError, match="`writing` must be one of text, latex, python; got 'tex'"
    ):
        fitted.equation("tex")


def test_it_is_saved_and_read_again(fitted, tmp_path):
    oa.save(fitted.model, tmp_path / "model")
    again = oa.load(tmp_path / "model")
    assert again.form.features == fitted.model.form.features and again.form.features.linear
    assert isinstance(again.form.bound.learner, oa.Terms)
    theirs, ours = (
        model.simulate(cubic()).trajectories[0].model[1:] for model in (again, fitted.model)
    )
    np.testing.assert_array_equal(theirs, ours)


def test_on_the_free_run_the_truth_is_inside_the_intervals():
    rng = np.random.default_rng(5)
    clean = cubic(noise=0.0)
    y = clean.experiments[0].outputs[:, 0] + 0.02 * rng.normal(size=600)
    record = oa.Record.from_arrays(u=clean.experiments[0].inputs[:, 0], y=y)
    fit = oa.estimate(
        record, PHYSICS, learner=oa.Terms(TERMS), criterion=oa.Simulation(128, 20), blocks=0
    )
    low, high = fit.interval.T
    assert (low < [0.5, 1.0]).all() and (high > [0.5, 1.0]).all()
    assert (fit.terms.loc[list(TERMS), "ci95_low"] < [-0.1, -0.2]).all()
    assert (fit.terms.loc[list(TERMS), "ci95_high"] > [-0.1, -0.2]).all()


def test_terms_that_say_nothing_of_their_own_are_left_out_and_reported():
    fit = oa.estimate(cubic(), PHYSICS, learner=oa.Terms(("u[k-1]", *TERMS, "2*u[k-1]**2")))
    assert set(fit.terms.index) == set(TERMS)
    (found,) = [w.text for w in fit.warnings if w.code == "terms_left_out"]
    assert found.startswith(
        "left out of the learner: u[k-1], 2*u[k-1]**2. On these data the physics, or the terms "
        "before"
    )
    alone = oa.estimate(cubic(), PHYSICS, learner=oa.Terms(("u[k-1]",)))
    assert not alone.learns and [w.code for w in alone.warnings][0] == "terms_left_out"
    with pytest.raises(
        oa.InputError, match="has 20 terms beside 2 parameters, but there are 19 usable samples"
    ):
        oa.estimate(
            cubic(20), PHYSICS, learner=oa.Terms(tuple(f"sin({i}*u[k-1])" for i in range(1, 21)))
        )


def test_what_the_terms_span_is_shared():
    beside = oa.estimate(
        cubic(), PHYSICS, learner=oa.Terms(("sin(u[k-1])", "u[k-1] - sin(u[k-1])")), blocks=0
    )
    assert [dict(d) for d in beside.problem.shared.directions] == [] and len(beside.terms) == 1
    motion = spring(learned=True)
    fit = oa.estimate(data(), motion, learner=oa.Terms(("v", "sign(v)")), criterion=WHOLE, blocks=0)
    assert fit.shared.directions == ({"c": 1.0},)


def test_a_term_of_a_motion_has_its_coefficient():
    record = data(hardening=20.0, friction=0.0, noise=0.01, seed=1)
    fit = oa.estimate(record, spring(learned=True), learner=oa.Terms(("x**3",)), blocks=0)
    (row,) = fit.terms.itertuples()
    assert row.added_to == "v" and row.ci95_low < -20 < row.ci95_high and row.std < 1.0
    assert not fit.shared.basis.size
    low, high = fit.interval.T
    assert (low < [1.0, 0.8, 25.0]).all() and (high > [1.0, 0.8, 25.0]).all()
    lines = fit.equation().splitlines()
    assert (
        lines[0] == "dx/dt = v"
        and lines[1].startswith("dv/dt = (u - c*v - k*x)/m - ")
        and lines[1].endswith("*x**3")
    )


@pytest.mark.parametrize(
    ("unit", "text", "expected"),
    [
        ("N", "v[k-1]", "N/(m/s)"),
        ("m/s", "v[k-1]", ""),
        ("N", "x[k-1]**2*abs(x[k-2])", "N/m**3"),
        ("N", "sign(v[k-1])", "N"),
        ("N", "x[k-1]*v[k-1]", "N/(m*(m/s))"),
        ("N", "x[k-1] + v[k-1]", None),
        ("N", "n[k-1]", None),
        ("", "1", ""),
        ("N", "1/x[k-1]", "N*m"),
        ("m/s", "x[k-1]", "1/s"),
        ("m/s", "x[k-1]*o[k-1]**2", "1/s"),
        ("m/s", "sign(o[k-1])", "m/s"),
        ("kg m/s", "x[k-1]", "kg/s"),
        ("m/s²", "v[k-1]", "1/s"),
        ("m/s2", "v[k-1]", "1/s"),
    ],
)
def test_units_of_coefficients(unit, text, expected):
    assert (
        coefficient_unit(unit, parse(text), {"v": "m/s", "x": "m", "n": "", "o": "1"}) == expected
    )


@pytest.mark.parametrize(
    ("text", "written"),
    [
        ("y[k-1]/(u[k]+1)", r"\frac{y_{k-1}}{u_{k} + 1}"),
        ("sqrt(abs(x1[k]))", r"\sqrt{\lvert x_{1,k} \rvert}"),
        ("-(u[k] - y[k-1])**2", r"-(u_{k} - y_{k-1})^{2}"),
        ("force[k]*(u[k]-1)", r"\mathrm{force}_{k}\,(u_{k} - 1)"),
    ],
)
def test_latex(text, written):
    assert latex(parse(text)) == written
