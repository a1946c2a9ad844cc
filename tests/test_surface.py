"""What is wrong in Python is told by an InputError, whatever it is; nothing comes from deep inside."""

from __future__ import annotations

import inspect
import re
import warnings
from pathlib import Path

import numpy as np
import pytest

import orthaug as oa
from orthaug import InputError, Parameter, design_input, read_record
from orthaug._base import memory
from orthaug.fitting.rules import check_cost
from orthaug.physics.problem import pose

WRONG = (
    *(None, True, 5, -1, 0.5, np.nan, np.inf, 1j, 10**400, 10**5000),
    *("", "x", "x\ny", b"x", Path("x"), object(), int, slice(2)),
    *([], [0.1], (0.0, 2.0), [[1, 2], 3], [True, 2], {}, {"a": 1}),
    *(np.ones(3), np.ones((2, 2)), np.array("x")),
)
"""Something of every kind; what is right for an argument is let pass."""


@pytest.fixture(scope="module")
def file(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("surface") / "run.csv"
    path.write_text("t,u,y\n" + "".join(f"{k / 10},{k % 3},{k % 7}\n" for k in range(40)))
    return path


def tried(call, *values) -> int:
    """How many values are refused; what else is raised comes out."""
    refusals = 0
    for value in values or WRONG:
        try:
            call(value)
        except InputError as refusal:
            assert str(refusal).isprintable() and len(str(refusal)) <= 1210
            refusals += 1
    return refusals


@pytest.mark.parametrize(
    "name", ["inputs", "outputs", "sampling_time", "time", "rows", "every", "columns", "missing"]
)
def test_arguments_of_read_record(file, name):
    assert (
        tried(lambda value: read_record(file, **{"inputs": ["u"], "outputs": ["y"], name: value}))
        >= 18
    )


def test_rows_without_a_step_are_said_to_be_a_second_apart(file):
    with pytest.warns(UserWarning, match="1 s apart. Give `sampling_time` in seconds") as found:
        read_record(file, inputs=["u"], outputs=["y"])
    assert found[0].filename == __file__
    for option in ({"sampling_time": 0.1}, {"time": "t"}):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            read_record(file, inputs=["u"], outputs=["y"], **option)


def test_paths_of_read_record():
    assert tried(lambda value: read_record(value, outputs=["y"])) == len(WRONG)


REFUSED = [
    (
        {"sampling_time": "0.1"},
        "the sampling time must be a positive number of seconds, .*; got '0.1'",
    ),
    ({"sampling_time": [0.1]}, r"the sampling time must be .*; got \[0.1\]"),
    ({"sampling_time": 1j}, "the sampling time must be .*; got 1j"),
    ({"sampling_time": True}, "the sampling time must be .*; got True"),
    (
        {"rows": 5},
        r"`rows` must be two whole numbers, \[start, stop\], or a list of such pairs; got 5",
    ),
    ({"rows": slice(0, 5)}, r"`rows` must be .*; got slice\(0, 5, None\)"),
    ({"rows": (0.0, 2.0)}, r"`rows` must be .*; got \(0.0, 2.0\)"),
    ({"rows": [True, 2]}, r"`rows` must be .*; got \[True, 2\]"),
    ({"rows": [[0, 2], 5]}, "`rows` must be two whole numbers"),
    (
        {"inputs": "force"},
        r"`inputs` must be a list of names or Channels, such as \['force'\]; got 'force'",
    ),
    ({"columns": {"y": 3}}, "`columns`: the column of 'y' must be a name; got 3"),
    ({"time": 3}, "`time` must be a column's name; got 3"),
]


@pytest.mark.parametrize(("options", "message"), REFUSED, ids=range(len(REFUSED)))
def test_messages_of_read_record(file, options, message):
    with pytest.raises(InputError, match=message):
        read_record(file, **{"inputs": ["u"], "outputs": ["y"], **options})


def test_arguments_of_channels_and_records():
    u = np.arange(12.0)
    for name in ("name", "unit", "column", "scale", "offset"):
        assert tried(lambda value, name=name: oa.Channel(**{"name": "y", name: value})) >= 15
    for name in ("u", "y", "sampling_time", "inputs", "outputs"):
        assert (
            tried(lambda value, name=name: oa.Record.from_arrays(**{"u": u, "y": u, name: value}))
            >= 15
        )
    record = oa.Record.from_arrays(u, u)
    kept = {
        "inputs": record.inputs,
        "outputs": record.outputs,
        "sampling_time": 1.0,
        "experiments": record.experiments,
    }
    for name in kept:
        assert tried(lambda value, name=name: oa.Record(**{**kept, name: value})) >= 18
    assert tried(record.split) >= 20
    assert tried(lambda value: record.rows(value, 5)) >= 12
    assert tried(lambda value: oa.Record.join([value])) == len(WRONG)


def test_arguments_of_baselines():
    for name in ("parameter", "regressor", "initial", "unit", "output", "fixed", "min", "max"):
        kept = {"parameter": "a", "regressor": "u[k]"}

        def call(value, name=name, kept=kept):
            return oa.Baseline.from_terms([oa.Term(**{**kept, name: value})])

        assert tried(call) >= 14
    assert tried(oa.Baseline.from_terms) == len(WRONG)
    assert tried(lambda value: oa.Baseline.from_terms([oa.Term("a", "u[k]")], value)) >= 14
    assert tried(lambda value: oa.Baseline.from_terms([oa.Term("a", "u[k]*c")], {"c": value})) >= 20
    for name in ("name", "initial", "unit", "min", "max"):
        assert tried(lambda value, name=name: Parameter(**{"name": "a", name: value})) >= 14
    assert tried(lambda value: oa.Baseline.from_function(value, ["a"])) >= len(WRONG) - 1
    assert tried(lambda value: oa.Baseline.from_function(abs, value)) >= 20


@pytest.mark.parametrize(
    "name", ["a b", "<b>x</b>", "=1+1", "../../x", "x" * 10_000, "", "1a", "a\n", "$a$"]
)
def test_parameters_are_identifiers(name):
    with pytest.raises(
        InputError, match="cannot name a parameter; use letters, digits and underscores, at most 60"
    ):
        oa.Baseline.from_terms([oa.Term(name, "u[k]")])
    with pytest.raises(InputError, match="cannot name a parameter"):
        oa.Baseline.from_function(abs, [name])


def test_arguments_of_lags_and_learners():
    record = oa.Record.from_arrays(np.arange(12.0) % 5, np.arange(12.0) % 7)
    baseline = oa.Baseline.from_terms([oa.Term("a", "u[k]")])
    for name in ("na", "nb", "nk"):
        assert (
            tried(
                lambda value, name=name: pose(record, baseline, oa.Lags(**{"nb": 1, name: value}))
            )
            >= 18
        )
    for name in ("hidden", "activation", "inputs"):
        assert (
            tried(
                lambda value, name=name: pose(
                    record, baseline, None, oa.MLP(**{name: value}).inputs
                )
            )
            >= 14
        )
    for name in ("record", "baseline", "lags", "learner", "structure", "criterion", "solver", "regularization",
                 "restarts", "seed", "initial", "validation", "output_weights"):  # fmt: skip
        kept = {"record": record, "baseline": baseline, "learner": None}
        assert tried(lambda value, name=name, kept=kept: oa.estimate(**{**kept, name: value})) >= 8


def test_a_simulation_says_what_it_wants():
    record = oa.Record.from_arrays(np.arange(12.0) % 5, np.arange(12.0) % 7, sampling_time=0.5)
    model = oa.estimate(record, oa.Baseline.from_terms([oa.Term("a", "u[k]")]), learner=None).model
    for call, y in ((model.simulate, ("", "")), (model.predict, ("y=y, ", "outputs=['y'], "))):
        wanted = (
            f"a Record, such as Record.from_arrays(u=u, {y[0]}inputs=['u'], "
            f"{y[1]}sampling_time=0.5)"
        )
        with pytest.raises(InputError) as refusal:
            call(np.ones(12))
        assert str(refusal.value) == f"`record` must be {wanted}; got an array of shape (12,)."
    for call in (model.simulate, model.predict, model.components):
        assert tried(call) == len(WRONG)
    assert tried(lambda value: model.predict(record, horizon=value)) >= 20
    assert tried(lambda value: model.simulate(record, initial=value)) >= 10


LARGE = [
    (
        dict(hidden=(10**9,)),
        {},
        "training a learner of 5000000001 weights would take .* PiB of memory",
    ),
    (dict(hidden=(10_000, 10_000)), {}, "training a learner of .* weights would take"),
    (dict(hidden=(10**400,)), {}, "training a learner of .* weights would take"),
    (dict(hidden=(2,)), {"restarts": 10**9}, r"weights in 1000000000 runs would take"),
    (
        dict(hidden=(30, 30)),
        {"restarts": 10**5, "rows": 100_000},
        r"on 100000 rows would take .* or more; 30 days are the",
    ),
]


@pytest.mark.parametrize(("learner", "options", "message"), LARGE, ids=range(len(LARGE)))
def test_what_a_fit_would_cost_is_refused_past_the_limits(monkeypatch, learner, options, message):
    runs = options.get("restarts", 1)
    monkeypatch.setattr(memory, "available", lambda: 8 * 2**30)
    with pytest.raises(InputError, match=message):
        check_cost(
            oa.MLP(**learner),
            rows=options.get("rows", 300),
            features=3,
            outputs=1,
            iterations=300,
            runs=runs,
        )


def test_a_fit_is_refused_before_anything_is_allocated():
    record = oa.Record.from_arrays(np.arange(12.0) % 5, np.arange(12.0) % 7)
    baseline = oa.Baseline.from_terms([oa.Term("a", "u[k]")])
    with pytest.raises(InputError, match="would take .* of memory; .* are available"):
        oa.estimate(record, baseline, learner=oa.MLP(hidden=(10**9,)))
    with pytest.raises(InputError, match="runs would take"):
        oa.estimate(record, baseline, learner=oa.MLP(hidden=(2,)), restarts=10**12)
    with pytest.raises(InputError, match="`hidden` has 30 layers; at most 10 are allowed"):
        oa.MLP(hidden=(8,) * 30)


def test_designs_are_refused_past_the_limits():
    baseline = oa.Baseline.from_terms([oa.Term("a", "u[k]", initial=1.0)])
    kept = {
        "outputs": ["y"],
        "inputs": ["u"],
        "sampling_time": 0.1,
        "samples": 100,
        "amplitude": 1.0,
    }
    for change, message in (
        ({"samples": 10**12}, "`samples` is 1000000000000; at most 10000000 are simulated"),
        ({"amplitude": 1e308}, r"`amplitude` must lie between 1e-100 and 1e\+100; got 1e\+308"),
        ({"amplitude": 1e-308}, "`amplitude` must lie between"),
    ):
        with pytest.raises(InputError, match=message):
            design_input(baseline, **{**kept, **change})
    for name in (
        "sampling_time",
        "samples",
        "amplitude",
        "rate",
        "noise",
        "theta",
        "weights",
        "condition",
        "channel",
        "seed",
    ):
        assert (
            tried(
                lambda value, name=name: design_input(
                    baseline, iterations=0, **{**kept, name: value}
                )
            )
            >= 12
        )


def test_a_misspelt_name_is_answered_with_the_nearest():
    with pytest.raises(AttributeError, match="has no attribute 'estmate', did you mean 'estimate'"):
        oa.estmate  # noqa: B018
    with pytest.raises(AttributeError, match="has no attribute 'qqq'"):
        oa.qqq  # noqa: B018
    assert not hasattr(oa, "__wrapped__")


def test_docstrings_for_users_cite_no_label_without_its_source():
    label = re.compile(r"\((?:eq:\w+|[FS]\d+)\)|^\s*Φ⁺Y\b", re.MULTILINE)
    faces = [getattr(oa, name) for name in dir(oa) if not name.startswith("_")]
    members = [
        inspect.getattr_static(face, name)
        for face in faces
        if inspect.isclass(face)
        for name in dir(face)
        if not name.startswith("_")
    ]
    bare = {
        getattr(one, "__qualname__", one)
        for one in [*faces, *members]
        if label.search(inspect.getdoc(one) or "")
    }
    assert not bare
