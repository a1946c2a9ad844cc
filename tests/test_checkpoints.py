"""Training that is ended at any step and taken up again ends at the same bits."""

from __future__ import annotations

import errno
import hashlib
import os
from functools import partial

import numpy as np
import pytest
from safetensors.numpy import load, save
from test_cli import run
from test_engine import Streaming, posed
from test_engines import BASELINE, FLIGHT, SPEC, fitted, folder, from_files  # noqa: F401  (a fixture)

import orthaug as oa
from orthaug import MLP, BaselinePenalty, LevenbergMarquardt, Orthogonal, Stream
from orthaug._base.folders import PARTIALS
from orthaug._base.progress import Progress
from orthaug.commands.fit import fit_job, keep_states, write_result
from orthaug.fitting.checkpoints import Checkpoints
from orthaug.fitting.estimation import fit
from orthaug.models.rows import InMemory
from orthaug.physics.problem import pose


class Killed(BaseException):
    """Nothing is tidied up after it, as after a signal that ends the process."""


def dies_at(step):
    def tell(run, iteration, loss):
        if iteration >= step:
            raise Killed

    return tell


def options(engine, structure=None, regularization="evidence"):
    return {
        "learner": MLP(hidden=(3,)),
        "solver": LevenbergMarquardt(25, tolerance=1e-13),
        "structure": structure or Orthogonal(),
        "regularization": regularization,
        "engine": engine,
    }


@pytest.mark.parametrize("step", [1, 7, 24])
@pytest.mark.parametrize("engine", [Streaming(), InMemory()], ids=["stream", "memory"])
def test_a_run_that_was_ended_goes_on_bit_by_bit(tmp_path, engine, step):
    chosen = options(engine)
    whole = fit(posed(1), **chosen)
    kept = Checkpoints(tmp_path / "kept", "this fit", every=0.0)
    with pytest.raises(Killed):
        fit(posed(1), **chosen, checkpoints=kept.opened(resume=False), progress=dies_at(step))
    steps = []
    again = Checkpoints(tmp_path / "kept", "this fit", every=0.0).opened(resume=True)
    found = fit(
        posed(1), **chosen, checkpoints=again, progress=lambda run, i, loss: steps.append(i)
    )
    np.testing.assert_array_equal(found.model.numbers.weights, whole.model.numbers.weights)
    np.testing.assert_array_equal(found.theta, whole.theta)
    assert (
        found.status.loss == whole.status.loss
        and found.status.iterations == whole.status.iterations
    )
    assert steps[0] > 1 or step == 1


@pytest.mark.parametrize("step", [7, 11, 14])
@pytest.mark.parametrize("engine", [Streaming(), InMemory()], ids=["stream", "memory"])
def test_a_run_that_was_ended_past_its_limit_goes_on_bit_by_bit(tmp_path, engine, step):
    chosen = options(engine) | {"solver": LevenbergMarquardt(8, tolerance=1e-13, longest=20)}
    whole = fit(posed(1), **chosen)
    assert whole.status.iterations > 8 and "past its limit of 8 iterations" in whole.status.message
    kept = Checkpoints(tmp_path / "kept", "this fit", every=0.0)
    with pytest.raises(Killed):
        fit(posed(1), **chosen, checkpoints=kept.opened(resume=False), progress=dies_at(step))
    again = Checkpoints(tmp_path / "kept", "this fit", every=0.0).opened(resume=True)
    found = fit(posed(1), **chosen, checkpoints=again)
    np.testing.assert_array_equal(found.model.numbers.weights, whole.model.numbers.weights)
    assert (
        found.status.iterations == whole.status.iterations
        and found.status.message == whole.status.message
    )


