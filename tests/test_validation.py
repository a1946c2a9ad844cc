"""A validation part chooses between restarts and regularizations, and is never fitted."""

from __future__ import annotations

import json

import numpy as np
import pytest
from test_cli import MLP as NETWORK
from test_cli import SPEC, make_project, one_line, run, signals, write_csv
from test_parallel import PHYSICS, record_of

from orthaug import (
    MLP,
    AdamLBFGS,
    Additive,
    InputError,
    LevenbergMarquardt,
    Orthogonal,
    Prediction,
    Simulation,
    estimate,
    load,
)
from orthaug.fitting.rules import choose_regularizations

pytestmark = pytest.mark.usefixtures("without_figures", "without_trials")

TRAIN, VALIDATION = record_of(0, rows=60), record_of(1, rows=90)
OPTIONS = {"learner": MLP(hidden=(8,)), "solver": LevenbergMarquardt(iterations=60)}
CHOICES = ("none", "evidence", 1.0)


@pytest.fixture(scope="module")
def chosen():
    return estimate(
        TRAIN, PHYSICS, regularization=CHOICES, restarts=3, seed=2, validation=VALIDATION, **OPTIONS
    )


@pytest.fixture(scope="module")
def candidates():
    """Every run on its own, without a validation record."""
    return {
        (seed, choice): estimate(TRAIN, PHYSICS, regularization=choice, seed=seed, **OPTIONS)
        for choice in CHOICES
        for seed in (2, 3, 4)
    }


def error(fit) -> float:
    """Mean squared one-step error on the validation record, in standard deviations of the training output."""
    measured = VALIDATION.experiments[0].outputs[1:, 0]
    model = fit.model.predict(VALIDATION).model[1:, 0]
    return float(np.mean((measured - model) ** 2) / np.var(TRAIN.experiments[0].outputs[1:, 0]))


def test_every_candidate_is_what_it_would_be_without_validation(chosen, candidates):
    assert [(r.seed, r.regularization) for r in chosen.restarts] == list(candidates)
    for restart, fit in zip(chosen.restarts, candidates.values(), strict=True):
        assert (restart.loss, restart.iterations, restart.code) == (
            fit.restarts[0].loss,
            fit.restarts[0].iterations,
            fit.restarts[0].code,
        )
        assert fit.restarts[0].validation is None
        assert fit.theta.tobytes() == chosen.theta.tobytes()


def test_the_lowest_validation_error_is_chosen(chosen, candidates):
    errors = [error(fit) for fit in candidates.values()]
    np.testing.assert_allclose([r.validation for r in chosen.restarts], errors, rtol=1e-9)
    assert [r.chosen for r in chosen.restarts] == [value == min(errors) for value in errors]
    losses = [r.loss for r in chosen.restarts]
    assert np.argmin(losses) != np.argmin(errors)  # training loss would have chosen another
    best = list(candidates.values())[int(np.argmin(errors))]
    assert (
        np.asarray(chosen.model.numbers.weights).tobytes()
        == np.asarray(best.model.numbers.weights).tobytes()
    )
    assert chosen.status.loss == best.status.loss
    assert chosen.std.tobytes() == best.std.tobytes()


def test_another_validation_record_changes_the_choice_and_nothing_else(chosen):
    """The training data themselves: the lowest loss is the lowest error."""
    other = estimate(
        TRAIN, PHYSICS, regularization=CHOICES, restarts=3, seed=2, validation=TRAIN, **OPTIONS
    )
    assert [r.loss for r in other.restarts] == [r.loss for r in chosen.restarts]
    losses = [r.loss for r in other.restarts]
    np.testing.assert_allclose([r.validation for r in other.restarts], losses, rtol=1e-6)
    assert [r.chosen for r in other.restarts].index(True) == int(np.argmin(losses))
    assert other.theta.tobytes() == chosen.theta.tobytes()


@pytest.fixture(scope="module")
def auto():
    return estimate(TRAIN, PHYSICS, restarts=3, seed=2, **OPTIONS)


