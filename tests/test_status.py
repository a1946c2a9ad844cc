"""How training ends: a code, a cause and a remedy for each ending, in the words that users know."""

from __future__ import annotations

import json

import jax.numpy as jnp
import numpy as np
import pytest

from orthaug import Status
from orthaug.fitting.status import Ending

MESSAGES = {
    "exact": "",
    "converged": "",
    "iteration_limit": (
        "training stopped at its limit of iterations while the loss was still falling; "
        "the model is usable, more iterations may improve it"
    ),
    "stopped": (
        "training was stopped on request while the loss was still falling; "
        "the model is usable, more iterations may improve it"
    ),
    "no_descent": (
        "no step lowered the loss; the start is already a minimum, or the learner's gradient "
        "is wrong. Try another seed or another activation"
    ),
    "non_finite": (
        "the loss is not finite: (a) a learner input grows without bound, (b) the learner "
        "returns NaN, (c) channels differ by many orders of magnitude, or (d) `learning_rate` "
        "is too large. Rescale the channels, choose other learner inputs, or lower the rate"
    ),
}
"""What each code has always said."""
SUCCESSES = (Ending.CONVERGED, Ending.SPANNED, Ending.EXACT)


@pytest.mark.parametrize("ending", Ending, ids=lambda ending: ending.name)
def test_every_ending_says_what_it_always_said(ending):
    assert ending.message == MESSAGES[ending.code]


def test_no_code_is_without_an_ending():
    assert {ending.code for ending in Ending} == set(MESSAGES)
    assert [ending.name for ending in Ending if ending.code == "converged"] == [
        "CONVERGED",
        "SPANNED",
    ]


@pytest.mark.parametrize("ending", Ending, ids=lambda ending: ending.name)
def test_what_is_no_success_has_a_cause_and_a_remedy(ending):
    assert bool(ending.cause) == bool(ending.remedy) == (ending not in SUCCESSES)
    if ending.cause:
        assert ending.message.startswith(ending.cause) and ending.message.endswith(ending.remedy)
        assert not ending.cause.endswith((".", ";")) and not ending.remedy.endswith(".")


def test_only_a_loss_that_is_not_finite_leaves_no_model():
    assert [ending for ending in Ending if not ending.usable] == [Ending.NON_FINITE]


@pytest.mark.parametrize("ending", Ending, ids=lambda ending: ending.name)
def test_compiled_loops_carry_the_number(ending):
    carried = jnp.where(jnp.asarray(True), ending, Ending.RUNNING)
    assert Ending(int(carried)) is ending and bool(carried == ending)
    assert len({int(other) for other in Ending}) == len(Ending) and not Ending.RUNNING


@pytest.mark.parametrize("ending", Ending, ids=lambda ending: ending.name)
def test_a_status_reads_as_its_ending(ending):
    status = Status(ending, 3, 0.5, 0.25)
    assert (status.code, status.message, status.ok) == (ending.code, ending.message, ending.usable)
    assert json.dumps(status.code) == f'"{ending.code}"' and np.isfinite(status.loss)
