"""Preparation of data: each step does what it says, within experiments, and the result tells of it."""

from __future__ import annotations

import json

import numpy as np
import pandas as pd
import pytest
from helpers import unfolded
from test_cli import make_project, run

import orthaug as oa
from orthaug import InputError
from orthaug.data.preparation import steps_again, warnings_of
from orthaug.data.prepared import Preparation

pytestmark = pytest.mark.usefixtures("without_figures", "without_trials")

T = 0.01
TIME = T * np.arange(1000)
SLOW, FAST = np.sin(2 * np.pi * 2 * TIME), np.sin(2 * np.pi * 40 * TIME)
MIDDLE = slice(150, 850)


def record(y: np.ndarray, u: np.ndarray | None = None) -> oa.Record:
    return oa.Record.from_arrays(u=SLOW if u is None else u, y=y, sampling_time=T)


def prepared(y: np.ndarray, *steps: object) -> np.ndarray:
    return oa.prepare(record(y), *steps).experiments[0].outputs[:, 0]


def spoilt(*rows: int) -> np.ndarray:
    y = SLOW + 0.01 * np.random.default_rng(0).normal(size=len(SLOW))
    y[list(rows)] += 5.0
    return y


def test_trends_are_taken_out_of_each_experiment():
    both = oa.Record.join([record(3 + 2 * TIME), record(-1 - TIME)])
    for e in oa.prepare(both, oa.Detrend(degree=1)).experiments:
        assert np.abs(e.outputs).max() < 1e-12
    means = [e.outputs.mean() for e in oa.prepare(both, oa.Detrend()).experiments]
    assert np.allclose(means, 0, atol=1e-12)


@pytest.mark.parametrize(
    ("step", "kept", "gone"), [(oa.Lowpass, SLOW, FAST), (oa.Highpass, FAST, SLOW)]
)
def test_filters_of_zero_phase(step, kept, gone):
    done = prepared(SLOW + FAST, step(cutoff=12.0))
    assert np.abs(done - kept)[MIDDLE].max() < 2e-3 and np.abs(done - gone)[MIDDLE].max() > 0.5


def test_a_causal_filter_is_late_and_looks_at_no_future():
    step = oa.Lowpass(cutoff=12.0, phase="causal")
    y = SLOW + FAST
    late = int(np.argmax(np.correlate(prepared(y, step)[MIDDLE], SLOW[MIDDLE], "full"))) - 699
    assert 2 <= late <= 6
    changed = y.copy()
    changed[500:] = 7.0
    assert np.array_equal(prepared(changed, step)[:500], prepared(y, step)[:500])
    assert not np.array_equal(
        prepared(changed, oa.Lowpass(cutoff=12.0))[:500], prepared(y, oa.Lowpass(cutoff=12.0))[:500]
    )


def test_inputs_and_outputs_of_a_linear_plant_keep_their_relation_through_a_filter():
    rng = np.random.default_rng(1)
    u, y = rng.normal(size=1000), np.zeros(1000)
    for k in range(1, 1000):
        y[k] = 0.8 * y[k - 1] + 0.5 * u[k - 1]
    for channels, right in ((None, True), (("y",), False)):
        e = oa.prepare(record(y, u), oa.Lowpass(cutoff=20.0, channels=channels)).experiments[0]
        phi = np.column_stack([e.outputs[:-1, 0], e.inputs[:-1, 0]])[MIDDLE]
        theta = np.linalg.lstsq(phi, e.outputs[1:, 0][MIDDLE], rcond=None)[0]
        assert np.allclose(theta, [0.8, 0.5], atol=1e-3) == right


def test_filters_act_within_experiments():
    rng = np.random.default_rng(2)
    one, other = (
        record(rng.normal(size=200), np.ones(200)),
        record(9 + rng.normal(size=300), np.ones(300)),
    )
    steps = oa.Lowpass(cutoff=10.0), oa.Decimate(factor=4)
    joined = oa.prepare(oa.Record.join([one, other]), *steps)
    alone = [oa.prepare(part, *steps).experiments[0] for part in (one, other)]
    for together, e in zip(joined.experiments, alone, strict=True):
        assert np.array_equal(together.outputs, e.outputs)