@pytest.mark.parametrize("engine", [Stream(), InMemory()], ids=["stream", "memory"])
def test_a_free_run_goes_on_bit_by_bit(folder, tmp_path, engine):  # noqa: F811
    """Killed once in the run of physics alone, once in that of the learner."""
    problem = pose(from_files(folder), BASELINE, oa.Lags(na=2, nb=2))
    chosen = {
        "learner": MLP(hidden=(3,)),
        "criterion": oa.Simulation(40, 20, start_iterations=0),
        "engine": engine,
    }
    chosen |= FLIGHT | {"solver": oa.LevenbergMarquardt(20)}
    del chosen["standard_errors"]  # of `estimate`: a fit of a problem keeps its own
    whole = fit(problem, **chosen)
    for step in (2, 17):
        kept = Checkpoints(tmp_path / "kept", "this fit", every=0.0).opened(resume=step > 2)
        with pytest.raises(Killed):
            fit(problem, **chosen, checkpoints=kept, progress=dies_at(step))
    steps = []
    kept = Checkpoints(tmp_path / "kept", "this fit", every=0.0).opened(resume=True)
    found = fit(problem, **chosen, checkpoints=kept, progress=lambda run, i, loss: steps.append(i))
    np.testing.assert_array_equal(found.theta, whole.theta)
    np.testing.assert_array_equal(found.model.numbers.weights, whole.model.numbers.weights)
    assert found.status.loss == whole.status.loss and steps[0] == 17


def test_runs_that_were_done_are_not_made_again(tmp_path):
    """Several starts and a bound that is met: each run, and each set of active bounds, has its own state."""
    chosen = options(Streaming(), BaselinePenalty(1.0), "auto") | {"restarts": 2}
    kept = Checkpoints(tmp_path / "kept", "this fit", every=0.0)
    whole = fit(posed(1, 0.9), **chosen, checkpoints=kept.opened(resume=False))
    engine = Streaming()
    again = Checkpoints(tmp_path / "kept", "this fit", every=0.0).opened(resume=True)
    found = fit(posed(1, 0.9), **(chosen | {"engine": engine}), checkpoints=again)
    np.testing.assert_array_equal(found.theta, whole.theta)
    assert len(engine.asked) < len(chosen["engine"].asked) / 4


def test_a_full_disk_leaves_the_last_good_state(tmp_path, monkeypatch):
    kept = Checkpoints(tmp_path / "kept", "this fit", every=0.0).opened(resume=False)
    whole = fit(posed(1), **options(Streaming()))

    def full(descriptor):
        raise OSError(errno.ENOSPC, "No space left on device")

    def tell(run, iteration, loss):
        if iteration == 5:
            monkeypatch.setattr(os, "fsync", full)
        if iteration == 9:
            raise Killed

    with pytest.raises(Killed):
        fit(posed(1), **options(Streaming()), checkpoints=kept, progress=tell)
    assert "No space left on device" in kept.lost
    monkeypatch.undo()
    assert not list((tmp_path / "kept").glob("*.partial"))
    steps = []
    again = Checkpoints(tmp_path / "kept", "this fit", every=0.0).opened(resume=True)
    found = fit(
        posed(1),
        **options(Streaming()),
        checkpoints=again,
        progress=lambda run, i, loss: steps.append(i),
    )
    assert steps[0] == 5  # the state after the fourth step stood
    np.testing.assert_array_equal(found.theta, whole.theta)


def test_a_spoilt_state_is_none(tmp_path):
    kept = Checkpoints(tmp_path / "kept", "this fit", every=0.0).opened(resume=False)
    with pytest.raises(Killed):
        fit(posed(1), **options(Streaming()), checkpoints=kept, progress=dies_at(5))
    (file,) = (tmp_path / "kept").glob("*.safetensors")
    whole, expected = file.read_bytes(), fit(posed(1), **options(Streaming())).theta
    flipped = bytearray(whole)
    flipped[-5] ^= 64
    for content in (whole[:100], bytes(flipped), whole[:-8] + np.array(np.nan).tobytes(), b""):
        file.write_bytes(content)
        kept.spoilt.clear()
        found = fit(posed(1), **options(Streaming()), checkpoints=kept)
        np.testing.assert_array_equal(found.theta, expected)
        assert kept.spoilt[:1] == [file.name], "and it is said"


