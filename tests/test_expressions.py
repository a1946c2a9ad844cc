"""Expressions: what they compute, what they refuse and in which words."""

from __future__ import annotations

import gc
import math
import sys
import time
import warnings
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from orthaug import InputError
from orthaug.data.expressions import FUNCTIONS, Lag, parse

Y1, Y2, U0, U3 = Lag("y", 1), Lag("y", 2), Lag("u", 0), Lag("u", 3)
POINT = {Y1: 0.7, Y2: -1.3, U0: 2.5, U3: 0.2}
CONSTANTS = {"Ts": 0.01, "mass": 1.5}

VALUES = [
    ("1", 1.0),
    ("0x10", 16.0),
    ("1_000.5", 1000.5),
    ("2.5e-3", 2.5e-3),
    ("y[k-1]", 0.7),
    ("u[k]", 2.5),
    ("u[k+0]", 2.5),
    ("u[ k - 3 ]", 0.2),
    ("  y[k-1]\n + u[k] ", 0.7 + 2.5),
    ("-y[k-2]", 1.3),
    ("+y[k-2]", -1.3),
    ("-y[k-2]**2", -(1.3**2)),
    ("2**3**2", 512.0),
    ("y[k-2]**-2", 1.3**-2),
    ("u[k]**0.5", 2.5**0.5),
    ("u[k]**(1 + 1)", 2.5**2),
    ("y[k-2]**2.0", 1.3**2),
    ("1/2/4", 0.125),
    ("7 - 2 - 1", 4.0),
    ("mass*Ts/y[k-1]", 1.5 * 0.01 / 0.7),
    ("u[k]**mass", 2.5**1.5),
    ("sin(y[k-1])", math.sin(0.7)),
    ("cos(y[k-1])", math.cos(0.7)),
    ("tan(y[k-1])", math.tan(0.7)),
    ("exp(y[k-1])", math.exp(0.7)),
    ("log(y[k-1])", math.log(0.7)),
    ("sqrt(y[k-1])", math.sqrt(0.7)),
    ("tanh(y[k-1])", math.tanh(0.7)),
    ("atan(3*y[k-1])", math.atan(2.1)),
    ("atan2(y[k-1], y[k-2])", math.atan2(0.7, -1.3)),
    ("atan2(y[k-2], 2)*u[k]", math.atan2(-1.3, 2) * 2.5),
    ("floor(y[k-2])*u[k]", -2 * 2.5),
    ("abs(y[k-2])", 1.3),
    ("sign(y[k-2])", -1.0),
    ("sign(0*u[k])", 0.0),
    ("min(y[k-1], y[k-2], 0)", -1.3),
    ("max(y[k-1], y[k-2], 0)", 0.7),
    ("sign(y[k-2])*y[k-2]**2 + max(u[k] - 1, 0)", -(1.3**2) + 1.5),
]


@pytest.mark.parametrize("xp", [np, jnp], ids=["numpy", "jax"])
@pytest.mark.parametrize(("text", "value"), VALUES)
def test_value(text, value, xp):
    expression = parse(text, CONSTANTS)
    found = expression.evaluate({lag: xp.asarray(v) for lag, v in POINT.items()}, xp)
    np.testing.assert_allclose(found, value, rtol=1e-14)
    rows = {lag: xp.asarray([v, v]) for lag, v in POINT.items()}
    np.testing.assert_allclose(
        np.broadcast_to(expression.evaluate(rows, xp), 2), [value, value], rtol=1e-14
    )


def _leaves():
    numbers = st.sampled_from(["0.5", "2", "3.25"]).map(lambda t: (t, lambda p: float(t)))
    lags = st.sampled_from([Y1, Y2, U0]).map(lambda lag: (str(lag), lambda p: p[lag]))
    return numbers | lags