def test_decimation_filters_first_and_knows_its_rows():
    done = oa.prepare(record(SLOW + FAST), oa.Decimate(factor=5))
    e = done.experiments[0]
    assert done.sampling_time == pytest.approx(5 * T) and len(e) == 200
    assert np.abs(e.outputs[:, 0] - SLOW[::5])[30:170].max() < 0.01  # 40 Hz would fold onto 0 Hz
    assert e.where(3) == "row 15"


def test_outliers_are_marked_and_short_gaps_reconstructed():
    y = spoilt(100, 400, 401)
    marked = oa.prepare(record(y), oa.Outliers())
    assert [len(e) for e in marked.experiments] == [100, 299, 598] and marked.missing == 3
    assert [e.first_row for e in marked.experiments] == [0, 101, 402]
    assert marked.prepared[0].text.endswith(": 3 samples marked as missing")
    for method in ("linear", "pchip"):
        filled = oa.prepare(record(y), oa.Outliers(), oa.Fill(most=2, method=method))
        assert len(filled) == 1000 and filled.prepared[1].samples == 3
        assert (
            np.abs(filled.experiments[0].outputs[[100, 400, 401], 0] - SLOW[[100, 400, 401]]).max()
            < 0.1
        )
    assert len(oa.prepare(record(y), oa.Outliers(), oa.Fill(most=1)).experiments) == 2
    square = np.where(SLOW >= 0, 1.0, -1.0)
    assert np.array_equal(prepared(square, oa.Outliers()), square)


def test_an_input_is_shifted():
    u = np.arange(1000.0)
    for samples in (3, -3):
        e = oa.prepare(record(u, u), oa.Shift("u", samples)).experiments[0]
        assert len(e) == 997 and np.all(e.outputs[:, 0] - e.inputs[:, 0] == samples)
        assert e.first_row == max(samples, 0)
    for samples, rows, first in ((2.4, 997, 3), (-0.3, 999, 0), (0.3, 999, 1), (-2.4, 997, 0)):
        e = oa.prepare(record(u, u), oa.Shift("u", samples)).experiments[0]
        assert (len(e), e.first_row) == (rows, first)
        assert e.outputs[:, 0] - e.inputs[:, 0] == pytest.approx(samples)
    assert oa.Shift("u", 2.0) == oa.Shift("u", 2) and isinstance(oa.Shift("u", 2.0).samples, int)


def test_uneven_time_stamps_get_an_even_grid(tmp_path):
    rng = np.random.default_rng(3)
    t = np.cumsum(rng.uniform(0.005, 0.015, 1000))
    t[600:] += 1.0
    pd.DataFrame({"t": t, "u": 1.0, "y": np.sin(4 * t)}).to_csv(tmp_path / "a.csv", index=False)
    options = {"inputs": ["u"], "outputs": ["y"], "time": "t"}
    with pytest.raises(InputError, match="Resample"):
        oa.read_record(tmp_path / "a.csv", **options)
    steps = [oa.Resample(sampling_time=0.01, method="pchip"), oa.Lowpass(cutoff=20.0)]
    done = oa.read_record(tmp_path / "a.csv", **options, missing="skip", prepare=steps)
    assert (
        done.sampling_time == 0.01 and len(done.experiments) == 2
    )  # nothing is invented for a second
    for e in done.experiments:
        truth = np.sin(4 * (e.start_time + 0.01 * np.arange(len(e))))
        assert np.abs(e.outputs[:, 0] - truth)[40:-40].max() < 1e-3
    with pytest.raises(InputError, match="needs even sampling; put a step `resample` before it"):
        oa.read_record(tmp_path / "a.csv", **options, prepare=steps[::-1])