def forged(content, change):
    """A state with changed arrays and the checksum that they ask for."""
    head = content.index(b"\n") + 1
    arrays = {name: np.array(values) for name, values in load(content[head:]).items()}
    change(arrays)
    body = save(arrays)
    return content[:16] + hashlib.sha256(body).hexdigest().encode() + b"\n" + body


def no_number(arrays, value=np.nan):
    arrays["0"].flat[0] = value


def other_shape(arrays):
    arrays["0"] = np.append(arrays["0"], 1.0)


def fewer(arrays):
    del arrays[str(len(arrays) - 1)]


@pytest.mark.parametrize("driven", [False, True], ids=["compiled", "driven"])
def test_a_forged_state_with_its_checksum_is_none(tmp_path, driven):
    chosen = options(InMemory()) | (
        {"criterion": oa.Simulation(segment=20, washout=2)} if driven else {}
    )
    kept = Checkpoints(tmp_path / "kept", "this fit", every=0.0).opened(resume=False)
    with pytest.raises(Killed):
        fit(posed(1), **chosen, checkpoints=kept, progress=dies_at(5))
    (file,) = (tmp_path / "kept").glob("*.safetensors")
    whole = file.read_bytes()
    file.write_bytes(forged(whole, lambda arrays: None))
    expected = fit(posed(1), **chosen, checkpoints=kept)
    assert kept.spoilt == [], "what is only copied is sound"
    for change in (no_number, partial(no_number, value=np.inf), other_shape, fewer):
        kept.spoilt.clear()
        file.write_bytes(forged(whole, change))
        found = fit(posed(1), **chosen, checkpoints=kept)
        assert kept.spoilt[:1] == [file.name]
        np.testing.assert_array_equal(found.theta, expected.theta)


def test_states_of_another_fit_are_refused(tmp_path):
    place = tmp_path / "kept"
    with pytest.raises(Killed):
        kept = Checkpoints(place, "one fit", every=0.0).opened(resume=False)
        fit(posed(1), **options(Streaming()), checkpoints=kept, progress=dies_at(3))
    with pytest.raises(
        oa.InputError, match="is the state of another spec, other data or another version"
    ):
        Checkpoints(place, "another fit").opened(resume=True)
    Checkpoints(place, "another fit").opened(resume=False)
    assert not place.exists()
    place.mkdir()
    (place / "thesis.tex").touch()
    with pytest.raises(oa.InputError, match="holds no state of a training"):
        Checkpoints(place, "another fit").opened(resume=False)


def test_a_command_that_was_killed_goes_on(folder, tmp_path, without_figures):  # noqa: F811
    expected = fitted(folder, "stream")
    path = folder / "kept.toml"
    text = SPEC.format(kind="stream", structure="orthogonal", regularization='"none"')
    path.write_text(f"{text}checkpoint = 0.0\n", encoding="utf-8")
    out = tmp_path / "out"
    with pytest.raises(Killed):
        fit_job(keep_states(oa.load_spec(path), out), Progress(dies_at(5)))
    assert (tmp_path / "out.training" / "training.json").exists()
    assert tmp_path / "out.training" in PARTIALS.placed, "Ctrl-C names it"
    done = run("fit", path, "--out", out, "--resume")
    assert done.code == 0, done.err
    assert not (tmp_path / "out.training").exists() and (out / "result.json").exists()
    model = oa.load(out / "model")
    assert [p["value"] for p in expected["parameters"]] == list(model.theta)
    with pytest.raises(Killed):
        fit_job(keep_states(oa.load_spec(path), out), Progress(dies_at(5)))
    path.write_text(f"{text}checkpoint = 1.0\n", encoding="utf-8")
    assert run("fit", path, "--out", out, "--force", "--resume").code == 2
    fitted_again = fit_job(keep_states(oa.load_spec(path), out))
    write_result(fitted_again, out, force=True)
    assert not (tmp_path / "out.training").exists()
