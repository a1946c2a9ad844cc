"""The spec file: what a valid one declares, its defaults, and the words of every refusal."""

from __future__ import annotations

import re
from pathlib import Path
from typing import get_args

import pytest

from orthaug import Channel, InputError, Lags, Parameter, Term
from orthaug.commands.parts import load_parts
from orthaug.commands.spec import load_spec
from orthaug.models.learners import ACTIVATIONS

LEAST = """
[data]
inputs = ["u"]
outputs = ["y"]
train = { files = ["run.csv"] }
[[baseline.terms]]
parameter = "a"
regressor = "y[k-1]"
"""

FULL = """
[data]
sampling_time = 0.01
inputs = ["force", "voltage"]
outputs = ["position", "angle"]
train = { files = ["run1.csv", "sub/run2.csv"], rows = [[0, 240], [480, 720]], every = 2, skip = 10 }
[data.tests.steps]
files = ["steps.csv"]
rows = [0, 9000]
skip = 50
columns = { position = "yVal" }
[data.tests.sweep]
files = ["sweep.parquet"]
[data.channels.force]
column = "F (N)"
unit = "N"
scale = 0.001
offset = -2
[data.channels.angle]
unit = "rad"

[lags]
na = [2, 1]
nb = 1
nk = [0, 1]

[[baseline.terms]]
parameter = "theta1"
regressor = "g*position[k-1]"
initial = 0.61
unit = "1"
output = "position"
[[baseline.terms]]
parameter = "offset"
regressor = 1
output = "angle"
[[baseline.terms]]
parameter = "known"
regressor = "angle[k-1]"
initial = 2
fixed = true
output = "angle"
[baseline.constants]
g = 9.81

[learner]
kind = "mlp"
hidden = [16, 8]
activation = "gelu"
inputs = ["position[k-1]", "sin(force[k])"]

[structure]
kind = "additive"
weight = 2.0
[structure.measure]
kind = "training"

[training]
solver = "levenberg-marquardt"
iterations = 50
adam_iterations = 10
lbfgs_iterations = 10
learning_rate = 1e-2
focus = "prediction"
segment = 256
washout = 20
restarts = 3
seed = 7
regularization = 0.1
"""


def put(folder: Path, content: str | bytes) -> Path:
    path = folder / "machine.toml"
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def edited(text: str, old: str, new: str) -> str:
    """`text` with a piece that stands in it replaced."""
    assert old in text
    return text.replace(old, new)


def test_a_full_spec(tmp_path):
    spec = load_spec(put(tmp_path, FULL))
    assert (spec.data.sampling_time, spec.data.time) == (0.01, None)
    assert spec.data.train.files == ["run1.csv", "sub/run2.csv"]
    assert spec.data.train.rows == [[0, 240], [480, 720]]
    assert (spec.data.train.every, spec.data.train.skip) == (2, 10)
    assert list(spec.data.tests) == ["steps", "sweep"]
    assert spec.data.tests["steps"].rows == [0, 9000]
    assert spec.data.tests["steps"].columns == {"position": "yVal"}
    assert spec.channels(spec.data.inputs) == (
        Channel("force", "N", "F (N)", 0.001, -2.0),
        Channel("voltage"),
    )
    assert spec.channels(spec.data.outputs) == (Channel("position"), Channel("angle", "rad"))
    assert spec.lag_orders() == Lags(na=(2, 1), nb=1, nk=(0, 1))
    assert spec.learner_inputs() == ("position[k-1]", "sin(force[k])")
    assert (spec.learner.hidden, spec.learner.activation) == ([16, 8], "gelu")
    assert (spec.structure.kind, spec.training.regularization) == ("additive", 0.1)
    assert (spec.training.iterations, spec.training.restarts, spec.training.seed) == (50, 3, 7)


def test_the_physics_of_a_full_spec(tmp_path):
    baseline = load_spec(put(tmp_path, FULL)).declared_baseline()
    assert baseline.parameters == (Parameter("theta1", 0.61, "1"), Parameter("offset"))
    assert baseline.constants == (("g", 9.81),)
    assert [term.output for term in baseline.terms] == ["position", "angle", "angle"]
    assert [term.fixed for term in baseline.terms] == [False, False, True]
    assert float(baseline.terms[1].regressor) == 1.0
    assert isinstance(baseline.terms[0], Term)