def _branches(child):
    binary = {"+": lambda a, b: a + b, "-": lambda a, b: a - b, "*": lambda a, b: a * b}
    unary = {"sin": math.sin, "cos": math.cos, "tanh": math.tanh, "abs": abs}
    pairs = st.tuples(st.sampled_from(sorted(binary)), child, child).map(
        lambda t: (
            f"({t[1][0]}) {t[0]} ({t[2][0]})",
            lambda p: binary[t[0]](t[1][1](p), t[2][1](p)),
        )
    )
    calls = st.tuples(st.sampled_from(sorted(unary)), child).map(
        lambda t: (f"{t[0]}({t[1][0]})", lambda p: unary[t[0]](t[1][1](p)))
    )
    squares = child.map(lambda c: (f"({c[0]})**2", lambda p: c[1](p) ** 2))
    return pairs | calls | squares


@given(st.recursive(_leaves(), _branches, max_leaves=6))
def test_any_expression_is_what_python_makes_of_it(pair):
    text, function = pair
    expression = parse(text)
    value = function(POINT)
    for xp in (np, jnp):
        np.testing.assert_allclose(expression.evaluate(POINT, xp), value, rtol=1e-12, atol=1e-12)
    assert all(str(lag) in text for lag in expression.lags)


@pytest.mark.parametrize("text", [text for text, _ in VALUES if "sign(0" not in text])
def test_gradient_is_the_finite_difference(text):
    expression, lags = parse(text, CONSTANTS), list(POINT)

    def function(point):
        return jnp.asarray(
            expression.evaluate(dict(zip(lags, point, strict=True)), jnp), dtype=float
        )

    point, step = np.array(list(POINT.values())), 1e-6
    differences = [
        (function(point + d) - function(point - d)) / (2 * step) for d in step * np.eye(len(point))
    ]
    np.testing.assert_allclose(
        jax.grad(function)(jnp.asarray(point)), differences, rtol=1e-7, atol=1e-8
    )


def test_integer_power_has_a_gradient_at_zero():
    square = parse("y[k-1]**2")
    assert jax.grad(lambda v: square.evaluate({Y1: v}, jnp))(0.0) == 0.0


def test_lags_in_order_of_first_appearance():
    assert parse("(y[k-1] + y[k-2])*u[k] + y[k-1]").lags == (Y1, Y2, U0)
    assert parse("1 + Ts", CONSTANTS).lags == ()
    assert [str(lag) for lag in parse("u[k]*u[k-3]").lags] == ["u[k]", "u[k-3]"]


def test_equal_by_text_and_the_constants_used():
    assert parse("Ts*y[k-1]", CONSTANTS) == parse("  Ts*y[k-1] ", {"Ts": 0.01})
    assert hash(parse("Ts*y[k-1]", CONSTANTS)) == hash(parse("Ts*y[k-1]", {"Ts": 0.01}))
    assert parse("Ts*y[k-1]", CONSTANTS) != parse("Ts*y[k-1]", {"Ts": 0.02})
    assert str(parse("y[k-1]  *  2")) == "y[k-1] * 2"


def test_the_sampling_time_may_be_given_later():
    text, declared = "(y[k-1] - y[k-2])/Ts", parse("(y[k-1] - y[k-2])/Ts", CONSTANTS)
    assert parse(text).unsampled and not declared.unsampled and not parse("Ts[k-1] + 1").unsampled
    assert parse(text).sampled(0.01) == declared and declared.sampled(7.0) == declared
    with pytest.raises(InputError, match="Ts has no value here; give it as a constant"):
        parse(text).evaluate(POINT, np)