def test_an_even_grid_keeps_every_sample_in_spite_of_rounding(tmp_path):
    t = [f"{0.01 * k:.2f}" for k in range(3000)]
    y = np.sin(0.01 * np.arange(3000.0))
    y[1500] = np.nan
    pd.DataFrame({"t": t, "u": np.arange(3000.0), "y": y}).to_csv(tmp_path / "a.csv", index=False)
    options = {"inputs": ["u"], "outputs": ["y"], "time": "t"}
    for method in ("linear", "pchip"):
        steps = [oa.Resample(method=method), oa.Fill()]
        done = oa.read_record(tmp_path / "a.csv", **options, prepare=steps)
        assert len(done) == 3000 and done.missing == 0, method
        assert np.array_equal(done.experiments[0].inputs[:, 0], np.arange(3000.0)), method


def test_empty_cells_are_filled_when_they_are_read(tmp_path):
    frame = pd.DataFrame({"u": SLOW, "y": SLOW})
    frame.loc[[50, 51, 300], "y"] = np.nan
    frame.to_csv(tmp_path / "a.csv", index=False)
    read = {"inputs": ["u"], "outputs": ["y"]}
    done = oa.read_record(tmp_path / "a.csv", **read, prepare=[oa.Fill(most=2)])
    assert len(done.experiments) == 1 and done.prepared[0].samples == 3
    with pytest.raises(InputError, match=r"2 rows lack a sample after preparation\. Let `fill`"):
        oa.read_record(tmp_path / "a.csv", **read, prepare=[oa.Fill(most=1)])
    with pytest.raises(InputError, match="the cell is empty"):
        oa.read_record(tmp_path / "a.csv", **read, prepare=[oa.Detrend()])
    frame = frame.astype(object)
    frame.loc[9, "y"] = "ab"
    frame.to_csv(tmp_path / "b.csv", index=False)
    with pytest.raises(InputError, match="found 'ab'"):
        oa.read_record(tmp_path / "b.csv", **read, prepare=[oa.Fill(most=2)])


REFUSED = [
    (
        lambda: oa.prepare(record(SLOW), oa.Lowpass(cutoff=50.0)),
        "`cutoff`: 50 Hz is not below 50 Hz",
    ),
    (
        lambda: oa.prepare(record(SLOW), oa.Lowpass(cutoff=1.0, channels=("x",))),
        "`channels`: no channel 'x'",
    ),
    (
        lambda: oa.prepare(record(SLOW), oa.Lowpass(cutoff=1.0, channels=3)),
        "`channels` must be a list",
    ),
    (lambda: oa.prepare(record(SLOW), oa.Shift("y", 1)), "'y' is no input; the inputs are u"),
    (
        lambda: oa.prepare(record(SLOW), oa.Shift("u", 1000)),
        "has 1000 rows, too few to be shifted by 1000",
    ),
    (
        lambda: oa.prepare(record(SLOW), oa.Shift("u", float("nan"))),
        "`samples` must be a finite number",
    ),
    (lambda: oa.prepare(record(SLOW), oa.Resample(sampling_time=1e-9)), "take a longer one"),
    (
        lambda: oa.prepare(record(SLOW).rows(0, 9), oa.Lowpass(cutoff=1.0)),
        "has 9 rows, but a filter of zero phase",
    ),
    (
        lambda: oa.prepare(record(SLOW), "lowpass"),
        "preparation takes a list of steps with their arguments: Detrend",
    ),
    (lambda: oa.prepare(SLOW, oa.Detrend()), "`record` must be a Record"),
    (lambda: oa.Lowpass(cutoff=0.0), "cutoff"),
    (lambda: oa.Lowpass(cutoff=1.0, order=11), "`order` must be at most 10"),
    (lambda: oa.Lowpass(cutoff=1.0, phase="linear"), "`phase`"),
    (lambda: oa.Detrend(degree=2), "`degree` must be 0"),
    (lambda: oa.Decimate(factor=1), "factor"),
    (
        lambda: oa.Record.join([record(SLOW), oa.prepare(record(SLOW), oa.Detrend())]),
        "prepare all alike",
    ),
]


