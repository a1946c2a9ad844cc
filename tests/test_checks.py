"""Which values count as numbers."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest

from orthaug import InputError
from orthaug._base.checks import check_number, finite_or_none, free_name, is_number, positive
from orthaug._base.lines import first_words, join_words


@pytest.mark.parametrize(
    "value", [0, -1.5, np.float32(2.0), np.int8(-128), np.uint64(2**63), 10**300]
)
def test_finite_real_numbers_are_numbers(value):
    assert is_number(value)


@pytest.mark.parametrize(
    "value",
    [
        True,
        np.True_,
        None,
        "1",
        1j,
        np.complex128(1),
        float("nan"),
        -np.inf,
        10**400,
        np.ones(1),
        Fraction(1, 2),
    ],
)
def test_what_is_no_number(value):
    assert not is_number(value)
    with pytest.raises(InputError, match="`x` must be a number, 0 or more; got"):
        check_number(value, "x")


def test_finite_or_none():
    assert (
        finite_or_none(1.5) == 1.5
        and finite_or_none(float("inf")) is finite_or_none(float("nan")) is None
    )


def test_a_scale_is_positive():
    np.testing.assert_array_equal(
        positive(np.array([2.0, 0.0, -1.0, np.nan, np.inf])), [2, 1, 1, 1, 1]
    )


def test_a_name_that_is_taken_gets_underscores():
    assert [free_name(name, {"y", "y_"}) for name in ("x", "y")] == ["x", "y__"]


@pytest.mark.parametrize(
    ("words", "joined", "first"),
    [
        ([], "nothing", ""),
        (["a"], "a", "a"),
        (["a", "b"], "a and b", "a, b"),
        (("a", "b", "c"), "a, b and c", "a, b and 1 more"),
    ],
)
def test_words_in_a_sentence(words, joined, first):
    assert join_words(words) == joined
    assert first_words(words, 2) == first
