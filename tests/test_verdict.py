"""Does the learner earn its place: blocks, ranges, the verdict on trials, and cross-validation of real fits."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from orthaug import (
    MLP,
    Baseline,
    InputError,
    Lags,
    LevenbergMarquardt,
    Model,
    Record,
    Term,
    estimate,
)
from orthaug.analysis.findings import ValidationResult
from orthaug.analysis.validation import (
    Extrapolation,
    Trial,
    block_trials,
    cross_validate,
    dominance,
    extrapolation,
    free_run_error,
    judge,
    score_trial,
)
from orthaug.data.regressors import stack_rows
from orthaug.fitting.held_out import covered_folds, held_out_blocks
from orthaug.fitting.status import Ending

pytestmark = pytest.mark.usefixtures("without_figures")

PHYSICS = Baseline.from_terms([Term("a", "y[k-1]"), Term("b", "y[k-2]"), Term("g", "u[k-1]")])
BEYOND = Extrapolation("tests.far", "u[k-1]", (-1.0, 1.0), (-2.5, 2.0), 0.25)
SMALL = {"learner": MLP(hidden=(6,)), "solver": LevenbergMarquardt(40)}
GREEDY = {"learner": MLP(hidden=(30,)), "solver": LevenbergMarquardt(60), "regularization": "none"}


def system(seed, rows, nonlinear=False, noise=0.05, scale=1.0):
    rng = np.random.default_rng([3, seed])
    u, y, e = scale * rng.normal(size=rows), np.zeros(rows), noise * rng.normal(size=rows)
    for k in range(2, rows):
        y[k] = 1.5 * y[k - 1] - 0.7 * y[k - 2] + u[k - 1] + e[k]
        y[k] += 0.5 * u[k - 1] ** 2 - 0.3 * np.tanh(y[k - 1]) if nonlinear else 0.0
    return Record.from_arrays(u, y)


def fitted(record, **options):
    return estimate(record, PHYSICS, **{"learner": None, **options})


# --- blocks

SHAPES = [
    ((100,), 4, 2),
    ((103,), 3, 5),
    ((50, 60, 70), 4, 2),
    ((30,) * 8, 4, 2),
    ((200, 9, 9), 4, 2),
    ((90,), 2, 0),
]
UNEVEN = [((100, 100, *(4,) * 50), 2, 3)]  # to even out the rows one experiment is not enough


def short(value):
    return str(value)[:24]


def numbered(lengths):
    """Experiments whose input holds the experiment's number and whose output the row's."""
    parts = [
        Record.from_arrays(np.full(n, float(i)), np.arange(float(n))) for i, n in enumerate(lengths)
    ]
    return Record.join(parts)


def places(record):
    return [
        (int(i), int(k))
        for e in record.experiments
        for i, k in zip(e.inputs[:, 0], e.outputs[:, 0], strict=True)
    ]


def usable(record, start):
    return sum(max(len(e) - start, 0) for e in record.experiments)


@pytest.mark.parametrize(("lengths", "blocks", "start"), SHAPES, ids=short)
def test_every_row_is_held_out_once_in_contiguous_blocks(lengths, blocks, start):
    record = numbered(lengths)
    folds = held_out_blocks(record, blocks, start)
    assert len(folds) == blocks
    held = [places(out) for _, out in folds]
    assert [place for block in held for place in block] == places(record)
    sizes = [len(block) for block in held]
    assert max(sizes) - min(sizes) <= 1


@pytest.mark.parametrize(("lengths", "blocks", "start"), SHAPES + UNEVEN, ids=short)
def test_training_rows_keep_the_lag_length_away(lengths, blocks, start):
    """Neither a row nor any of its lags is shared by training and held-out rows."""
    for training, out in held_out_blocks(numbered(lengths), blocks, start):
        nearest = [abs(k - j) for i, k in places(training) for h, j in places(out) if h == i]
        assert min(nearest, default=math.inf) > start


@pytest.mark.parametrize(("lengths", "blocks", "start"), SHAPES, ids=short)
def test_training_experiments_are_unbroken(lengths, blocks, start):
    for training, _ in held_out_blocks(numbered(lengths), blocks, start):
        for experiment in training.experiments:
            assert (np.diff(experiment.outputs[:, 0]) == 1).all() and len(
                set(experiment.inputs[:, 0])
            ) == 1
            assert experiment.first_row == experiment.outputs[0, 0]


@pytest.mark.parametrize(("lengths", "blocks", "start"), SHAPES + UNEVEN, ids=short)
def test_all_folds_have_as_many_usable_rows(lengths, blocks, start):
    assert (
        len(
            {
                usable(training, start)
                for training, _ in held_out_blocks(numbered(lengths), blocks, start)
            }
        )
        == 1
    )


@pytest.mark.parametrize(
    ("lengths", "blocks", "start"),
    [((60,), 4, 2), ((200,), 1, 2), ((100,), 50, 0), ((4,) * 60, 4, 3)],
    ids=short,
)
def test_too_few_rows_for_the_blocks(lengths, blocks, start):
    rows = sum(lengths)
    with pytest.raises(
        InputError, match=f"{rows} rows are too few for {blocks} blocks with gaps of {start} rows"
    ):
        held_out_blocks(numbered(lengths), blocks, start)


# --- ranges


def rows_of(record, layout=None):
    return stack_rows(record, layout or layout_of()).x


def layout_of():
    return fitted(system(0, 60), lags=Lags(na=2, nb=2), **SMALL).problem.layout


def test_a_part_within_the_training_range_leaves_nothing():
    record = system(0, 300)
    assert (
        extrapolation("tests.in", rows_of(record.rows(50, 200)), rows_of(record), layout_of()) == []
    )


def test_the_range_that_is_left_is_reported_once_for_a_channel():
    record, far = system(0, 300), system(1, 200, scale=2.0)
    found = {
        e.lag: e for e in extrapolation("tests.far", rows_of(far), rows_of(record), layout_of())
    }
    assert set(found) == {"y[k-1]", "u[k-1]"}
    inside = record.experiments[0].inputs[1:-1, 0]
    outside = far.experiments[0].inputs[1:-1, 0]
    entry = found["u[k-1]"]
    assert entry.training == (inside.min(), inside.max()) and entry.reach == (
        outside.min(),
        outside.max(),
    )
    assert entry.share == pytest.approx(
        np.mean((outside < inside.min()) | (outside > inside.max()))
    )


@pytest.mark.parametrize(("over", "rows", "told"), [
    (0.005, 100, False), (0.05, 1, False), (0.05, 100, True), (0.5, 1, True), (0.0, 0, False),
])  # fmt: skip
def test_a_range_that_is_hardly_left_is_not_reported(over, rows, told):
    """Of a range of 2 over 1000 rows: as noise on the extreme values leaves it."""
    training, x = (np.linspace(-1, 1, 1000)[:, None] for _ in range(2))
    x[:rows] = -1 - 2 * over
    assert bool(extrapolation("tests.far", x, training, layout_of()[:1])) is told


def test_the_words_of_a_range():
    words = (
        "In u[k-1], tests.far leaves the training range of -1 to 1: it goes from -2.5 to 2, "
        "outside on 25 % of its"
    )
    assert words in str(BEYOND)


# --- the verdict

BLOCK = ("block 1 of 2", "block 2 of 2")
INF = math.inf
CASES = [
    ([(BLOCK[0], 1.0, 0.5), (BLOCK[1], 1.0, 0.6)], "helps"),
    ([(BLOCK[0], 1.0, 0.2), (BLOCK[1], 1.0, 1.1)], "helps"),  # the error over all blocks counts
    ([(BLOCK[0], 1.0, 0.5), (BLOCK[1], 1.0, 1.5)], "hurts"),
    ([(BLOCK[0], 1.0, 0.99), (BLOCK[1], 1.0, 0.99)], "no_help"),
    ([("tests.a", 1.0, 0.97)], "helps"),
    ([("tests.a", 1.0, 0.99)], "no_help"),
    ([("tests.a", 1.0, 1.01)], "no_help"),
    ([("tests.a", 1.0, 1.03)], "hurts"),
    ([("tests.a", 1.0, 0.1), ("tests.b", 1.0, 1.01)], "no_help"),
    ([("tests.a", 1.0, 0.1), ("tests.b", 1.0, 1.2)], "hurts"),
    ([(BLOCK[0], 1.0, 0.1), (BLOCK[1], 1.0, 0.1), ("validation", 1.0, 1.2)], "hurts"),
    ([(BLOCK[0], 1.0, 2.0), (BLOCK[1], 1.0, 2.0), ("tests.a", 1.0, 0.1)], "hurts"),
    ([("tests.a", 1.0, INF)], "hurts"),
    ([("tests.a", INF, INF)], "no_help"),
    ([("tests.a", INF, 1.0)], "helps"),
    ([("tests.a", 0.0, 0.0)], "no_help"),
    ([(BLOCK[0], 1.0, 0.1), (BLOCK[1], 1.0, INF)], "hurts"),
    (
        [(BLOCK[0], INF, 0.1), (BLOCK[1], 1.0, INF)],
        "hurts",
    ),  # it runs away where physics alone does not
]


@pytest.mark.parametrize(("trials", "code"), CASES, ids=str)
def test_the_verdict_on_trials(trials, code):
    found = judge([Trial(*trial, block=trial[0] in BLOCK) for trial in trials])
    opening = {
        "helps": "The learner helps",
        "no_help": "The learner does not help",
        "hurts": "The learner hurts",
    }
    assert [warning.code for warning in found.warnings] == ["learner_hurts"] * (code == "hurts")
    assert (
        found.code == code
        and found.text.startswith(f"{opening[code]}. ")
        and found.text.endswith(".")
    )
    content = json.loads(ValidationResult.model_validate(found).to_json())
    assert content["verdict"] == code and len(content["trials"]) == len(trials)


@pytest.mark.parametrize(("lost", "opening"), [(20, "It is undecided whether the"), (200, "The")])
def test_a_learner_that_loses_in_one_stretch_alone_may_still_help(lost, opening):
    """On average it is worse, but an interval from a half on does not say that it does not help."""
    rng = np.random.default_rng(0)
    alone = rng.uniform(0.5, 1.5, 200)
    model = np.where(np.arange(200) < lost, 11.0 if lost < 200 else 1.01, 0.2) * alone
    errors = [math.sqrt(piece.mean()) for piece in (alone, model)]
    found = judge([Trial("tests.a", *errors, pieces=([alone], [model]))])
    assert found.code == "no_help" and found.ratio.value > 1
    assert found.text.startswith(f"{opening} learner ")
    assert (found.ratio.low < 0.8) == (lost < 200)


def test_a_wide_interval_below_one_is_undecided():
    """A part where most of the gain is in one stretch: on average much better, yet not surely."""
    rng = np.random.default_rng(0)
    alone = np.concatenate([30 * np.ones(20), rng.uniform(0.5, 1.5, 180)])
    model = np.concatenate([np.ones(20), 2 * rng.uniform(0.5, 1.5, 180)])
    errors = [math.sqrt(piece.mean()) for piece in (alone, model)]
    found = judge([Trial("tests.a", *errors, pieces=([alone], [model]))])
    assert found.code == "no_help" and found.ratio.value < 0.9 and found.ratio.high > 1
    assert found.text.startswith("It is undecided whether the learner helps. On tests.a")


def test_no_trial_no_verdict():
    assert judge([]) is None


def test_a_part_that_is_worse_is_never_help():
    rng = np.random.default_rng(0)
    for _ in range(300):
        alone, model = rng.choice([0.5, 0.99, 1.0, 1.01, 2.0, INF], size=(2, 3))
        found = judge(
            [Trial(f"tests.{i}", *pair) for i, pair in enumerate(zip(alone, model, strict=True))]
        )
        if (model >= alone).any():
            assert found.code != "helps"
        if (np.isinf(model) & np.isfinite(alone)).any():
            assert found.code == "hurts"


def test_the_text_gives_the_errors_and_how_many_blocks_are_better():
    found = judge(
        [
            Trial(BLOCK[0], 1.0, 0.3, True),
            Trial(BLOCK[1], 1.0, 1.1, True),
            Trial("tests.a", 0.8, 0.4),
        ]
    )
    error = math.sqrt((0.3**2 + 1.1**2) / 2)
    assert (
        f"(2 blocks, 1 of them better): free-run NRMSE {error:.4g} with the learner, 1 with"
        in found.text
    )
    assert "On tests.a: free-run NRMSE 0.4 with the learner, 0.8 with physics alone" in found.text


def test_harm_outside_the_training_range_is_called_so():
    found = judge([Trial("tests.far", 1.0, 2.0)], [BEYOND])
    assert (
        found.text.startswith("The learner hurts in extrapolation. ") and str(BEYOND) in found.text
    )
    assert (
        ValidationResult.model_validate(found).content()["extrapolation"][0]["regressor"]
        == "u[k-1]"
    )


def test_harm_elsewhere_is_not_blamed_on_extrapolation():
    found = judge([Trial("tests.far", 1.0, 0.5), Trial("tests.near", 1.0, 2.0)], [BEYOND])
    assert found.text.startswith("The learner hurts. ")
    seldom = judge([Trial("tests.far", 1.0, 2.0)], [replace(BEYOND, share=0.02)])
    assert (
        seldom.text.startswith("The learner hurts. ")
        and "outside on 2 % of its rows" in seldom.text
    )


def test_what_diverges_is_null_in_json_and_reported():
    found = judge([Trial("tests.a", 1.0, INF)])
    assert "diverges" in found.text
    assert ValidationResult.model_validate(found).content()["trials"] == [
        {"where": "tests.a", "physics_alone": 1.0, "model": None}
    ]


# --- errors of free runs


def test_the_error_of_a_free_run_is_that_of_simulate():
    record = system(0, 200)
    model = fitted(record).model
    part = system(1, 100)
    e = (model.simulate(part).model - part.experiments[0].outputs)[7:, 0]
    y = part.experiments[0].outputs[7:, 0]
    assert free_run_error(model, part, 7) == pytest.approx(np.sqrt(np.mean(e**2)) / y.std())
    assert score_trial("here", part, (7,), model, model) == Trial(
        "here", *[free_run_error(model, part, 7)] * 2
    )


def test_free_runs_that_exist_are_not_run_again(monkeypatch):
    model, part = fitted(system(0, 200)).model, system(1, 100)
    plain, response = score_trial("here", part, (7,), model, model), model.simulate(part)
    monkeypatch.setattr(Model, "simulate", lambda *_: pytest.fail("run again"))
    assert (
        score_trial("here", part, (7,), model, model, alone_response=response, response=response)
        == plain
    )


def test_a_constant_output_is_not_taken_for_a_free_run_that_diverges():
    record = system(0, 200)
    rest = Record.from_arrays(np.zeros(50), np.zeros(50))
    found = judge(
        [score_trial("tests.rest", rest, (0,), fitted(record).model, fitted(record, **SMALL).model)]
    )
    assert found is None or "diverges" not in found.text


# --- cross-validation


def validated(record, blocks=4, **options):
    fits = [lambda fold: fitted(fold), lambda fold: fitted(fold, **options)]
    return cross_validate(record, fits, folds=covered_folds(record, blocks, 2))


def verdict(errors):
    return judge(block_trials(errors, 1))


def test_errors_are_those_of_fits_without_the_block():
    record = system(0, 200, nonlinear=True)
    errors = validated(record, 3, **SMALL)
    assert len(errors) == 3
    training, out = held_out_blocks(record, 3, 2)[1]
    unit = record.experiments[0].outputs.std(axis=0)
    runs = [fitted(training, **o).model.simulate(out) for o in ({}, SMALL)]
    expected = [float((run.scores(0).rmse / unit)[0]) for run in runs]
    trial = block_trials(errors, 1)[1]
    np.testing.assert_allclose([trial.alone, trial.model], expected, rtol=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_a_learner_that_finds_what_is_missing_helps(seed):
    assert verdict(validated(system(seed, 300, nonlinear=True), **SMALL)).code == "helps"


@pytest.mark.parametrize("seed", range(3))
def test_a_learner_that_fits_the_noise_of_few_rows_hurts(seed):
    assert verdict(validated(system(seed, 120, noise=0.3), **GREEDY)).code == "hurts"


@pytest.mark.parametrize("seed", range(3))
def test_a_learner_with_nothing_to_find_does_not_help(seed):
    given = {**SMALL, "regularization": "evidence"}
    assert verdict(validated(system(seed, 300, noise=0.3), **given)).code != "helps"


def discharged(rows, curved=1.0):
    """A cell whose state of charge sweeps its range once, so that no block holds another's."""
    rng = np.random.default_rng(0)
    current = np.repeat(rng.uniform(0.2, 1.8, rows // 10), 10)
    current *= 0.95 * rows / current.sum()
    charge = 0.97 - np.concatenate([[0], np.cumsum(current)[:-1]]) / rows
    voltage = 3.5 + 0.35 * charge - 0.06 * current + 0.003 * rng.normal(size=rows)
    voltage += curved * 0.08 * np.log(charge / (1.02 - charge))
    both = np.column_stack([current, charge])
    return Record.from_arrays(both, voltage, inputs=["I", "charge"], outputs=["v"])


def of_charge(record):
    terms = [Term("open", "1"), Term("slope", "charge[k]"), Term("R", "I[k]")]
    learner = MLP(hidden=(4,), inputs=("charge[k]",))
    fit = estimate(record, Baseline.from_terms(terms), learner=learner)
    return fit.diagnose().validation


def test_blocks_that_would_leave_the_range_of_the_other_rows_are_spread():
    found = of_charge(discharged(400))
    assert found.verdict == "helps"
    assert "in charge[k], on 49 % of their rows" in found.text and "stretches" in found.text


def test_blocks_that_cannot_be_spread_are_said_to_compare_extrapolations():
    text = of_charge(discharged(120)).text
    assert "The blocks leave the range of the other rows (in charge[k]" in text
    assert "compares extrapolations" in text


def test_several_experiments_are_cross_validated():
    record = Record.join([system(i, n, nonlinear=True) for i, n in enumerate((120, 80, 100))])
    found = verdict(validated(record, **SMALL))
    assert found.code == "helps" and len(found.trials) == 4


def test_a_fit_that_fails_counts_as_a_free_run_that_diverges():
    def refused(fold):
        raise InputError("the block took away what the physics needs")

    def non_finite(fold):
        fit = fitted(fold)
        return replace(fit, status=replace(fit.status, ending=Ending.NON_FINITE))

    record = system(0, 120)
    errors = cross_validate(
        record, [fitted, refused, non_finite], folds=covered_folds(record, 2, 2)
    )
    for fit in (1, 2):
        assert all(
            0 < trial.alone < 1 and trial.model == INF for trial in block_trials(errors, fit)
        )


def test_too_few_rows_are_refused_before_any_fit():
    with pytest.raises(InputError, match="40 rows are too few for 4 blocks"):
        covered_folds(system(0, 40), 4, 2)


# --- a learner that leaves the training range


@pytest.mark.parametrize("seed", range(3))
def test_an_overfitted_learner_hurts_in_extrapolation(seed):
    record, far = system(seed, 60, noise=0.3), system(seed + 10, 200, noise=0.3, scale=3.0)
    fit = fitted(record, **GREEDY)
    trial = score_trial("tests.far", far, (0,), fitted(record).model, fit.model)
    x = rows_of(far, fit.problem.layout)
    found = judge([trial], extrapolation("tests.far", x, fit.problem.rows.x, fit.problem.layout))
    assert trial.model > trial.alone
    assert (
        found.text.startswith("The learner hurts in extrapolation")
        and "tests.far leaves" in found.text
    )


def test_dominance_is_the_learners_part_against_the_physics():
    record = system(0, 150, nonlinear=True)
    fit = fitted(record, **SMALL)
    rows = fit.model.predict(record).trajectories[0]
    expected = np.linalg.norm(rows.learner[2:]) / np.linalg.norm(rows.baseline[2:])
    assert dominance(fit) == pytest.approx(expected) and expected > 0.01
    assert dominance(fitted(record)) == 0