@pytest.mark.parametrize(("call", "message"), REFUSED, ids=range(len(REFUSED)))
def test_what_cannot_be_done_is_said(call, message):
    with pytest.raises(InputError, match=message):
        call()


def test_what_a_filter_does_to_theta_is_reported():
    def codes(*steps):
        return [w.code for w in warnings_of(oa.prepare(record(SLOW), *steps).prepared, ["u", "y"])]

    assert codes(oa.Detrend(), oa.Outliers()) == []
    assert codes(oa.Lowpass(cutoff=9.0)) == ["filtered_noise"] == codes(oa.Decimate(factor=2))
    assert codes(oa.Lowpass(cutoff=9.0, channels=("y",))) == ["filtered_alone", "filtered_noise"]


@pytest.mark.parametrize("focus", ["prediction", "simulation"])
def test_the_free_run_is_advised_only_where_it_was_not_trained_on(tmp_path, focus):
    text = make_project(tmp_path).read_text(encoding="utf-8")
    step = '[[data.prepare]]\nstep = "decimate"\nfactor = 2\n'
    spec = tmp_path / "other.toml"
    spec.write_text(f'{text}{step}[training]\nfocus = "{focus}"\n', encoding="utf-8")
    for command in (["check", spec, "--json"], ["fit", spec, "--json", "--out", tmp_path / "out"]):
        done = run(*command)
        assert done.code == 0, done.err
        (warnings,) = (
            w["text"] for w in json.loads(done.out)["warnings"] if "filtered" in w["code"]
        )
        assert (
            ("training.focus" in warnings)
            == ("one step ahead" in warnings)
            == (focus == "prediction")
        )
        assert "Compare with a fit to the data as they are" in warnings