def test_defaults(tmp_path):
    spec = load_spec(put(tmp_path, LEAST))
    part, learner, training = spec.data.train, spec.learner, spec.training
    assert (part.rows, part.every, part.skip, part.columns, spec.data.tests) == (None, 1, 0, {}, {})
    assert spec.channels(spec.data.inputs) == (Channel("u"),)
    assert (spec.lag_orders(), spec.learner_inputs()) == (None, None)
    assert (learner.kind, learner.hidden, learner.activation) == ("mlp", [16], "tanh")
    assert (spec.structure.kind, spec.structure.measure.kind, spec.structure.weight) == (
        "orthogonal",
        "training",
        1.0,
    )
    assert (training.solver, training.focus, training.iterations) == (
        "levenberg-marquardt",
        "auto",
        300,
    )
    assert (training.restarts, training.seed, training.regularization) == (1, 0, "auto")
    assert (training.segment, training.washout) == ("auto", 40)


@pytest.mark.parametrize(
    ("train", "files"),
    [
        ('"a.csv"', ["a.csv"]),
        ('["a.csv", "b.csv"]', ["a.csv", "b.csv"]),
        ('{ files = "a.csv" }', ["a.csv"]),
    ],
)
def test_a_part_may_be_the_name_of_its_file(tmp_path, train, files):
    given = next(line for line in LEAST.splitlines() if line.startswith("train"))
    spec = load_spec(put(tmp_path, edited(LEAST, given, f"train = {train}")))
    assert spec.data.train.files == files


MOTION = """
[motion.states]
x = { derivative = "-a*x + u", start = "y" }
[motion.outputs]
y = "x"
[motion.parameters]
a = { initial = 1.0 }
"""


