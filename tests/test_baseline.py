"""The baseline: φ from terms or from a function, known terms, and what is refused."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from orthaug import Baseline, InputError, Parameter, Term


def reading(*texts: str) -> Baseline:
    """A baseline with a term for each of these texts."""
    return Baseline.from_terms([Term(f"t{i}", text, output="y") for i, text in enumerate(texts)])


LAYOUT = reading("y[k-1]", "y[k-2]", "u[k-1]").lags
X = np.random.default_rng(1).normal(size=(5, 3))
Y1, Y2, U1 = X.T


@pytest.mark.parametrize("xp", [np, jnp], ids=["numpy", "jax"])
def test_phi_of_terms(xp):
    terms = [
        Term("a", "y[k-1]", initial=0.5, unit="1"),
        Term("b", "sign(u[k-1])*u[k-1]**2"),
        Term("c", "1"),
    ]
    baseline = Baseline.from_terms(terms)
    assert baseline.names == ("a", "b", "c")
    assert baseline.parameters[0] == Parameter("a", 0.5, "1")
    np.testing.assert_array_equal(baseline.initial, [0.5, 0.0, 0.0])
    assert [str(lag) for lag in baseline.lags] == ["y[k-1]", "u[k-1]"]
    phi = baseline.phi(xp.asarray(X), LAYOUT, ("y",), xp)
    expected = np.stack([Y1, np.sign(U1) * U1**2, np.ones(5)], axis=1)[:, None]
    np.testing.assert_allclose(phi, expected, rtol=1e-15)
    np.testing.assert_allclose(
        baseline.phi(xp.asarray(X[2]), LAYOUT, ("y",), xp), expected[2], rtol=1e-15
    )


def test_phi_in_compiled_code():
    baseline = Baseline.from_terms([Term("a", "y[k-1]"), Term("b", "1")])
    phi = jax.jit(jax.vmap(lambda x: baseline.phi(x, LAYOUT, ("y",), jnp)))(X)
    np.testing.assert_array_equal(phi, baseline.phi(X, LAYOUT, ("y",), np))


def test_outputs_share_a_parameter():
    layout = reading("p[k-1]", "q[k-1]").lags
    terms = [
        Term("a", "p[k-1]", output="p"),
        Term("shared", "q[k-1]", output="p"),
        Term("shared", "p[k-1]", output="q"),
        Term("shared", "2*p[k-1]", output="q"),  # adds up
    ]
    baseline = Baseline.from_terms(terms)
    assert baseline.names == ("a", "shared")
    p, q = x = np.array([3.0, 5.0])
    phi = baseline.phi(x, layout, ("p", "q"), np)
    np.testing.assert_array_equal(phi, [[p, q], [0.0, 3 * p]])
    baseline.check_channels(["p", "q"], [])


def test_fixed_terms_are_known_and_not_estimated():
    terms = [
        Term("two", "y[k-1]", initial=2.0, fixed=True),
        Term("a", "u[k-1]"),
        Term("one", "y[k-2]", initial=-1.0, fixed=True),
    ]
    baseline = Baseline.from_terms(terms)
    assert baseline.names == ("a",)
    np.testing.assert_array_equal(baseline.phi(X, LAYOUT, ("y",), np)[:, 0, 0], U1)
    np.testing.assert_allclose(baseline.known(X, LAYOUT, ("y",), np)[:, 0], 2 * Y1 - Y2)
    np.testing.assert_allclose(baseline.known(X[0], LAYOUT, ("y",), np), [2 * Y1[0] - Y2[0]])
    without = Baseline.from_terms([Term("a", "u[k-1]")])
    np.testing.assert_array_equal(without.known(X, LAYOUT, ("y",), np), np.zeros((5, 1)))


def test_repr():
    terms = [
        Term("a", "y[k-1]", output="y"),
        Term("b", "u[k-1]**2", output="y"),
        Term("g", "1", 9.81, output="z", fixed=True),
    ]
    assert (
        repr(Baseline.from_terms(terms)) == "Baseline(y = a*y[k-1] + b*(u[k-1]**2); z = 9.81*(1))"
    )
    assert (
        repr(Baseline.from_function(abs, ["a", "b"]))
        == "Baseline(a function of the regressor, θ: a, b)"
    )


def test_all_terms_fixed():
    baseline = Baseline.from_terms([Term("a", "u[k-1]", initial=3.0, fixed=True)])
    assert baseline.names == ()
    assert baseline.phi(X, LAYOUT, ("y",), np).shape == (5, 1, 0)
    np.testing.assert_allclose(baseline.known(X, LAYOUT, ("y",), np)[:, 0], 3 * U1)


def test_constants():
    baseline = Baseline.from_terms([Term("a", "Ts**2*u[k-1]")], {"Ts": 0.1, "unused": 1.0})
    np.testing.assert_allclose(baseline.phi(X, LAYOUT, ("y",), np)[:, 0, 0], 0.01 * U1)
    assert hash(baseline) == hash(
        Baseline.from_terms([Term("a", "Ts**2*u[k-1]")], {"unused": 1.0, "Ts": 0.1})
    )


def test_function_and_terms_agree():
    terms = Baseline.from_terms([Term("a", "y[k-1]**2"), Term("b", "sin(u[k-1])")])
    function = Baseline.from_function(
        lambda x: jnp.stack([x[0] ** 2, jnp.sin(x[2])])[None], ["a", Parameter("b")]
    )
    assert function.names == terms.names
    assert function.lags == ()
    for x in (X, X[0]):
        np.testing.assert_allclose(
            function.phi(x, LAYOUT, ("y",), np),
            terms.phi(x, LAYOUT, ("y",), np),
            rtol=1e-14,
            atol=1e-15,
        )
    assert isinstance(function.phi(X, LAYOUT, ("y",), np), np.ndarray)


@pytest.mark.parametrize("x", [X, X[0]], ids=["rows", "row"])
def test_function_of_the_wrong_shape(x):
    baseline = Baseline.from_function(lambda x: x[:2], ["a", "b"])
    with pytest.raises(
        InputError, match=r"returned shape \(2,\) for one row; expected \(ny, nθ\) = \(1, 2\)"
    ):
        baseline.phi(x, LAYOUT, ("y",), jnp)


def test_what_one_term_says_holds_for_all_of_its_parameter():
    baseline = Baseline.from_terms(
        [Term("a", "y[k-1]"), Term("a", "u[k]", initial=0.5, unit="1/s"), Term("b", "1")]
    )
    assert baseline.parameters == (Parameter("a", 0.5, "1/s"), Parameter("b"))


REFUSED = [
    ([], {}, r"has no terms; give at least one, such as y\[k-1\]"),
    ([Term("a", "y[k+1]")], {}, "baseline term 'a': .*looks ahead"),
    ([Term("a", "y[k-1] + eval(1)")], {}, "baseline term 'a': .*unknown function 'eval'"),
    ([Term("a", "")], {}, "baseline term 'a': An expression is empty"),
    (
        [Term("a", "1", initial=1.0), Term("a", "u[k]", initial=2.0)],
        {},
        "'a' disagree on `initial`: 1.0 and 2.0",
    ),
    (
        [Term("a", "1", unit="m"), Term("a", "u[k]", unit="mm")],
        {},
        "'a' disagree on `unit`: 'm' and 'mm'",
    ),
    (
        [Term("a", "1", fixed=True), Term("a", "u[k]")],
        {},
        "'a' disagree on `fixed`: True and False",
    ),
    (
        [Term("a", "1", initial=float("nan"))],
        {},
        "the initial value of 'a' must be .*finite.*; got nan",
    ),
    ([Term("a", "1", initial=True)], {}, "the initial value of 'a' must be .*finite.*; got True"),
    ([Term("a", "1", min=False)], {}, "the lower bound of 'a' must be .*finite.*; got False"),
    ([Term("a", "1")], {"c": True}, "the constant 'c' must be a finite number; got True"),
    ([Term("a", "1")], {"k": 1.0}, "'k' cannot name a constant; .*k.* are taken"),
    ([Term("a", "1")], {"sin": 1.0}, "'sin' cannot name a constant"),
    ([Term("a", "1")], {"a b": 1.0}, "'a b' cannot name a constant"),
    ([Term("a", "1")], {"lambda": 1.0}, "'lambda' cannot name a constant"),
    ([Term("a", "1")], {"\N{MICRO SIGN}": 1.0}, "'\N{MICRO SIGN}' cannot name a constant"),
    ([Term("a", "1")], {"c": float("inf")}, "the constant 'c' must be a finite number; got inf"),
    ([Term("a", 1)], {}, "baseline term 'a'"),
    ([Term("a", "1")], {"c": "0.1"}, "the constant 'c' must be a finite number; got"),
    ([Term("a", "1", initial="x")], {}, "the initial value of 'a' must be .*finite.*; got 'x'"),
    ([Term("a", "1", fixed=True)], {}, "'a' is fixed but gives no `initial`"),
]


@pytest.mark.parametrize(("terms", "constants", "message"), REFUSED, ids=range(len(REFUSED)))
def test_refused(terms, constants, message):
    with pytest.raises(InputError, match=message):
        Baseline.from_terms(terms, constants)


def test_parameter_given_twice():
    with pytest.raises(InputError, match="parameter 'a' is given twice"):
        Baseline.from_function(lambda x: x[None, :2], ["a", "a"])


@pytest.mark.parametrize(
    ("term", "outputs", "message"),
    [
        (
            Term("a", "w[k-1]"),
            ["y"],
            r"baseline term 'a' = w\[k-1\]: .*unknown channel 'w'; known are y, u",
        ),
        (Term("a", "y[k]"), ["y"], r"baseline term 'a' = y\[k\]: .*outputs are used from lag 1"),
        (Term("a", "y[k-1]"), ["y", "z"], "`output` is missing; one of y, z"),
        (Term("a", "y[k-1]", output="w"), ["y", "z"], "unknown output 'w'; known are y, z"),
        (Term("a", "y[k-1]", output="u"), ["y"], "unknown output 'u'; known are y"),
    ],
)
def test_channels_refused(term, outputs, message):
    with pytest.raises(InputError, match=message):
        Baseline.from_terms([term]).check_channels(outputs, ["u"])


def test_one_output_needs_no_name():
    Baseline.from_terms([Term("a", "y[k-1]"), Term("b", "u[k]", output="y")]).check_channels(
        ["y"], ["u"]
    )