REFUSED = [
    ("", "empty; write for example"),
    (" \n\t ", "empty"),
    ("1" + "+1" * 250, "has 501 characters; at most 500 are read"),
    ("~" * 490 + "1", "nested too deeply; write it more simply"),
    ("(" * 240 + "1" + ")" * 240, "too many nested parentheses"),
    ("y[k-1] +", "is not an expression"),
    ("y[k-1", "is not an expression"),
    ("1 2", "is not an expression"),
    ("y = 1", "is not an expression"),
    ("import os", "is not an expression"),
    ("y[k-1]; u[k]", "is not an expression"),
    ("#", "'#' is not allowed in an expression; allowed are channels at a lag"),
    ("y[k-1] # + u[k]", "'#' is not allowed in an expression"),
    ("\x00", "is not an expression"),
    ("\ud800", "is not an expression"),
    (
        "__import__('os').system('true')",
        r"'__import__\('os'\).system\('true'\)' is not allowed; functions are sin",
    ),
    ("__import__(1)", "unknown function '__import__'"),
    ("eval(1)", "unknown function 'eval'"),
    ("y.real", "'y.real' is not allowed in an expression; allowed are channels at a lag"),
    ("y[k-1].real", r"'y\[k - 1\].real' is not allowed"),
    ("().__class__", "is not allowed"),
    ("y[k-1](1)", "is not allowed; functions are"),
    ("(lambda: 1)()", "is not allowed; functions are"),
    ("sin(x=1)", r"'sin\(x=1\)' is not allowed"),
    ("sin(*[1])", r"'sin\(\*\[1\]\)' is not allowed"),
    ("min(1, 2, **{})", "is not allowed"),
    ("y[k-1] > 0", "'y\\[k - 1\\] > 0' is not allowed"),
    ("1 if y[k-1] else 2", "is not allowed in an expression"),
    ("not y[k-1]", "is not allowed in an expression"),
    ("y[k-1] and 1", "is not allowed in an expression"),
    ("lambda: 1", "'lambda: 1' is not allowed"),
    ("(a := 1)", "is not allowed in an expression"),
    ("[1, 2]", "is not allowed in an expression"),
    ("1, 2", "is not allowed in an expression"),
    ("{}", "is not allowed in an expression"),
    ("[a for a in y]", "is not allowed in an expression"),
    ("f'{y[k-1]}'", "is not allowed in an expression"),
    ("y[k-1] % 2", "is not allowed in an expression"),
    ("y[k-1] // 2", "is not allowed in an expression"),
    ("y[k-1] @ 2", "is not allowed in an expression"),
    ("~1", "is not allowed in an expression"),
    ("'text'", "'text' is not a number"),
    ("b'text'", "is not a number"),
    ("True", "True is not a number"),
    ("None", "None is not a number"),
    ("...", "Ellipsis is not a number"),
    ("1j", "1j is not a number"),
    ("sinh(y[k-1])", "unknown function 'sinh', did you mean 'sin'\\? Known are sin, cos"),
    ("squirt(y[k-1])", "unknown function 'squirt', did you mean 'sqrt'"),
    ("besselj(1)", "unknown function 'besselj'; known are"),
    ("sin()", "sin takes one argument, got 0"),
    ("sin(1, 2)", "sin takes one argument, got 2"),
    ("min(1)", "min takes two or more arguments, got 1"),
    ("max()", "max takes two or more arguments, got 0"),
    ("y[k+1]", r"'y\[k \+ 1\]' looks ahead; a regressor uses y\[k\] or earlier"),
    ("y[k-100001]", "reaches too far back; lags up to 100000 are read"),
    ("y[k-0.5]", "must be k or k-1, k-2, … with a whole number"),
    ("y[k-1.0]", "with a whole number"),
    ("y[k-True]", "with a whole number"),
    ("y[k--1]", "with a whole number"),
    ("y[k-n]", "with a whole number"),
    ("y[k*2]", "must be k or k-1"),
    ("y[1]", r"the index of 'y\[1\]' must be k or k-1"),
    ("y[-1]", "must be k or k-1"),
    ("y[1-k]", "must be k or k-1"),
    ("y[t-1]", r"the index k; write y\[k-1\]"),
    ("y[k-1, 0]", "must be k or k-1"),
    ("y[k:]", "must be k or k-1"),
    ("y[u[k]]", "must be k or k-1"),
    ("y[k-1][k]", "is not a channel at a lag such as"),
    ("(y + 1)[k]", "is not a channel at a lag such as"),
    ("2[k]", "is not a channel at a lag such as"),
    (
        "y",
        r"unknown constant 'y'; declare it with its value, or, for a channel, give its lag, y\[k-1\]",
    ),
    ("2*stifness", "unknown constant 'stifness', did you mean 'stiffness'"),
    ("k", "k is the time index and not a value"),
    ("k*y[k-1]", "k is the time index"),
    ("sin", r"sin is a function; write sin\(…\)"),
    ("y[k-1]^2", r"here a power is \*\*; write y\[k-1\]\*\*2\."),
    ("y[k-1]^(u[k] +", r"is not an expression"),
    (
        "2*v(k-1)",
        r"here a channel at a lag has square brackets and the index k; write 2\*v\[k-1\]\.",
    ),
    ("v(k)", r"square brackets and the index k; write v\[k\]"),
    ("sin(y(t - 1)).^2 ./ u[t]", r"write sin\(y\[k-1\]\)\*\*2 / u\[k\]\."),
    ("y[k-1].*u[k]", r"here products and quotients are \* and /; write y\[k-1\]\*u\[k\]\."),
    ("y[k-1] && u[k]", "an expression has no logic; use sign, min or max to switch"),
    ("ln(y[k-1])", "unknown function 'ln', did you mean 'log'"),
    ("atan2(y[k-1])", "atan2 takes two arguments, got 1"),
    ("floor(y[k-1], 1)", "floor takes one argument, got 2"),
    ("1e400", "number too large for double precision"),
    ("9" * 400, "number too large for double precision"),
]