@pytest.mark.parametrize("segment", [8, 32, 40, 41])
def test_a_segment_may_be_shorter_than_the_usual_washout(tmp_path, segment):
    training = f'[training]\nfocus = "simulation"\nsegment = {segment}\n'
    lagged = load_spec(put(tmp_path, LEAST + training)).declared_criterion()
    assert (lagged.segment, lagged.washout) == (segment, segment // 4 if segment <= 40 else 40)
    data = LEAST[: LEAST.index("[[baseline")]
    motion = load_spec(put(tmp_path, data + MOTION + training)).declared_criterion()
    assert (motion.segment, motion.washout) == (segment, 0)


def test_without_inputs_with_a_time_column_and_without_a_learner(tmp_path):
    text = (
        edited(LEAST, 'inputs = ["u"]', 'inputs = []\ntime = "t"')
        + '[learner]\nkind = "none"\ninputs = ["y[k-1]"]\n'
    )
    spec = load_spec(put(tmp_path, text))
    assert (spec.data.inputs, spec.data.time, spec.data.sampling_time) == ([], "t", None)
    assert spec.learner_inputs() is None


def test_known_keys_without_effect_for_the_chosen_kind_are_accepted(tmp_path):
    text = (
        LEAST
        + '[learner]\nkind = "none"\nhidden = [3]\n[training]\nsegment = 0\nwashout = 0\nlearning_rate = 1.0\n'
    )
    assert load_spec(put(tmp_path, text)).learner.kind == "none"
    text = (
        LEAST
        + '[structure]\nkind = "additive"\nmeasure = { kind = "uniform", box = { "u[k-1]" = [-1, 1] } }\n'
    )
    assert load_spec(put(tmp_path, text)).structure.kind == "additive"


def test_the_activations_are_the_learners(tmp_path):
    section = type(load_spec(put(tmp_path, LEAST)).learner)
    assert set(get_args(section.model_fields["activation"].annotation)) == set(ACTIVATIONS)


def refused(folder: Path, content: str | bytes) -> str:
    """The message, checked to be one line that begins with the file."""
    path = put(folder, content)
    with pytest.raises(InputError) as refusal:
        load_spec(path)
    message = str(refusal.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    return message.removeprefix(f"{path}: ")


NOT_TOML = [
    (b"", "the file is empty"),
    ("[data\n", "broken TOML: .*line 1"),
    ("a = 1\na = 2\n", "broken TOML: .*line 2"),
    ("a = \n", "broken TOML"),
    ("u,y\n1,2\n", "broken TOML"),
    ("x = { start = .8 }\n", r"a digit on both sides of the point: 0\.8, not \.8\."),
    ('note = "of .5" # 1.\na = [1, -.25]\n', r"of the point: -0\.25, not -\.25\."),
    ("a = 10.\n", r"of the point: 10\.0, not 10\.\."),
    ('a.b = "x"\nc = [1.5, 2\n', r"broken TOML(?!.*both sides)"),
    (b"a = '\xff\xfe'\n", "not a text file; expected TOML in UTF-8"),
    (bytes(range(256)), "broken TOML|not a text file"),
]


@pytest.mark.parametrize(("content", "message"), NOT_TOML, ids=range(len(NOT_TOML)))
def test_files_that_are_no_toml(tmp_path, content, message):
    assert re.search(message, refused(tmp_path, content))


@pytest.mark.parametrize("content", [b"u,y\n1,2\n", bytes(range(256))])
def test_a_data_file_in_the_place_of_a_spec_is_named(tmp_path, monkeypatch, content):
    monkeypatch.chdir(tmp_path)
    Path("motor.csv").write_bytes(content)
    with pytest.raises(InputError, match="^motor.csv: found a data file; expected a spec") as error:
        load_spec(Path("motor.csv"))
    assert "`orthaug init motor.csv` writes" in str(error.value)


def test_no_list_is_suggested_where_its_entry_would_be_wrong(tmp_path):
    message = refused(tmp_path, FULL.replace("hidden = [16, 8]", "hidden = 16.5"))
    assert "'learner.hidden': found 16.5; expected a list." in message


def test_a_byte_order_mark_is_no_broken_toml(tmp_path):
    """Windows editors write one; data files with it are read too."""
    assert load_spec(put(tmp_path, b"\xef\xbb\xbf" + LEAST.encode())).data.outputs == ["y"]


def test_a_file_that_is_not_there_or_is_a_folder(tmp_path):
    with pytest.raises(InputError, match="machine.toml: no such file"):
        load_spec(tmp_path / "machine.toml")
    with pytest.raises(InputError, match=": not a file"):
        load_spec(tmp_path)


PLACES = [  # what is added or changed in FULL, the key that is unknown, the nearest known one
    ("[learner]", "[learnr]", "learnr", "learner"),
    ("sampling_time = 0.01", "samplingtime = 0.01", "data.samplingtime", "sampling_time"),
    ("every = 2", "evry = 2", "data.train.evry", "every"),
    ("[data.tests.steps]", "[data.tests.steps]\nskp = 3", "data.tests.steps.skp", "skip"),
    ('unit = "N"', 'units = "N"', "data.channels.force.units", "unit"),
    ("nk = [0, 1]", "nkk = [0, 1]", "lags.nkk", "nk"),
    ("initial = 0.61", "inital = 0.61", "baseline.terms[0].inital", "initial"),
    ("[baseline.constants]", "[baseline.constant]", "baseline.constant", "constants"),
    ("hidden = [16, 8]", "hiden = [16, 8]", "learner.hiden", "hidden"),
    ("weight = 2.0", "weigth = 2.0", "structure.weigth", "weight"),
    (
        '[structure.measure]\nkind = "training"',
        '[structure.measure]\nknd = "training"',
        "structure.measure.knd",
        "kind",
    ),
    ("restarts = 3", "restart = 3", "training.restart", "restarts"),
]


@pytest.mark.parametrize(
    ("old", "new", "key", "nearest"), PLACES, ids=[place[2] for place in PLACES]
)
def test_unknown_keys_name_the_nearest_known_one(tmp_path, old, new, key, nearest):
    message = refused(tmp_path, edited(FULL, old, new))
    assert f"unknown key '{key}'" in message
    assert f"did you mean '{nearest}'" in message


def test_an_unknown_key_like_no_other_names_those_that_are_known(tmp_path):
    message = refused(tmp_path, LEAST + "[lags]\nxyz = 1\n")
    assert "unknown key 'lags.xyz', known are na, nb, nk" in message
    assert "known are data, lags, baseline" in refused(tmp_path, LEAST + "[xyz]\n")


MISSING = [
    ('outputs = ["y"]\n', "data.outputs"),
    ('train = { files = ["run.csv"] }\n', "data.train"),
    ('files = ["run.csv"]', "data.train.files"),
    ('parameter = "a"\n', "baseline.terms[0].parameter"),
    ('regressor = "y[k-1]"\n', "baseline.terms[0].regressor"),
    ('[[baseline.terms]]\nparameter = "a"\nregressor = "y[k-1]"\n', "baseline"),
]


@pytest.mark.parametrize(("piece", "key"), MISSING, ids=[key for _, key in MISSING])
def test_missing_keys(tmp_path, piece, key):
    assert f"the key '{key}' is missing" in refused(tmp_path, edited(LEAST, piece, ""))


def test_missing_data(tmp_path):
    assert "the key 'data' is missing" in refused(tmp_path, '[learner]\nkind = "none"\n')


VALUES = [  # (changed in FULL), the key, what was found, what is expected
    ("sampling_time = 0.01", 'sampling_time = "fast"', "data.sampling_time", '"fast"', "number"),
    ("sampling_time = 0.01", 'sampling_time = "0.01"', "data.sampling_time", '"0.01"', "number"),
    ("sampling_time = 0.01", "sampling_time = true", "data.sampling_time", "true", "number"),
    ("sampling_time = 0.01", "sampling_time = 0", "data.sampling_time", "0", "greater than 0"),
    (
        "sampling_time = 0.01",
        "sampling_time = -0.01",
        "data.sampling_time",
        "-0.01",
        "greater than 0",
    ),
    (
        "sampling_time = 0.01",
        "sampling_time = 1e300",
        "data.sampling_time",
        "1e+300",
        "less than or equal to",
    ),
    ("sampling_time = 0.01", "sampling_time = inf", "data.sampling_time", "inf", "finite"),
    ('inputs = ["force", "voltage"]', 'inputs = "force"', "data.inputs", '"force"', "list"),
    ('outputs = ["position", "angle"]', "outputs = []", "data.outputs", "[]", "at least one entry"),
    ('outputs = ["position", "angle"]', "outputs = [1]", "data.outputs[0]", "1", "string"),
    (
        'files = ["run1.csv", "sub/run2.csv"]',
        "files = []",
        "data.train.files",
        "[]",
        "at least one entry",
    ),
    (
        'files = ["run1.csv", "sub/run2.csv"]',
        "files = true",
        "data.train.files",
        "true",
        "list",
    ),
    (
        "rows = [0, 9000]",
        "rows = [0]",
        "data.tests.steps.rows",
        "[0]",
        "two numbers, [start, stop]",
    ),
    (
        "rows = [0, 9000]",
        "rows = [0, 10, 20]",
        "data.tests.steps.rows",
        "[0, 10, 20]",
        "two numbers, [start, stop]",
    ),
    (
        "rows = [0, 9000]",
        "rows = [-5, 10]",
        "data.tests.steps.rows[0]",
        "-5",
        "greater than or equal to 0",
    ),
    ("rows = [0, 9000]", "rows = [0, 1.5]", "data.tests.steps.rows[1]", "1.5", "integer"),
    ("rows = [0, 9000]", 'rows = "all"', "data.tests.steps.rows", '"all"', "list"),
    ("rows = [0, 9000]", "rows = []", "data.tests.steps.rows", "[]", "two numbers, [start, stop]"),
    ("every = 2", "every = 0", "data.train.every", "0", "greater than or equal to 1"),
    ("every = 2", "every = 1.5", "data.train.every", "1.5", "integer"),
    ("skip = 50", "skip = -1", "data.tests.steps.skip", "-1", "greater than or equal to 0"),
    ("skip = 50", "skip = true", "data.tests.steps.skip", "true", "integer"),
    ("scale = 0.001", 'scale = "milli"', "data.channels.force.scale", '"milli"', "number"),
    ("scale = 0.001", "scale = nan", "data.channels.force.scale", "nan", "finite"),
    ("na = [2, 1]", "na = -1", "lags.na", "-1", "greater than or equal to 0"),
    ("na = [2, 1]", "na = [2, -1]", "lags.na[1]", "-1", "greater than or equal to 0"),
    ("na = [2, 1]", "na = 1.5", "lags.na", "1.5", "integer"),
    ('parameter = "theta1"', 'parameter = ""', "baseline.terms[0].parameter", '""', "some text"),
    (
        'regressor = "g*position[k-1]"',
        "regressor = []",
        "baseline.terms[0].regressor",
        "[]",
        "string or a number",
    ),
    ("initial = 0.61", 'initial = "big"', "baseline.terms[0].initial", '"big"', "number"),
    ("initial = 0.61", "initial = nan", "baseline.terms[0].initial", "nan", "finite"),
    ("fixed = true", 'fixed = "yes"', "baseline.terms[2].fixed", '"yes"', "boolean"),
    ("g = 9.81", 'g = "9.81 m/s2"', "baseline.constants.g", '"9.81 m/s2"', "number"),
    ('kind = "mlp"', 'kind = "gp"', "learner.kind", '"gp"', "'mlp', 'terms' or 'none'"),
    ("hidden = [16, 8]", "hidden = 16", "learner.hidden", "16", "a list, such as hidden = [16]"),
    (
        "hidden = [16, 8]",
        "hidden = [16, 0]",
        "learner.hidden[1]",
        "0",
        "greater than or equal to 1",
    ),
    ("hidden = [16, 8]", "hidden = [16.5]", "learner.hidden[0]", "16.5", "integer"),
    (
        'activation = "gelu"',
        'activation = "relu6"',
        "learner.activation",
        '"relu6"',
        "'tanh', 'relu'",
    ),
    (
        'kind = "additive"',
        'kind = "parallel"',
        "structure.kind",
        '"parallel"',
        "'additive', 'orthogonal'",
    ),
    ("weight = 2.0", "weight = -2.0", "structure.weight", "-2.0", "greater than or equal to 0"),
    (
        'kind = "training"',
        'kind = "gauss"',
        "structure.measure.kind",
        '"gauss"',
        "'training', 'symmetrized'",
    ),
    (
        'solver = "levenberg-marquardt"',
        'solver = "lm"',
        "training.solver",
        '"lm"',
        "'levenberg-marquardt'",
    ),
    ("iterations = 50", "iterations = 0", "training.iterations", "0", "greater than or equal to 1"),
    ("restarts = 3", "restarts = 0", "training.restarts", "0", "greater than or equal to 1"),
    ("seed = 7", "seed = -1", "training.seed", "-1", "greater than or equal to 0"),
    ("seed = 7", "seed = 1.0", "training.seed", "1.0", "integer"),
    ("learning_rate = 1e-2", "learning_rate = 0", "training.learning_rate", "0", "greater than 0"),
    (
        'focus = "prediction"',
        'focus = "free"',
        "training.focus",
        '"free"',
        "'prediction' or 'simulation'",
    ),
    (
        "regularization = 0.1",
        "regularization = -0.1",
        "training.regularization",
        "-0.1",
        "greater than or equal to 0",
    ),
    (
        "regularization = 0.1",
        'regularization = "l1"',
        "training.regularization",
        '"l1"',
        "'none', 'evidence' or 'ard'",
    ),
    ("regularization = 0.1", "regularization = inf", "training.regularization", "inf", "finite"),
]


@pytest.mark.parametrize(
    ("old", "new", "key", "found", "expected"), VALUES, ids=[v[1] for v in VALUES]
)
def test_wrong_values(tmp_path, old, new, key, found, expected):
    message = refused(tmp_path, edited(FULL, old, new))
    assert f"'{key}': found {found}; expected" in message
    assert expected in message.partition("; expected")[2]
    assert not re.search("dictionary|instance|constrained|tuple|pydantic", message)


TABLES = [
    ('train = { files = ["run.csv"] }', "train = true", "data.train"),
    ("[[baseline.terms]]", "[baseline.terms]", "baseline.terms"),
]


@pytest.mark.parametrize(("old", "new", "key"), TABLES, ids=[t[1] for t in TABLES])
def test_values_that_should_be_tables(tmp_path, old, new, key):
    message = refused(tmp_path, edited(LEAST, old, new))
    assert f"'{key}': found" in message
    assert re.search("expected a (table|list)", message)
    assert not re.search("dictionary|instance|pydantic", message)


MEANING = [
    (
        "sampling_time = 0.01",
        'sampling_time = 0.01\ntime = "t"',
        r"'data'.*`sampling_time` and `time` are both given",
    ),
    (
        "[data.channels.angle]",
        "[data.channels.angel]",
        "'data'.*`channels.angel` is neither an input nor an output, and `outputs` has "
        "'angle', which `channels` does not have",
    ),
]


@pytest.mark.parametrize(("old", "new", "message"), MEANING, ids=[m[1] for m in MEANING])
def test_values_that_contradict_each_other(tmp_path, old, new, message):
    assert re.search(message, refused(tmp_path, edited(FULL, old, new)))


EXPRESSIONS = [
    ("", "baseline term 'a': An expression is empty"),
    ("y[k-1", "baseline term 'a': 'y.k-1' is not an expression"),
    ("foo(y[k-1])", "baseline term 'a': .*unknown function 'foo'"),
    ("__import__('os').system('true')", "baseline term 'a': .*is not allowed"),
    ("g*y[k-1]", "baseline term 'a': .*unknown constant 'g'"),
]


@pytest.mark.parametrize(("text", "message"), EXPRESSIONS)
def test_expressions_are_read_when_the_physics_is_asked_for(tmp_path, text, message):
    spec = load_spec(put(tmp_path, edited(LEAST, '"y[k-1]"', f'"{text}"')))
    with pytest.raises(InputError, match=message):
        spec.declared_baseline()


def test_deep_nesting_is_one_line(tmp_path):
    for text in (
        "a = " + "[" * 5000,
        "a = " + "[" * 5000 + "]" * 5000,
        "a." * 5000 + "b = 1",
        "[" + "a." * 5000 + "b]",
    ):
        with pytest.raises(InputError) as refused:
            load_spec(put(tmp_path, text))
        assert str(refused.value).isprintable() and len(str(refused.value)) < 400


@pytest.mark.parametrize("number", ["9" * 5000, "-" + "9" * 5000, "1e999"])
def test_numbers_beyond_all_bounds(tmp_path, number):
    for old in (
        "restarts = 3",
        "hidden = [16, 8]",
        "iterations = 50",
        "rows = [0, 9000]",
        "g = 9.81",
    ):
        with pytest.raises(InputError, match="machine.toml"):
            load_spec(
                put(tmp_path, edited(FULL, old, re.sub(r"\d[\d.]*", number, old, count=1)))
            ).declared_baseline()


@pytest.mark.parametrize("name", ["train", "validation"])
def test_a_test_is_called_otherwise_than_another_part(tmp_path, name):
    with pytest.raises(
        InputError, match=f"`tests.{name}` has the name of another part of the data"
    ):
        load_spec(put(tmp_path, edited(FULL, "[data.tests.steps]", f"[data.tests.{name}]")))


@pytest.mark.parametrize("name", ['"a\\nb"', '"\\u001b[31m"', '"' + "x" * 61 + '"'])
def test_names_of_tests_are_visible_and_short(tmp_path, name):
    with pytest.raises(
        InputError, match="the name of a test must be visible characters on one line, at most 60"
    ):
        load_spec(put(tmp_path, edited(FULL, "[data.tests.steps]", f"[data.tests.{name}]")))


def test_long_keys_and_values_are_cut(tmp_path):
    for old, new in (
        ("restarts = 3", "x" * 10_000 + " = 3"),
        ("seed = 7", 'seed = "' + "y" * 10_000 + '"'),
    ):
        with pytest.raises(InputError) as refused:
            load_spec(put(tmp_path, edited(FULL, old, new)))
        assert len(str(refused.value)) < 900


@pytest.mark.parametrize("value", ["[true, 2]", "[0.0, 2.0]", "5", "[[0, 2], [true, 3]]"])
def test_rows_are_whole_numbers(tmp_path, value):
    with pytest.raises(InputError, match="data.tests.steps.rows"):
        load_spec(put(tmp_path, edited(FULL, "rows = [0, 9000]", f"rows = {value}")))


def test_realisations_beside_each_other_in_a_file_are_experiments(tmp_path):
    rows = ["u1,u2,u3,y1,y2", *(f"{k},{10 * k},{100 * k},{k + 0.5},{k + 0.25}" for k in range(30))]
    (tmp_path / "runs.csv").write_text("\n".join(rows))
    spec = put(
        tmp_path,
        """
[data]
sampling_time = 0.1
inputs = ["u", "v"]
outputs = ["y"]
[data.train]
files = ["runs.csv"]
rows = [[0, 10], [10, 30]]
columns = { u = ["u1", "u2"], v = "u3", y = ["y1", "y2"] }
[[baseline.terms]]
parameter = "a"
regressor = "y[k-1]"
""",
    )
    train = load_parts(spec, load_spec(spec))[0]
    record = train.record
    assert [len(e.outputs) for e in record.experiments] == [10, 20, 10, 20]
    first, _, _, last = record.experiments
    assert (first.inputs[3] == [3, 300]).all() and first.outputs[3, 0] == 3.5
    assert (last.inputs[3] == [130, 1300]).all() and last.outputs[3, 0] == 13.25
    assert {e.source for e in record.experiments} == {"runs.csv"}
    assert [(file.file, file.rows) for file in train.files] == [("runs.csv", 60)]