def test_auto_runs_none_and_ard_and_keeps_the_lowest_score(auto, candidates):
    samples, fits = len(auto.problem.rows), [candidates[s, "none"] for s in (2, 3, 4)]
    fits += [
        estimate(TRAIN, PHYSICS, regularization="ard", seed=seed, **OPTIONS) for seed in (2, 3, 4)
    ]
    left = [samples - len(fit.theta) - 1.4 * fit.effective_weights for fit in fits]
    scores = [
        fit.restarts[0].loss / n**2 if n > 0 else np.inf for fit, n in zip(fits, left, strict=True)
    ]
    best = int(np.argmin(scores))
    kept = [
        i if scores[i] <= scores[i + 3] else i + 3 for i in range(3)
    ]  # of each start the better one
    found = [fits[i].restarts[0] for i in kept]
    assert [(r.seed, r.regularization, r.loss) for r in auto.restarts] == [
        (r.seed, r.regularization, r.loss) for r in found
    ]
    assert [r.chosen for r in auto.restarts] == [i == best for i in kept]
    np.testing.assert_array_equal(auto.model.numbers.weights, fits[best].model.numbers.weights)
    losses = [fit.restarts[0].loss for fit in fits]
    assert fits[best].restarts[0].regularization == "ard" and losses[best] > min(
        losses
    )  # not what training would choose


def test_an_ensemble_takes_one_run_of_each_start(auto):
    fit = estimate(TRAIN, PHYSICS, restarts=3, seed=2, ensemble=True, **OPTIONS)
    taken = [r for r in fit.restarts if r.chosen]
    assert sorted(r.seed for r in taken) == [2, 3, 4]
    assert {r.seed: r.regularization for r in auto.restarts if r.chosen}.items() <= {
        r.seed: r.regularization for r in taken
    }.items()


FREE, PAPER = Simulation(), AdamLBFGS()
STANDS_FOR = [
    ({}, ("none", "ard")),
    ({"validated": True}, ("none", "ard")),
    ({"linear": False}, ("none",)),
    ({"criterion": Prediction(2)}, ("none",)),
    ({"criterion": FREE}, ("none",)),
    ({"criterion": FREE, "validated": True}, ("none", "evidence")),
    ({"solver": PAPER, "validated": True}, ("none",)),
    ({"structure": Additive(from_initial=True)}, ("none",)),
    ({"given": ["evidence", 2.0]}, ("evidence", 2.0)),
    ({"given": 0.5}, (0.5,)),
]


@pytest.mark.parametrize(("change", "expected"), STANDS_FOR)
def test_what_auto_stands_for(change, expected):
    usual = {
        "given": "auto",
        "solver": LevenbergMarquardt(),
        "criterion": Prediction(),
        "structure": Orthogonal(),
    }
    assert (
        choose_regularizations(**(usual | {"linear": True, "validated": False} | change))
        == expected
    )


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"criterion": FREE}, "ard regularization is for training one step ahead; use evidence"),
        ({"solver": PAPER}, "ard regularization needs the Gauss-Newton matrix"),
    ],
)
def test_ard_is_refused(arguments, words):
    with pytest.raises(InputError, match=words):
        estimate(TRAIN, PHYSICS, **({**OPTIONS, "regularization": "ard"} | arguments))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"regularization": ("none", "evidence"), "blocks": 0},
            "several regularizations need `validation` or `blocks`",
        ),
        ({"blocks": 1}, "`blocks` must be 2 or more, or 0 for none; got 1"),
        (
            {"regularization": (), "validation": VALIDATION},
            "`regularization` is empty; give auto, none, evidence, ard or a number",
        ),
        (
            {"regularization": ["none", "ridge"], "validation": VALIDATION},
            "must be one of none, evidence, ard; got 'ridge'",
        ),
        (
            {"regularization": ["none", -1.0], "validation": VALIDATION},
            "`regularization` must be 0 or more; got -1.0",
        ),
        ({"validation": np.zeros((9, 2))}, "`validation` must be a Record or None"),
        ({"seed": 2**63}, "`seed` must be below 2..63"),
        ({"seed": 2**63 - 2, "restarts": 2}, "`seed` must be below 2..63"),
    ],
)
def test_refused(arguments, message):
    with pytest.raises(InputError, match=message):
        estimate(TRAIN, PHYSICS, **arguments)


# through the spec

TRAINING = NETWORK + "restarts = 2\nseed = 5\n"
PART = '[data.validation]\nfiles = ["valid.csv"]\nskip = 3\n[data.channels.y]'


