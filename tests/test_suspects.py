"""Suspected terms: what each kind computes, and every refusal in its words."""

from __future__ import annotations

import numpy as np
import pytest

from orthaug import Baseline, InputError, Record, Suspect, Term, estimate, synthetic
from orthaug.analysis.catalogue import Catalogue
from orthaug.analysis.suspects import (
    KINDS,
    WITH_MEMORY,
    data_width,
    suspect_columns,
)

LAYOUT = Suspect("all", "y[k-1] + y[k-2] + u[k-1]").lags
X = np.random.default_rng(1).normal(size=(50, 3)) * [0.005, 0.005, 100.0]
X[0] = 0.0
TS = {"Ts": 0.01}
VELOCITY = "(y[k-1] - y[k-2])/Ts"
V = (X[:, 0] - X[:, 1]) / 0.01

FORMS = {
    "coulomb": lambda v, w: np.sign(v),
    "stribeck": lambda v, w: np.sign(v) * np.exp(-np.abs(v) / w),
    "stribeck_gauss": lambda v, w: np.sign(v) * np.exp(-((v / w) ** 2)),
    "quadratic_drag": lambda v, w: v * np.abs(v),
    "cubic": lambda v, w: v**3,
    "square_root": lambda v, w: np.sign(v) * np.sqrt(np.abs(v)),
    "dead_zone": lambda v, w: v - np.clip(v, -w, w),
    "saturation": lambda v, w: np.clip(v, -w, w),
    "expression": lambda v, w: v,
}
WIDE = ("stribeck", "stribeck_gauss", "dead_zone", "saturation")


def of(kind, **more):
    """A suspect on the velocity, with a width where its kind has one."""
    return Suspect.of(
        kind, VELOCITY, constants=TS, **({"width": 0.3} if kind in WIDE else {}), **more
    )


@pytest.mark.parametrize("kind", FORMS)
def test_values_of_every_kind(kind):
    suspect = of(kind)
    assert suspect.lags == LAYOUT[:2]
    values = suspect.values(X, LAYOUT, ["y"])
    assert values.shape == (50, 1)
    np.testing.assert_allclose(values[:, 0], FORMS[kind](V, 0.3), rtol=1e-13, atol=1e-15)


def test_every_kind_is_tested():
    """Those with memory in test_memory_suspects."""
    assert set(KINDS) == {*FORMS, "offset", *WITH_MEMORY}


def test_offset():
    suspect = Suspect.of("offset")
    assert (suspect.name, suspect.expression, suspect.lags) == ("offset", "1", ())
    np.testing.assert_array_equal(suspect.values(X, LAYOUT, ["y"]), np.ones((50, 1)))


def test_the_papers_friction_is_coulomb_and_stribeck():
    system = synthetic.MassSpringDamper()
    coulomb = Suspect.of("coulomb", VELOCITY, constants=TS).values(X, LAYOUT, ["y"])[:, 0]
    stribeck = Suspect.of("stribeck", VELOCITY, width=system.stribeck, constants=TS).values(
        X, LAYOUT, ["y"]
    )[:, 0]
    total = system.coulomb * coulomb + (system.static - system.coulomb) * stribeck
    np.testing.assert_allclose(total, system.friction(V), rtol=1e-12)


def test_names():
    assert Suspect.of("coulomb", " v[k-1]\n").name == "coulomb(v[k-1])"
    assert Suspect.of("saturation", "u[k-1]", width=1e-5).name == "saturation(u[k-1], 1e-05)"
    assert Suspect.of("expression", "u[k-1]**2").name == "u[k-1]**2"
    assert Suspect.of("coulomb", "v[k-1]", name="bearing").name == "bearing"


def test_width_may_be_a_numpy_number():
    assert (
        Suspect.of("saturation", "u[k-1]", width=np.float64(0.5)).expression
        == "max(min(u[k-1], 0.5), -0.5)"
    )


def test_constants_are_sorted_pairs_and_suspects_hashable():
    one = Suspect("a", "c*u[k-1]*b", constants={"c": 1, "b": 2})
    assert one.constants == (("b", 2.0), ("c", 1.0))
    assert hash(one) == hash(Suspect("a", "c*u[k-1]*b", constants=(("b", 2.0), ("c", 1.0))))


def test_columns_stand_in_their_output():
    suspects = [Suspect.of("cubic", "y[k-1]", output="z"), Suspect.of("offset", output="y")]
    columns = suspect_columns(suspects, X, LAYOUT, ["y", "z"])
    assert columns.shape == (2, 50, 2)
    np.testing.assert_allclose(columns[0], np.stack([0 * X[:, 0], X[:, 0] ** 3], axis=1))
    np.testing.assert_array_equal(columns[1], [[1.0, 0.0]] * 50)
    assert suspect_columns([], X, LAYOUT, ["y"]).shape == (0, 50, 1)


