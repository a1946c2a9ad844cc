"""The estimation problem: rows, weights and layout, and everything that is refused before training."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from orthaug import Baseline, InputError, Lags, RankError, Record, Term
from orthaug.physics.problem import pose

RNG = np.random.default_rng(0)
U, Y = RNG.uniform(0.5, 2.0, (2, 20))
RECORD = Record.from_arrays(U, Y, source="run.csv")
PAIR = Record.from_arrays(np.stack([U, -(U**2)], 1), np.stack([Y, 1e3 * U * Y], 1))
PHYSICS = Baseline.from_terms([Term("a", "u[k-1]"), Term("b", "y[k-2]")])


def physics(*texts, **options):
    return Baseline.from_terms([Term(f"t{i}", text, **options) for i, text in enumerate(texts)])


def names(layout):
    return " ".join(str(lag) for lag in layout)


def test_rows_and_weight():
    problem = pose(RECORD, PHYSICS)
    assert names(problem.layout) == "y[k-2] u[k-1]" and problem.outputs == ("y",)
    np.testing.assert_array_equal(problem.rows.x, np.stack([Y[:-2], U[1:-1]], axis=1))
    np.testing.assert_array_equal(problem.target[:, 0], Y[2:])
    np.testing.assert_allclose(problem.weight.matrix, 1 / Y[2:].std())
    np.testing.assert_allclose(problem.whitened_target.std(axis=0), 1.0)
    np.testing.assert_array_equal(problem.feature_rows(), problem.rows.x)
    assert problem.excitation.full_rank


def test_each_output_has_its_weight():
    baseline = Baseline.from_terms(
        [Term("a", "u1[k]", output="y1"), Term("a", "u2[k]", output="y2")]
    )
    problem = pose(PAIR, baseline)
    np.testing.assert_allclose(problem.whitened_target.std(axis=0), 1.0)
    expected = np.stack([U, -(U**2)], axis=1) / problem.deviation
    np.testing.assert_allclose(problem.projection.phi[:, :, 0], expected)


def test_fixed_terms_leave_the_target():
    problem = pose(
        RECORD,
        Baseline.from_terms([Term("a", "y[k-1]", initial=0.5, fixed=True), Term("b", "u[k]")]),
    )
    np.testing.assert_allclose(problem.target[:, 0], Y[1:] - 0.5 * Y[:-1])
    assert problem.projection.phi.shape == (19, 1, 1)


def test_a_target_that_fixed_terms_explain_whole():
    record = Record.from_arrays(U, 2 * U)
    problem = pose(
        record, Baseline.from_terms([Term("a", "u[k]", initial=2.0, fixed=True), Term("b", "1")])
    )
    assert (
        not problem.target.any()
        and problem.weight.matrix == 1 / record.experiments[0].outputs.std()
    )


@pytest.mark.parametrize(
    ("lags", "inputs", "layout", "features"),
    [
        (None, None, "y[k-2] u[k-1]", "y[k-2] u[k-1]"),
        (Lags(na=1, nb=1, nk=0), None, "y[k-1] y[k-2] u[k] u[k-1]", "y[k-1] u[k]"),
        (None, ("u[k-3]",), "y[k-2] u[k-1] u[k-3]", "u[k-3]"),
        (Lags(na=1), ("u[k]*y[k-1]", "u[k]"), "y[k-1] y[k-2] u[k] u[k-1]", "u[k]*y[k-1] u[k]"),
    ],
)
def test_layout_holds_what_physics_and_learner_use(lags, inputs, layout, features):
    problem = pose(RECORD, PHYSICS, lags, inputs)
    assert names(problem.layout) == layout
    assert " ".join(str(entry) for entry in problem.features.entries) == features
    assert problem.feature_rows().shape == (len(problem.rows), len(problem.features.entries))


def test_learner_inputs_may_use_the_baseline_s_constants():
    baseline = Baseline.from_terms([Term("a", "u[k]")], {"gain": 2.0})
    np.testing.assert_array_equal(
        pose(RECORD, baseline, None, ("gain*u[k]",)).feature_rows()[:, 0], 2 * U
    )


def test_rank_is_reported_where_asked():
    problem = pose(RECORD, physics("u[k]", "2*u[k]", "y[k-1]"), require_full_rank=False)
    assert (problem.excitation.rank, problem.excitation.collinear) == (2, (("t0", "t1"),))
    with pytest.raises(
        RankError, match="rank 2 of 3.: the columns of t0, t1 are linearly dependent"
    ):
        pose(RECORD, physics("u[k]", "2*u[k]", "y[k-1]"))


FUNCTION = Baseline.from_function(lambda x: x[None, :1], ["a"])
SQUARE = Baseline.from_function(lambda x: jnp.ones((1, 2)), ["a"])
REFUSED = [
    (Record.from_arrays(U), physics("u[k]"), {}, "the record has no outputs; there is nothing to fit"),
    (RECORD, physics("v[k]"), {}, r"baseline term 't0' = v\[k\]: .* uses the unknown channel 'v'; known are y, u"),
    (RECORD, physics("y[k]"), {}, r"baseline term 't0' = y\[k\]: 'y\[k\]' is the output that is to be predicted"),
    (PAIR, physics("u1[k]"), {}, "baseline term 't0' .*`output` is missing; one of y1, y2"),
    (RECORD, physics("u[k]"), {"learner_inputs": ("v[k]",)}, "learner input: .*unknown channel 'v'"),
    (RECORD, physics("u[k]"), {"learner_inputs": ("y[k]",)}, "learner input: .*is the output that is to be predicted"),
    (RECORD, physics("u[k]"), {"learner_inputs": ("import os",)}, "learner input: 'import os' is not an expression"),
    (RECORD.rows(0, 3), physics("u[k-5]"), {}, "run.csv has 3 rows, too few: the largest lag is 5, so at least 6"),
    (RECORD.rows(0, 2), physics("u[k]", "1", "y[k-1]"), {}, "1 usable row for 3 parameters"),
    (RECORD, FUNCTION, {}, "a baseline function needs `lags`"),
    (
        RECORD,
        FUNCTION,
        {"lags": Lags(na=1), "learner_inputs": ("u[k-1]",)},
        r"the learner inputs use u\[k-1\], which `lags` does not contain",
    ),
    (RECORD, SQUARE, {"lags": Lags(na=1)}, r"baseline function returned shape \(1, 2\) .* expected .*\(1, 1\)"),
    (Record.from_arrays(U, Y * 1e160), physics("u[k]"), {}, "the outputs move by .*, too large or too small"),
    (Record.from_arrays(U, Y * 1e130), physics("u[k]"), {}, "the outputs move by .*e.130, too large .* scale them"),
    (Record.from_arrays(U, Y * 1e-130), physics("u[k]"), {}, "the outputs move by .*e-1[23]., too large or too small"),
    (Record.from_arrays(U, Y * 1e-300), physics("u[k]"), {}, "the outputs move by .*, too large or too small"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("record", "baseline", "options", "message"), REFUSED, ids=range(len(REFUSED))
)
def test_refused(record, baseline, options, message):
    with pytest.raises(InputError, match=message):
        pose(record, baseline, **options)


def test_the_sampling_time_is_a_name():
    record = Record.from_arrays(U, Y, sampling_time=0.5)
    texts, constants = ("u[k]*Ts", "y[k-1]/Ts"), {"Ts": 0.5}
    found = pose(record, physics(*texts), learner_inputs=("(y[k-1] - y[k-2])/Ts",))
    declared = Baseline.from_terms(physics(*texts).terms, constants)
    wanted = pose(record, declared, learner_inputs=("(y[k-1] - y[k-2])/Ts",))
    np.testing.assert_array_equal(found.projection.phi, wanted.projection.phi)
    np.testing.assert_array_equal(found.feature_rows(), wanted.feature_rows())
    assert dict(found.baseline.constants) == constants  # as a saved model needs it
    with pytest.raises(
        InputError,
        match="the constant 'Ts' is 0.5, but the data are sampled every 0.25 s. Ts is the",
    ):
        pose(Record.from_arrays(U, Y, sampling_time=0.25), declared)
    with pytest.raises(InputError, match="'Ts' is a constant and a channel"):
        pose(Record.from_arrays(U, Y, inputs=["Ts"]), physics("Ts[k]", "Ts*y[k-1]"))


@pytest.mark.parametrize("initial", [None, 0.5])
def test_initial_values_are_within_their_bounds(initial):
    with pytest.raises(
        InputError,
        match="the initial value of 't0' is .*; its bounds are 1 and inf. Give an `initial`",
    ):
        pose(RECORD, physics("u[k]", min=1.0, initial=initial))


@pytest.mark.parametrize(
    ("u", "y", "name"),
    [(np.full(20, 3.0), Y, "'u' is constant .3."), (U, np.zeros(20), "'y' is constant .0.")],
)
def test_constant_channels(u, y, name):
    with pytest.raises(
        InputError, match=f"channel {name} over all training data; nothing can be learned from it"
    ):
        pose(Record.from_arrays(u, y), physics("u[k]"))


def test_a_constant_channel_that_is_not_used_or_moves_elsewhere():
    still = Record.from_arrays(np.stack([U, np.ones(20)], 1), Y)
    assert pose(still, physics("u1[k]")).excitation.full_rank
    steps = [Record.from_arrays(np.full(20, level), Y) for level in (0.0, 1.0)]
    assert pose(Record.join(steps), physics("u[k]")).excitation.full_rank


ZERO_AT_7 = np.where(np.arange(20) == 7, 0.0, U)


@pytest.mark.parametrize(
    ("baseline", "options", "message"),
    [
        (
            physics("log(u[k])"),
            {},
            r"row 7: the regressor of t0 \(log\(u\[k\]\)\) is not finite there",
        ),
        (physics("1/u[k-2]"), {}, r"row 9: the regressor of t0 \(1/u\[k-2\]\) is not finite there"),
        (
            physics("1/u[k]", initial=1.0, fixed=True),
            {},
            "row 7: the sum of the fixed terms is not finite there",
        ),
        (
            physics("u[k]"),
            {"learner_inputs": ("log(u[k])",)},
            r"row 7: the learner input log\(u\[k\]\) is not finite",
        ),
    ],
)
def test_expressions_without_a_value_name_the_row(baseline, options, message):
    part = Record.from_arrays(ZERO_AT_7, Y, source="run.csv").rows(3, None)
    whole = Record.join([RECORD, part])
    for record in (part, whole):  # rows count from the start of the file
        with pytest.raises(InputError, match=f"run.csv: {message}"):
            pose(record, baseline, **options).feature_rows()


def test_a_baseline_function_without_a_value_names_the_row():
    function = Baseline.from_function(lambda x: jnp.log(x)[None], ["a"])
    with pytest.raises(
        InputError, match=r"row 7: the regressor of a \(the baseline function\) is not finite there"
    ):
        pose(Record.from_arrays(ZERO_AT_7, Y), function, Lags(nb=1, nk=0))