def test_a_spec_prepares_every_part_and_the_result_says(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    spec = make_project(tmp_path)
    text, steps = (
        spec.read_text(),
        '[[data.prepare]]\nstep = "detrend"\n[[data.prepare]]\nstep = "lowpass"\ncutoff = 0.4\n',
    )
    spec.write_text(f"{text}{steps}")
    done = run("fit", spec, "--out", "result")
    assert done.code == 0, done.err
    result = json.loads((tmp_path / "result" / "result.json").read_text())
    assert [one["step"] for one in result["data"]["prepare"]] == ["detrend", "lowpass"]
    assert result["data"]["prepare"][1]["options"]["cutoff"] == 0.4
    assert [w["code"] for w in result["warnings"]].count("filtered_noise") == 1
    output = run("simulate", "result", "run.csv", "--out", "free.csv")
    assert (
        output.code == 0
        and "fitted to prepared data: detrend (degree 0), lowpass (cutoff 0.4" in output.err
    )
    output = run("export", "result", "--to", "numpy", "--out", "code")
    assert (
        output.code == 0
        and "The code expects data after these steps" in output.err
        and "detrend" in output.err
    )
    for wrong, message in (
        ('step = "lowpas"\n', "'lowpass'"),
        ('step = "lowpass"\n', "cutoff"),
        ('step = "lowpass"\ncutoff = 5.0\n', "is not below"),
        ('step = "detrend"\nslope = 1\n', "unknown key 'data.prepare[0].slope'"),
    ):
        spec.write_text(f"{text}[[data.prepare]]\n{wrong}")
        done = run("check", spec)
        assert done.code == 2 and message in done.err, done.err


STEPS = (
    ('step = "detrend"\n', oa.Detrend()),
    ('step = "outliers"\nchannels = ["y"]\n', oa.Outliers(channels=("y",))),
    ('step = "fill"\nmost = 4\n', oa.Fill(most=4)),
    ('step = "decimate"\nfactor = 2\n', oa.Decimate(factor=2)),
    ('step = "shift"\nchannel = "u"\nsamples = 1\n', oa.Shift("u", 1)),
)


@pytest.fixture(scope="module")
def decimated(tmp_path_factory):
    """A result of data that went through many steps, with files as they were measured beside it."""
    folder = tmp_path_factory.mktemp("decimated")
    spec = make_project(folder)
    sections = "".join(f"[[data.prepare]]\n{text}" for text, _ in STEPS)
    spec.write_text(f"{spec.read_text()}{sections}")
    rows = pd.read_csv(folder / "run.csv")
    rows.loc[[60, 61, 90], "y"] = [np.nan, np.nan, 50.0]
    rows.to_csv(folder / "run.csv", index=False)
    rows.drop(columns="y").to_csv(folder / "inputs.csv", index=False)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        done = run("fit", spec, "--out", "result")
        assert done.code == 0, done.err
    return folder


def test_a_saved_model_knows_how_its_data_were_prepared(decimated, monkeypatch):
    monkeypatch.chdir(decimated)
    model = oa.load("result")
    assert model.preparation == tuple(step for _, step in STEPS) and model.prepared[1].samples == 1
    oa.save(model, "again", force=True)
    assert oa.load("again").prepared == model.prepared
    raw = {"inputs": ["u"], "outputs": ["y"], "sampling_time": model.sampling_time / 2}
    record = oa.read_record("run.csv", **raw, prepare=model.preparation)
    done = run("simulate", "again", "run.csv", "--prepare", "--out", "free.csv", "--force")
    assert done.code == 0 and "The same was done to these data, here with outliers" in unfolded(
        done.err
    ), done.err
    free = pd.read_csv("free.csv")
    (expected,) = model.simulate(record).trajectories
    np.testing.assert_allclose(free["y_model"], expected.model[:, 0], rtol=1e-12)
    np.testing.assert_allclose(np.diff(free["time"]), model.sampling_time)
    done = run(
        "predict",
        "result",
        "run.csv",
        "--horizon",
        "3",
        "--prepare",
        "--out",
        "ahead.csv",
        "--force",
    )
    assert done.code == 0 and len(pd.read_csv("ahead.csv")) == len(free)


def test_a_file_of_other_instants_needs_a_word(decimated, monkeypatch):
    """Rows of 1 s taken as rows of 2 s would run at half the speed, and nothing would tell."""
    monkeypatch.chdir(decimated)
    done = run("simulate", "result", "run.csv")
    assert (
        done.code == 2
        and "give --prepare for a file as it was measured, or --no-prepare" in done.err
    ), done.err
    done = run("simulate", "result", "inputs.csv", "--no-prepare", "--out", "plain.csv")
    assert done.code == 0 and "are taken as they are; --prepare does" in unfolded(done.err), (
        done.err
    )
    assert len(pd.read_csv("plain.csv")) == len(pd.read_csv("inputs.csv"))


def test_a_shift_is_a_part_of_the_model_and_done_without_a_word(tmp_path, monkeypatch):
    """Rows in which the input acts two samples later than in training would run wrongly."""
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    u, y = rng.normal(size=200), np.zeros(200)
    for k in range(3, 200):
        y[k] = 0.8 * y[k - 1] + u[k - 3]
    record = oa.Record.from_arrays(u=u, y=y, sampling_time=1.0)
    pd.DataFrame({"u": u, "y": y}).to_csv("run.csv", index=False)
    physics = oa.Baseline.from_terms([oa.Term("a", "y[k-1]"), oa.Term("b", "u[k-1]")])
    moved = oa.prepare(record, oa.Shift("u", 2))
    oa.save(oa.estimate(moved, physics, learner=None).model, "late")
    done = run("simulate", "late", "run.csv", "--out", "a.csv")
    assert "The same was done to these data; --no-prepare" in unfolded(done.err)
    free = pd.read_csv("a.csv")
    np.testing.assert_allclose(free["y_model"][1:], free["y"][1:], atol=1e-9)
    raw = run("simulate", "late", "run.csv", "--no-prepare", "--out", "b.csv")
    assert "taken as they are" in unfolded(raw.err)
    assert len(pd.read_csv("b.csv")) == 200 and len(free) == 198


def test_code_says_what_its_signals_stand_for(decimated, monkeypatch):
    monkeypatch.chdir(decimated)
    assert run("export", "result", "--to", "c", "--out", "code").code == 0
    for file in ("README.md", "model.h"):
        text = (decimated / "code" / file).read_text(encoding="utf-8")
        assert (
            "detrend (degree 0), decimate (factor 2, phase zero), shift (channel u, samples 1)"
            in text
        )
        assert "outliers" not in text


def test_outputs_that_a_file_lacks_are_not_prepared(decimated, monkeypatch):
    monkeypatch.chdir(decimated)
    done = run("simulate", "result", "inputs.csv", "--prepare", "--out", "driven.csv", "--force")
    assert done.code == 0, done.err
    record = oa.read_record(
        "run.csv",
        inputs=["u"],
        sampling_time=oa.load("result").sampling_time / 2,
        prepare=[STEPS[0][1], STEPS[3][1], STEPS[4][1]],
    )
    (expected,) = oa.load("result").simulate(record, initial="zero").trajectories
    np.testing.assert_allclose(
        pd.read_csv("driven.csv")["y_model"], expected.model[:, 0], rtol=1e-12
    )


def test_training_files_are_prepared_again_for_a_split_and_for_tracking(decimated, monkeypatch):
    """Under the measure of the training data a split of an orthogonal fit changes nothing."""
    monkeypatch.chdir(decimated)
    fitted = json.loads((decimated / "result" / "result.json").read_text())["parameters"]
    done = run("split", "result", "run.csv", "--json")
    assert done.code == 0, done.err
    found = json.loads(done.out)["parameters"]
    np.testing.assert_allclose([p["value"] for p in found], [p["value"] for p in fitted], rtol=1e-9)
    done = run("track", "result", "--data", "run.csv", "--training", "run.csv", "--out", "tracked")
    assert done.code == 0, done.err
    assert "the model was fitted to prepared data" in done.err
    spec = (decimated / "plant.toml").read_text(encoding="utf-8")
    without_input = spec.replace('[[baseline.terms]]\nparameter = "c"\nregressor = "u[k-1]"\n', "")
    (decimated / "learned.toml").write_text(
        without_input.replace('kind = "none"', 'kind = "terms"\nterms = ["u[k-1]"]'),
        encoding="utf-8",
    )
    done = run("fit", "learned.toml", "--out", "learned")
    assert done.code == 0, done.err
    done = run("explain", "learned", "run.csv")
    assert "prepared data: detrend" in done.err and "1 sample marked as missing" in unfolded(
        done.err
    ), done.err
    done = run("linearize", "result")
    assert done.code == 0 and "Operating points are those of data after these steps" in unfolded(
        done.err
    ), done.err


def test_instants_are_resampled_as_those_of_the_training_data():
    resampled = Preparation("resample", {"method": "linear"})
    steps, step = steps_again(
        [resampled, Preparation("decimate", {"factor": 5, "phase": "zero"})], ["u"], 0.1
    )
    assert steps == (oa.Resample(sampling_time=0.02), oa.Decimate(factor=5)) and step == 0.02


def test_rows_that_stay_in_their_files_are_not_prepared(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    spec = make_project(tmp_path)
    for name in ("run", "steps"):
        pd.read_csv(f"{name}.csv").to_parquet(f"{name}.parquet")
    text = spec.read_text().replace(".csv", ".parquet")
    spec.write_text(f'{text}[engine]\nkind = "stream"\n[[data.prepare]]\nstep = "detrend"\n')
    done = run("check", spec)
    assert done.code == 2 and "'data.prepare' needs the rows in memory" in done.err