def test_data_width_is_the_median_of_what_moves():
    assert data_width(VELOCITY, X, LAYOUT, TS) == pytest.approx(np.median(np.abs(V[1:])))
    assert data_width("y[k-1]/3", X, LAYOUT, TS) == float(
        f"{np.median(np.abs(X[1:, 0])) / 3:.6g}"
    )  # in expressions
    inside = np.abs(V[1:]) < data_width(VELOCITY, X, LAYOUT, TS)
    assert abs(inside.mean() - 0.5) < 0.02


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"kind": "columb", "on": "v[k-1]"},
            r"unknown kind of suspect 'columb', did you mean 'coulomb'\? Known are coul",
        ),
        ({"kind": "", "on": "v[k-1]"}, r"unknown kind of suspect ''"),
        ({"kind": "cubic"}, r"a suspect of kind cubic needs `on`, an expression such as v\[k-1\]"),
        ({"kind": "offset", "on": "v[k-1]"}, r"an offset .* takes no `on`; got 'v\[k-1\]'"),
        (
            {"kind": "stribeck", "on": "v[k-1]"},
            r"stribeck needs `width`, in the unit of v\[k-1\]. Usual is the median",
        ),
        ({"kind": "cubic", "on": "v[k-1]", "width": 1.0}, "kind cubic takes no `width`; got 1.0"),
        (
            {"kind": "dead_zone", "on": "v[k-1]", "width": 0.0},
            "`width` must be a positive number; got 0.0",
        ),
        (
            {"kind": "dead_zone", "on": "v[k-1]", "width": float("nan")},
            "`width` must be a positive number; got nan",
        ),
        (
            {"kind": "cubic", "on": "v"},
            r"unknown constant 'v'; declare it .* give its lag, v\[k-1\]",
        ),
        ({"kind": "coulomb", "on": "v[k-1]) + (1"}, "is not an expression"),
        (
            {"kind": "cubic", "on": "v[k-1]", "name": " "},
            "' ' cannot name a suspect; use visible characters",
        ),
        (
            {"kind": "cubic", "on": "v[k-1]", "output": 1},
            "`output` must be the name of a channel; got 1",
        ),
        (
            {"kind": "cubic", "on": "v[k-1]", "coefficient": float("inf")},
            "`coefficient` must be a finite number; got inf",
        ),
        (
            {"kind": "cubic", "on": "v[k-1]", "coefficient": "1"},
            "`coefficient` must be a finite number; got '1'",
        ),
        (
            {"kind": "cubic", "on": "v[k-1]", "constants": {"sin": 1.0}},
            "'sin' cannot name a constant",
        ),
        (
            {"kind": "cubic", "on": "v[k-1]", "constants": {"c": float("nan")}},
            "constant 'c' must be a finite number; got n",
        ),
    ],
)
def test_refusals(arguments, message):
    with pytest.raises(InputError, match=message) as caught:
        Suspect.of(**arguments)
    assert "\n" not in str(caught.value)


def test_an_expression_that_does_not_parse_names_its_suspect():
    with pytest.raises(
        InputError, match="suspect 'drag': 'u.k': 'u.k' is not allowed in an expression"
    ):
        Suspect("drag", "u.k")


@pytest.mark.parametrize(
    ("suspect", "outputs", "message"),
    [
        (
            Suspect("a", "w[k-1] + u[k-3]"),
            ["y"],
            r"'a' reads w\[k-1\], u\[k-3\], which the regressor does not hold; it ho",
        ),
        (Suspect("a", "1"), ["y", "z"], "suspect 'a': `output` is missing; one of y, z"),
        (
            Suspect("a", "1", output="zz"),
            ["y", "zet"],
            "suspect 'a': unknown output 'zz'; known are y, zet",
        ),
        (
            Suspect("a", "log(y[k-1])"),
            ["y"],
            r"suspect 'a' = log\(y\[k-1\]\) is not finite at row 0 of the regressor",
        ),
    ],
)
def test_refusals_on_data(suspect, outputs, message):
    with pytest.raises(InputError, match=message):
        suspect.values(X, LAYOUT, outputs)


def test_two_suspects_of_one_name():
    with pytest.raises(InputError, match="suspect 'offset' is given twice"):
        suspect_columns([Suspect.of("offset")] * 2, X, LAYOUT, ["y"])


def test_no_width_from_data_that_do_not_move():
    with pytest.raises(InputError, match=r"'u\[k-1\]' is zero on all rows; the data give no width"):
        data_width("u[k-1]", 0 * X, LAYOUT)
    with pytest.raises(InputError, match=r"'1/u\[k-1\]' is not finite at row 0"):
        data_width("1/u[k-1]", X, LAYOUT)


@pytest.mark.parametrize(("rising", "named"), [(True, False), (False, True)])
def test_a_difference_that_keeps_its_sign_has_no_friction(rising, named):
    rng = np.random.default_rng(2)
    y = np.cumsum(rng.uniform(0.5, 1.5, 60)) if rising else np.cumsum(rng.normal(size=60))
    record = Record.from_arrays(rng.normal(size=60), y)
    physics = Baseline.from_terms([Term("a", "y[k-1]"), Term("b", "y[k-2]"), Term("g", "u[k]")])
    problem = estimate(record, physics, learner=None).problem
    kinds = {
        suspect.name.split(" of ")[0]
        for suspect in Catalogue.of_problem(problem).usual()
        if "y[k-1] - y[k-2]" in suspect.name
    }
    assert kinds == {"quadratic_drag", "cubic"} | ({"coulomb", "stribeck"} if named else set())


@pytest.mark.parametrize(("shift", "lags", "named"), [(0, 1, True), (9, 1, False), (0, 2, False)])
def test_friction_of_an_output_that_is_read_at_one_lag_and_changes_its_sign(shift, lags, named):
    """A measured speed; a position has its velocity at two lags."""
    rng = np.random.default_rng(2)
    record = Record.from_arrays(rng.normal(size=60), rng.normal(size=60) + shift)
    terms = [Term(f"a{lag}", f"y[k-{lag}]") for lag in range(1, lags + 1)]
    physics = Baseline.from_terms([*terms, Term("g", "u[k]")])
    problem = estimate(record, physics, learner=None).problem
    names = [suspect.name for suspect in Catalogue.of_problem(problem).usual()]
    assert ("coulomb of y[k-1]" in names) == named and ("saturation of y[k-1]" in names) == (
        lags == 1
    )