@pytest.fixture
def project(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    u, y = signals(80, 3)
    write_csv(tmp_path / "valid.csv", u=u, y=y)
    return make_project(tmp_path, spec())


def spec(training: str = TRAINING, part: str = PART) -> str:
    return SPEC.replace('kind = "none"\n', training).replace("[data.channels.y]", part)


def test_the_table_of_a_fit(project):
    done = run("fit", project, "--json", "--out", "out")
    assert (done.code, done.err) == (0, "")
    result = json.loads(done.out)
    assert result["data"]["validation"][0] | {"sha256": ""} == {
        "file": "valid.csv",
        "sha256": "",
        "rows": 80,
    }
    assert list(result["scores"]) == ["train", "validation", "tests.steps"]
    assert result["scores"]["validation"]["prediction"]["rmse"][0] > 0
    assert result["validation"]["verdict"] in (
        "helps",
        "no_help",
        "hurts",
    )  # on the learner
    table = result["restarts"]
    assert [(r["seed"], r["regularization"]) for r in table] == [
        (5, "none"),
        (6, "none"),
        (5, "ard"),
        (6, "ard"),
    ]
    errors = [r["validation"] for r in table]
    assert all(r["loss"] > 0 and r["validation"] > 0 for r in table)
    assert [r["chosen"] for r in table] == [value == min(errors) for value in errors]
    assert result["status"]["loss"] == pytest.approx(table[errors.index(min(errors))]["loss"])

    project.write_text(spec(part="[data.channels.y]"))
    alone = json.loads(run("fit", project, "--json", "--out", "alone").out)
    assert [r["seed"] for r in alone["restarts"]] == [5, 6]
    assert {r["loss"] for r in alone["restarts"]} <= {
        r["loss"] for r in table
    }  # of each start the better one
    assert [r["validation"] for r in alone["restarts"]] == [None, None]
    assert [p["value"] for p in alone["parameters"]] == [p["value"] for p in result["parameters"]]
    assert "validation" not in alone["scores"]
    assert load("out").theta.tobytes() == load("alone").theta.tobytes()


@pytest.mark.parametrize(
    ("training", "tried"),
    [
        ('regularization = ["none", 0.5, "evidence"]\n', ["none", 0.5, "evidence"]),
        ("regularization = 0.5\n", [0.5]),
        ('regularization = "evidence"\n', ["evidence"]),
        ('solver = "adam-lbfgs"\nadam_iterations = 5\nlbfgs_iterations = 5\n', ["none"]),
    ],
)
def test_what_is_tried(project, training, tried):
    project.write_text(spec(NETWORK + training))
    result = json.loads(run("fit", project, "--json").out)
    assert [r["regularization"] for r in result["restarts"]] == tried


def test_skipped_samples_do_not_choose(project):
    """An outlier in row 2 reaches predictions up to row 4; the part's score begins with row 5."""
    u, y = signals(80, 3)
    y[2] = 1e6
    write_csv(project.parent / "valid.csv", u=u, y=y)
    project.write_text(spec(part=PART.replace("skip = 3", "skip = 5")))
    result = json.loads(run("fit", project, "--json").out)
    assert result["scores"]["validation"]["prediction"]["rmse"][0] < 1
    assert all(r["validation"] < 1 for r in result["restarts"])


REFUSED = [
    (
        spec(
            NETWORK + 'regularization = ["none", 0.5]\n',
            "[validation]\nblocks = 0\n[data.channels.y]",
        ),
        ["list; expected [data.validation] or `validation.blocks`"],
    ),
    (
        spec(NETWORK + "regularization = []\n"),
        ["'training.regularization': found []", "at least one entry"],
    ),
    (
        spec(NETWORK + 'regularization = ["none", "ridge"]\n'),
        ["'training.regularization[1]'", '"ridge"', "evidence"],
    ),
    (
        spec(NETWORK + 'solver = "adam-lbfgs"\nregularization = ["none", "evidence"]\n'),
        ["levenberg-marquardt"],
    ),
    (spec(part=PART.replace("valid.csv", "absent.csv")), ["absent.csv: no such file"]),
    (
        spec(part=PART.replace("skip = 3", "skip = 80")),
        ["valid.csv", "data.validation has 80 rows, too few"],
    ),
    (
        spec(part=PART.replace("skip = 3", "every = 2")),
        ["data.validation: sampled every 1 s, the training data"],
    ),
    (
        spec(part=PART.replace("skip = 3", 'columns = { z = "y" }')),
        ["'data.validation.columns'", "'z' is neither"],
    ),
]


@pytest.mark.parametrize(("text", "words"), REFUSED, ids=[words[0] for _, words in REFUSED])
def test_refused_specs(project, text, words):
    project.write_text(text)
    done = run("fit", project, "--out", "out")
    assert (done.code, done.out) == (2, "")
    assert one_line(done.err, "error: ", *words)
