"""Saved models: what is read computes bit by bit what was written; what was cut or altered is refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from orthaug import (
    MLP,
    Baseline,
    Channel,
    Function,
    InputError,
    Lags,
    LevenbergMarquardt,
    Model,
    Record,
    Term,
    __version__,
    estimate,
    load,
    save,
)
from orthaug.models import storage

SOLVER = LevenbergMarquardt(3)
FILES = ["arrays.safetensors", "model.json"]  # beside the manifest
FIRST = Path(__file__).parent / "fixtures" / "model_format1"


def make_record() -> Record:
    """Two inputs and two outputs of a damped system with a little friction; 80 samples."""
    rng = np.random.default_rng(3)
    u = rng.normal(size=(80, 2))
    y = np.zeros((80, 2))
    for k in range(2, 80):
        y[k, 0] = 0.5 * y[k - 1, 0] - 0.2 * y[k - 2, 0] + u[k - 1, 0] - 0.1 * np.tanh(y[k - 1, 0])
        y[k, 1] = 0.3 * y[k - 1, 1] + 0.2 * y[k - 1, 0] + 0.5 * u[k, 1]
    y += 0.01 * rng.normal(size=y.shape)
    inputs = [Channel("force", "N", column="F (N)", scale=0.001, offset=-2.0), Channel("volt", "V")]
    return Record.from_arrays(
        u, y, sampling_time=0.01, inputs=inputs, outputs=[Channel("pos", "m"), "angle"]
    )


RECORD = make_record()
ONE = Record(
    RECORD.inputs,
    RECORD.outputs[:1],
    0.01,
    tuple(
        Record.from_arrays(e.inputs, e.outputs[:, :1]).experiments[0] for e in RECORD.experiments
    ),
)
TERMS = Baseline.from_terms(
    [Term("a", "pos[k-1]", 0.4, "1"), Term("b", "g*force[k-1]", 1.0, "m/N")], {"g": 0.5}
)


def phi(x):
    return x[None, :2]


def wave(weights, z):
    return weights * np.pi * z[:1] ** 2


def start(key):
    return 0.1 * np.ones(1)


CALLED = Baseline.from_function(phi, ["a", "b"])
WAVE = Function(wave, start)


def fit_mlp() -> Model:
    learner = MLP((3,), "gelu", ("pos[k-1]", "sin(force[k-1])*volt[k]"))
    return estimate(ONE, TERMS, learner=learner, solver=SOLVER, regularization="ard").model


def fit_physics_alone() -> Model:
    return estimate(ONE, TERMS, learner=None).model


def fit_several_outputs() -> Model:
    terms = [
        Term("a", "pos[k-1]", 0.4, output="pos"),
        Term("known", "-0.2*pos[k-2]", 1.0, output="pos", fixed=True),
        Term("b", "volt[k]", output="angle"),
        Term("a", "angle[k-1]", 0.4, output="angle"),
    ]
    return estimate(RECORD, Baseline.from_terms(terms), learner=MLP((2,)), solver=SOLVER).model


def fit_callables() -> Model:
    return estimate(ONE, CALLED, lags=Lags(na=1, nb=1, nk=1), learner=WAVE, solver=SOLVER).model


@pytest.fixture(scope="module")
def models() -> dict[str, Model]:
    return {
        "mlp": fit_mlp(),
        "physics": fit_physics_alone(),
        "several": fit_several_outputs(),
        "callables": fit_callables(),
    }


@pytest.fixture
def saved(models, tmp_path) -> Path:
    save(models["mlp"], tmp_path / "model")
    return tmp_path / "model"


def same(a: Model, b: Model, record: Record) -> None:
    """Bitwise equal in every number and everything that is computed from them."""
    for x, y in zip(a.numbers, b.numbers, strict=True):
        np.testing.assert_array_equal(np.asarray(x), np.asarray(y))
    for response in ("predict", "simulate"):
        first, second = (getattr(model, response)(record).trajectories[0] for model in (a, b))
        for part in ("baseline", "learner", "learner_before", "model"):
            np.testing.assert_array_equal(getattr(first, part), getattr(second, part))
    np.testing.assert_array_equal(
        a.predict(record, horizon=4).model, b.predict(record, horizon=4).model
    )


@pytest.mark.parametrize(("name", "record"), [("mlp", ONE), ("physics", ONE), ("several", RECORD)])
def test_what_is_read_is_what_was_written(models, tmp_path, name, record):
    model = models[name]
    save(model, tmp_path / "model")
    assert sorted(p.name for p in (tmp_path / "model").iterdir()) == [
        *FILES[:1],
        "manifest.json",
        FILES[1],
    ]
    again = load(tmp_path / "model")
    same(model, again, record)
    assert again.form == model.form
    assert (again.inputs, again.outputs) == (model.inputs, model.outputs)
    assert (again.sampling_time, again.structure) == (model.sampling_time, model.structure)
    np.testing.assert_array_equal(again.largest_output, model.largest_output)
    for kept in ("gram", "noise", "ridge"):
        np.testing.assert_array_equal(
            getattr(again.statistics, kept), getattr(model.statistics, kept)
        )


def test_channels_terms_and_constants_are_kept(models, saved):
    model = load(saved)
    assert model.inputs[0] == Channel("force", "N", "F (N)", 0.001, -2.0)
    assert model.outputs[0].label == "pos [m]"
    assert model.form.baseline == TERMS
    assert model.form.baseline.parameters[1].unit == "m/N"
    assert str(model.form.features.entries[1]) == "sin(force[k-1])*volt[k]"
    assert repr(model) == repr(models["mlp"])


def test_the_folder_of_a_result_is_read_too(models, tmp_path):
    save(models["physics"], tmp_path / "out" / "model")
    same(load(tmp_path / "out"), load(str(tmp_path / "out" / "model")), ONE)


def test_fixed_terms_are_kept(models, tmp_path):
    save(models["several"], tmp_path / "model")
    assert [t.fixed for t in load(tmp_path / "model").form.baseline.terms] == [
        False,
        True,
        False,
        False,
    ]


def test_python_callables_are_asked_for_again(models, tmp_path):
    save(models["callables"], tmp_path / "model")
    with pytest.raises(
        InputError,
        match=r"model.json: the baseline was a Python function; give it again, load\(…, baseline=…\)",
    ):
        load(tmp_path / "model")
    with pytest.raises(
        InputError,
        match=r"model.json: the learner was a Python callable; give it again, load\(…, learner=…\)",
    ):
        load(tmp_path / "model", baseline=CALLED)
    same(load(tmp_path / "model", baseline=CALLED, learner=WAVE), models["callables"], ONE)


def test_callables_that_do_not_fit_the_numbers_are_refused(models, tmp_path):
    save(models["callables"], tmp_path / "model")
    with pytest.raises(InputError, match="model.json: .*weights"):
        load(tmp_path / "model", baseline=CALLED, learner=MLP((3,)))


def test_nothing_that_is_saved_can_be_executed(saved):
    assert b"pickle" not in (saved / "model.json").read_bytes()
    declared = json.loads((saved / "model.json").read_text())
    assert (declared["format"], declared["orthaug"]) == (storage.FORMAT, __version__)


def change(path: Path, edit) -> None:
    """Rewrite the JSON with its own checksum left as it was."""
    content = json.loads(path.read_text())
    edit(content)
    path.write_text(json.dumps(content))


def test_reformatted_json_is_the_same_model(models, saved):
    change(saved / "model.json", lambda content: None)
    same(load(saved), models["mlp"], ONE)


ALTERED = [
    (
        lambda c: c.update(structure="additive"),
        "model.json: the file was altered .its checksum differs",
    ),
    (lambda c: c["baseline"]["terms"][0].update(regressor="pos[k-2]"), "the file was altered"),
    (lambda c: c.update(more=1), "the file was altered"),
    (lambda c: c.pop("checksum"), "the file was altered"),
    (lambda c: c.pop("learner"), "the file was altered"),
    (lambda c: c.pop("format"), "model.json: not a model of orthaug"),
    (lambda c: c.update(format="1"), "model.json: not a model of orthaug"),
    (
        lambda c: c.update(format=storage.FORMAT + 1, orthaug="9.9.9"),
        rf"written by orthaug 9.9.9 in format {storage.FORMAT + 1}; this version .* reads up to {storage.FORMAT}",
    ),
]


@pytest.mark.parametrize(("edit", "message"), ALTERED, ids=range(len(ALTERED)))
def test_altered_declarations(saved, edit, message):
    change(saved / "model.json", edit)
    with pytest.raises(InputError, match=message) as refusal:
        load(saved)
    assert str(saved) in str(refusal.value)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("content", [b"", b"{", b"\xff\xfe\x00", b"not JSON"])
def test_a_declaration_that_is_no_json(saved, content):
    (saved / "model.json").write_bytes(content)
    with pytest.raises(
        InputError,
        match=r"model.json: the file is cut or altered \(no JSON\); fit again, or copy it again",
    ):
        load(saved)


@pytest.mark.parametrize("content", ["[]", "1", "null", "{}"])
def test_json_that_is_no_model(saved, content):
    (saved / "model.json").write_text(content)
    with pytest.raises(InputError, match="model.json: not a model of orthaug"):
        load(saved)


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("share", [0.0, 0.5, 0.99])
def test_a_file_that_was_cut(saved, name, share):
    content = (saved / name).read_bytes()
    (saved / name).write_bytes(content[: int(share * len(content))])
    with pytest.raises(InputError, match=f"{name}: the file is cut or altered"):
        load(saved)


def test_one_flipped_bit_in_the_arrays(saved):
    content = bytearray((saved / "arrays.safetensors").read_bytes())
    content[-3] ^= 1
    (saved / "arrays.safetensors").write_bytes(content)
    with pytest.raises(
        InputError, match="arrays.safetensors: the file is cut or altered .its checksum differs"
    ):
        load(saved)


@pytest.mark.parametrize("name", FILES)
def test_a_missing_file(saved, name):
    (saved / name).unlink()
    with pytest.raises(
        InputError, match="no saved model there; expected model.json and arrays.safetensors"
    ):
        load(saved)


def test_no_model_at_all(tmp_path):
    (tmp_path / "file").write_text("x")
    for path in (tmp_path, tmp_path / "absent", tmp_path / "file"):
        with pytest.raises(InputError, match=f"{path}: no saved model there"):
            load(path)


def test_saving_twice_replaces(models, saved):
    save(models["physics"], saved)
    same(load(saved), models["physics"], ONE)
    assert sorted(p.name for p in saved.parent.iterdir()) == ["model"]


def forge(folder: Path, arrays: dict | None = None, **declared) -> None:
    """Change a saved model and make its checksums right again."""
    from orthaug.models.storage import FORMAT, pack, read_packed, write_packed

    place, numbers = folder / "model.json", folder / "arrays.safetensors"
    said, held = read_packed(place, numbers, FORMAT, "model", "")
    said = {k: v for k, v in said.items() if k not in ("format", "orthaug", "arrays_sha256")}
    write_packed(pack(FORMAT, said | declared, held | (arrays or {})), place, numbers)


FORGED = [
    ({}, {"numbers.weights": np.full(16, np.inf)}, "weights"),
    ({}, {"numbers.theta": np.array([np.nan, 0.0])}, "theta"),
    ({}, {"numbers.theta": np.zeros(1)}, "theta has the shape"),
    ({}, {"numbers.gain": np.zeros(3)}, "gain has the shape"),
    ({}, {"numbers.halfwidth": np.array([-1.0, 1.0])}, "halfwidth"),
    ({}, {"output_weight": np.zeros((2, 2))}, "output_weight has the shape"),
    ({"sampling_time": -1}, {}, "sampling time"),
    ({"structure": [[1]]}, {}, "structure"),
    ({"layout": {}}, {}, "not a model"),
    ({"layout": [["pos", 10**30], ["force", 1]]}, {}, "a lag of"),
    ({"features": {}}, {}, "."),
    ({"features": [{"text": 1e308, "constants": {}}, {"text": "x", "constants": {}}]}, {}, "."),
    (
        {"features": [{"text": "x", "constants": {}}, {"text": "pos[k-1]", "constants": {}}]},
        {},
        ".",
    ),
]


@pytest.mark.parametrize(("declared", "arrays", "words"), FORGED, ids=range(len(FORGED)))
def test_a_forged_model_is_refused_where_it_is_read(saved, declared, arrays, words):
    """Its checksums hold, so only its parts tell that they do not fit; every command reads it by `load`."""
    forge(saved)
    load(saved)
    forge(saved, arrays, **declared)
    with pytest.raises(InputError, match=words):
        load(saved)


def test_a_folder_of_something_else_is_refused_and_kept(models, tmp_path):
    (tmp_path / "model").mkdir()
    (tmp_path / "model" / "notes.txt").write_text("mine")
    with pytest.raises(
        InputError,
        match="model: holds notes.txt and no manifest.json which shows that orthaug wrote it",
    ):
        save(models["physics"], tmp_path / "model")
    assert [p.name for p in (tmp_path / "model").iterdir()] == ["notes.txt"]
    with pytest.raises(InputError, match="notes.txt: not a folder"):
        save(models["physics"], tmp_path / "model" / "notes.txt")


@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError(28, "No space left on device")])
def test_an_interrupted_write_leaves_nothing(models, tmp_path, monkeypatch, error):
    def fail(*_, **__):
        raise error

    monkeypatch.setattr(Path, "write_text", fail)
    with pytest.raises((KeyboardInterrupt, OSError, InputError)):
        save(models["physics"], tmp_path / "deep" / "model")
    assert list(tmp_path.iterdir()) == []


def test_an_interrupted_write_keeps_the_model_that_was_there(models, saved, monkeypatch):
    def fail(*_, **__):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_text", fail)
        with pytest.raises(KeyboardInterrupt):
            save(models["physics"], saved)
    same(load(saved), models["mlp"], ONE)


def test_a_model_of_the_first_format_loads(tmp_path):
    """Written by the code before learners were saved by registered kinds; the values are those it computed."""
    model = load(FIRST)
    assert model.learns
    assert model.form.bound.learner == MLP((2,), "gelu", ("u[k-1]", "y[k-1]"))
    np.testing.assert_allclose(model.theta, [0.5374559346621786, 1.003487701524252], rtol=1e-15)
    record = Record.from_arrays(u=np.array([0.3, -0.7, 1.1]), y=np.array([0.2, 0.5, -0.4]))
    found = model.predict(record).trajectories[0].model[1:, 0]
    np.testing.assert_allclose(found, [0.40008235013798166, -0.401744532272874], rtol=1e-13)
    save(model, tmp_path / "again")
    kept = [
        json.loads((folder / "model.json").read_text())["learner"]
        for folder in (tmp_path / "again", FIRST)
    ]
    since = {"beyond": "auto", "states": 0, "time_constants": None}  # fields of later versions
    assert kept[0] == kept[1] | since


def test_files_that_cannot_be_read(tmp_path, monkeypatch):
    save(estimate(ONE, TERMS, learner=None).model, tmp_path / "model")
    for wrong in (5, None, b"x", "no\0name", tmp_path / "model" / "model.json"):
        with pytest.raises(InputError):
            load(wrong)

    def denied(path, **options):
        raise PermissionError(13, "Permission denied")

    for reads in ("read_text", "read_bytes"):
        with monkeypatch.context() as patched:
            patched.setattr(Path, reads, denied)
            with pytest.raises(InputError, match=r"model: cannot be read \(Permission denied\)"):
                load(tmp_path / "model")


NO_DECLARATIONS = [
    "[" * 100_000,
    '{"format": 2, "a": ' + "9" * 5000 + "}",
    "[]",
    "null",
    '"x"',
    "\ud800",
]


@pytest.mark.parametrize("text", NO_DECLARATIONS, ids=range(len(NO_DECLARATIONS)))
def test_declarations_that_are_none(tmp_path, text):
    save(estimate(ONE, TERMS, learner=None).model, tmp_path / "model")
    (tmp_path / "model" / "model.json").write_bytes(text.encode("utf-8", "surrogatepass"))
    with pytest.raises(
        InputError, match="model.json: (the file is cut or altered|not a model of orthaug)"
    ):
        load(tmp_path / "model")