@pytest.mark.parametrize(("text", "message"), REFUSED, ids=range(len(REFUSED)))
def test_refused(text, message):
    with pytest.raises(InputError, match=message):
        parse(text, {"stiffness": 1.0})


PIECES = list("()[]{}+-*/@~,.:=<#'\"\\\n\x00kyµ1")
PIECES += [
    "y[k-1]",
    "u[k]",
    "Ts",
    "**",
    "//",
    ":=",
    "2.5",
    "1e300",
    "0x1",
    "1j",
    "f'{1}'",
    "lambda",
    "__import__",
]
PIECES += FUNCTIONS
PIECES += [
    f" {word} " for word in ("if", "else", "for", "in", "not", "is", "and", "await", "yield")
]
LOADED_CODE = []


def _watch(event: str, arguments: tuple) -> None:
    if LOADED_CODE and event in {"exec", "import", "open", "os.system", "subprocess.Popen"}:
        LOADED_CODE.append(event)


sys.addaudithook(
    _watch
)  # stays until Python ends, so it only listens while a test has put something on the list


@given(st.text(max_size=40) | st.lists(st.sampled_from(PIECES), max_size=12).map("".join))
@example("__import__('os').system('true')")
@example("().__class__.__base__.__subclasses__()")
@example("[open('x') for x in y]")
@example("1/0")
@example("10**400 + y[k-1]**1e300")
@example("-" * 490 + "1")
def test_random_text_is_an_expression_or_bad_input_and_runs_nothing(text):
    LOADED_CODE[:] = ["watching"]
    try:
        expression = parse(text, CONSTANTS)
    except InputError:
        expression = None
    finally:
        seen = LOADED_CODE[1:]
        LOADED_CODE.clear()
    assert not seen
    if expression is not None:
        with np.errstate(all="ignore"):
            value = expression.evaluate(dict.fromkeys(expression.lags, 0.5), np)
        assert np.shape(value) == () and np.asarray(value).dtype == float


@pytest.mark.parametrize("text", ["1if 2else 3", "'\\d'", "1 is 1"])
def test_refusing_does_not_warn_besides(text):
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        with pytest.raises(InputError, match="not (allowed|a number)"):
            parse(text)
    assert not seen


def test_text_that_is_not_text():
    with pytest.raises(InputError, match="1"):
        parse(1)


def test_threads_parse_while_the_garbage_collector_lets_others_run():
    def switch(phase, info):
        time.sleep(0)

    def nested(depth):
        if depth:
            return nested(depth - 1)
        return {str(parse(f"(y[k-1] + {i}*u[k])/(2 + sin(u[k-3]))**2")) for i in range(1000)}

    threshold = gc.get_threshold()
    gc.set_threshold(50)
    gc.callbacks.append(switch)
    try:
        with ThreadPoolExecutor(2) as pool:
            assert [len(texts) for texts in pool.map(nested, (0, 9))] == [1000, 1000]
    finally:
        gc.callbacks.remove(switch)
        gc.set_threshold(*threshold)
