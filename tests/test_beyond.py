"""What a learned correction does beyond its training: the physics goes on with its θ, and what it adds is bounded."""

import json
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from test_cli import run

import orthaug as oa
from orthaug import stability
from orthaug.analysis.beyond_training import describe_beyond

pytestmark = pytest.mark.usefixtures("without_figures")


def plant(rows=600, amplitude=1.0, seed=0, noise=0.0) -> oa.Record:
    """A stable linear plant with a cubic term, whose input is held for five samples."""
    rng = np.random.default_rng(seed)
    u = amplitude * np.repeat(rng.uniform(-1, 1, rows // 5 + 1), 5)[:rows]
    y = np.zeros(rows)
    for k in range(2, rows):
        y[k] = (
            1.5 * y[k - 1]
            - 0.6 * y[k - 2]
            + 0.1 * u[k - 1]
            - 0.05 * y[k - 1] ** 3
            + noise * rng.normal()
        )
    return oa.Record.from_arrays(u=u, y=y)


def louder(times: float) -> oa.Record:
    """Inputs many times as large, from the outputs of training."""
    (experiment,) = plant(seed=3).experiments
    return oa.Record.from_arrays(u=times * experiment.inputs[:, 0], y=experiment.outputs[:, 0])


PHYSICS = oa.Baseline.from_terms(
    [oa.Term("a1", "y[k-1]"), oa.Term("a2", "y[k-2]"), oa.Term("b", "u[k-1]")]
)


@cache
def fitted(**learner) -> oa.Model:
    learner = oa.MLP(hidden=(6,), **learner)
    options = {"criterion": oa.Prediction(), "regularization": 1e-3, "standard_errors": "plain"}
    return oa.estimate(plant(), PHYSICS, learner=learner, **options).model


def far(model: oa.Model, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Physics and learner one step ahead of outputs and inputs `scale` times as large as those of training."""
    record = plant()
    y, u = (
        scale * np.asarray(part)
        for part in (record.experiments[0].outputs, record.experiments[0].inputs)
    )
    found = model.predict(oa.Record.from_arrays(u=u[:, 0], y=y[:, 0])).trajectories[0]
    return found.baseline[2:, 0], found.learner[2:, 0]


def test_the_physics_goes_on_and_the_correction_is_bounded():
    model, free = fitted(), fitted(beyond="free")
    np.testing.assert_array_equal(model.theta, free.theta)
    inside, outside = far(model, 1.0), far(model, 1000.0)
    np.testing.assert_allclose(outside[0], 1000 * inside[0], rtol=1e-9, atol=1e-9)  # φθ̂ is linear
    largest = np.abs(far(model, 1.5)[1]).max()
    assert np.abs(outside[1]).max() < 3 * largest
    assert np.abs(far(free, 1000.0)[1]).max() > 100 * largest  # −φθ_aux goes on, too


def test_a_correction_that_fades_leaves_the_physics_alone():
    model = fitted(beyond="fade")
    assert np.abs(far(model, 1000.0)[1][200:]).max() < 1e-3 * np.abs(far(model, 1.0)[1]).max()


@pytest.mark.parametrize("beyond", ["hold", "fade"])
def test_within_its_training_nothing_is_changed(beyond):
    held, free = fitted(beyond=beyond), fitted(beyond="free")
    for what in ("predict", "simulate"):
        found, expected = (
            getattr(model, what)(plant()).trajectories[0].model for model in (held, free)
        )
        np.testing.assert_allclose(found[2:], expected[2:], rtol=1e-12, atol=1e-13)


def test_a_free_run_far_beyond_its_training_stays_bounded():
    """The physics is stable, so that a bounded correction keeps the run bounded whatever the input is."""
    found = fitted().simulate(louder(300.0)).trajectories[0]
    assert found.diverged is None and np.abs(found.model[2:]).max() < 3e3


def test_a_learner_of_a_difference_is_held_in_the_difference():
    """Positions far from those of training at the same speeds: what sees the speed alone goes on as it is."""
    rows, rng = 500, np.random.default_rng(1)
    u, x = np.repeat(rng.uniform(-1, 1, rows // 10), 10), np.zeros(rows)
    for k in range(2, rows):
        v = x[k - 1] - x[k - 2]
        x[k] = x[k - 1] + 0.9 * v + 0.01 * u[k - 1] - 0.01 * np.tanh(v / 0.02)
    terms = [oa.Term("p", "y[k-1]"), oa.Term("v", "y[k-1] - y[k-2]"), oa.Term("b", "u[k-1]")]
    learner = oa.MLP(hidden=(6,), inputs=("y[k-1] - y[k-2]",))
    model = oa.estimate(
        oa.Record.from_arrays(u=u, y=x),
        oa.Baseline.from_terms(terms),
        learner=learner,
        criterion=oa.Prediction(),
    ).model
    here, there = (
        model.predict(oa.Record.from_arrays(u=u, y=x + moved)).trajectories[0].learner[2:]
        for moved in (0, 1e3)
    )
    np.testing.assert_allclose(there, here, atol=1e-9 * np.abs(here).max() + 1e-10)


def test_terms_are_an_equation_that_goes_on():
    terms = oa.Terms(("y[k-1]**3",))
    model = oa.estimate(plant(), PHYSICS, learner=terms).model
    assert model.numbers.limits is None
    held = oa.estimate(plant(), PHYSICS, learner=oa.Terms(("y[k-1]**3",), beyond="hold")).model
    assert np.abs(far(held, 100.0)[1]).max() < 1e-3 * np.abs(far(model, 100.0)[1]).max()


def test_a_saved_model_holds_as_well(tmp_path):
    model = fitted()
    oa.save(model, tmp_path / "model")
    record = louder(50.0)
    for what in ("predict", "simulate"):
        found, expected = (
            getattr(m, what)(record).trajectories[0].model
            for m in (oa.load(tmp_path / "model"), model)
        )
        np.testing.assert_array_equal(found, expected)


def test_the_gradient_of_a_step_is_that_of_what_is_held():
    """A linear view far outside sees the physics alone."""
    import jax

    model = fitted()
    slope = np.asarray(
        jax.jacobian(lambda s: model.step(s, np.array([1e3]))[1])(
            np.full(len(model.state_names), 1e3)
        )
    )
    by_name = dict(zip(model.state_names, slope[0], strict=True))
    np.testing.assert_allclose([by_name["y[k-1]"], by_name["y[k-2]"]], model.theta[:2], rtol=1e-9)


def test_the_spec_says_it(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    experiment = plant().experiments[0]
    rows = np.column_stack([experiment.inputs, experiment.outputs])
    np.savetxt("run.csv", rows, delimiter=",", header="u,y", comments="")
    text = """
[data]
sampling_time = 1.0
inputs = ["u"]
outputs = ["y"]
train = { files = ["run.csv"] }
[[baseline.terms]]
parameter = "a"
regressor = "y[k-1]"
[[baseline.terms]]
parameter = "b"
regressor = "u[k-1]"
[learner]
hidden = [2]
beyond = "WHAT"
[training]
iterations = 20
focus = "prediction"
[validation]
blocks = 0
"""
    (tmp_path / "wrong.toml").write_text(text.replace("WHAT", "clip"))
    assert run("fit", "wrong.toml").code == 2
    (tmp_path / "spec.toml").write_text(text.replace("WHAT", "free"))
    assert run("fit", "spec.toml", "--out", "out").code == 0
    assert (
        json.loads((tmp_path / "out/model/model.json").read_text())["learner"]["beyond"] == "free"
    )
    assert oa.load(tmp_path / "out").numbers.limits is None


def test_a_motion_fades():
    """A pendulum that is pushed far over: its friction is learned for slow swings, and is none where it never was."""
    rng, rows, step = np.random.default_rng(0), 400, 0.05
    u, x, v, y = np.repeat(rng.uniform(-1, 1, rows // 10), 10), 0.0, 0.0, []
    for k in range(rows):
        y.append(x)
        for _ in range(5):
            v += step / 5 * (u[k] - 4.0 * x - 0.5 * v - 0.4 * np.tanh(v / 0.1))
            x += step / 5 * v
    motion = oa.Motion.from_equations(
        states=[
            oa.State("x", "v", start="y"),
            oa.State("v", "u - k*x - c*v", learned=True, start="derivative of y"),
        ],
        outputs=[oa.Output("y", "x")],
        inputs=["u"],
        parameters=[oa.PhysicalParameter("k", 3.0, min=0), oa.PhysicalParameter("c", 1.0, min=0)],
    )
    record = oa.Record.from_arrays(u=u, y=np.array(y), sampling_time=step)
    learner = oa.MLP(hidden=(4,), inputs=("v",))
    fit = oa.estimate(record, motion, learner=learner, regularization="none", blocks=0)
    model = fit.model
    assert model.form.beyond == "fade" and model.numbers.limits is not None
    p = model.parameters
    slow, fast = (
        np.asarray(model.step(np.array([0.0, speed]), np.zeros(1))[0]) for speed in (0.0, 1e3)
    )
    physics = np.asarray(model.physics_only.step(np.array([0.0, 1e3]), np.zeros(1))[0])
    np.testing.assert_allclose(fast, physics, rtol=1e-9)
    assert p["k"] > 0 and np.isfinite(slow).all()


def test_a_bounded_correction_on_stable_physics_is_a_proof(tmp_path, monkeypatch):
    """What goes on far away is the physics with θ̂: its spectral radius is in the result, but not of a free learner."""
    monkeypatch.chdir(tmp_path)
    rng, rows = np.random.default_rng(1), 300
    u, y = rng.standard_normal(rows), np.zeros(rows)
    for k in range(2, rows):
        v = y[k - 1] - y[k - 2]
        y[k] = (
            1.2 * y[k - 1]
            - 0.5 * y[k - 2]
            + 0.3 * u[k - 1]
            - 0.1 * np.tanh(3 * v)
            + 1e-3 * rng.standard_normal()
        )
    Path("d.csv").write_text("u,y\n" + "\n".join(f"{a},{b}" for a, b in zip(u, y, strict=True)))
    terms = [("a1", "y[k-1]"), ("a2", "y[k-2]"), ("b1", "u[k-1]")]
    spec = '[data]\ntrain = { files = ["d.csv"] }\nsampling_time = 1.0\ninputs = ["u"]\noutputs = ["y"]\n'
    spec += "".join(f'[[baseline.terms]]\nparameter = "{p}"\nregressor = "{r}"\n' for p, r in terms)
    spec += '[learner]\nkind = "mlp"\nhidden = [4]\nbeyond = "BEYOND"\n'
    spec += '[training]\nfocus = "prediction"\nfallback = false\n'
    for beyond in ("hold", "free"):
        Path("spec.toml").write_text(spec.replace("BEYOND", beyond))
        assert run("fit", "spec.toml", "--out", "out", "--force").code == 0
        result = json.loads(Path("out/result.json").read_text())
        theta = {p["name"]: p["value"] for p in result["parameters"]}
        found = result["stability"]
        if beyond == "hold":
            expected = np.abs(np.roots([1, -theta["a1"], -theta["a2"]])).max()
            assert found["radius_beyond"] == pytest.approx(expected, rel=1e-9) and expected < 1
            assert "bounded inputs give a bounded free run" in found["text"]
        else:
            assert "radius_beyond" not in found and "bounded inputs" not in found["text"]


def test_nonlinear_physics_proves_nothing():
    """With y² in the physics, what goes on far away is no one linear system."""
    rng, rows = np.random.default_rng(2), 300
    u, y = rng.standard_normal(rows), np.zeros(rows)
    for k in range(1, rows):
        y[k] = 0.6 * y[k - 1] + 0.3 * u[k - 1] - 0.02 * y[k - 1] ** 2 - 0.1 * np.tanh(3 * y[k - 1])
    record = oa.Record.from_arrays(u=u, y=y, sampling_time=1.0)
    terms = [oa.Term("a", "y[k-1]"), oa.Term("c", "y[k-1]**2"), oa.Term("b", "u[k-1]")]
    fit = oa.estimate(record, oa.Baseline.from_terms(terms), learner=oa.MLP((4,)), fallback=False)
    assert stability(fit.model, record).radius_beyond is None


@pytest.mark.parametrize("radius", [1 - 1e-15, 1.0, 1 + 1e-9])
def test_an_integrator_is_no_proof_of_a_bounded_run(radius: float) -> None:
    """0.9999999999999999 is below 1, and was called a proof beside "has an integrator"."""
    model = cast(Any, SimpleNamespace(form=SimpleNamespace(beyond="fade")))
    text = describe_beyond(model, radius)
    assert "integrates there" in text and "proof" not in text
    assert "This is a proof" in describe_beyond(model, 0.99)
    assert "just below 1 there" in describe_beyond(model, 0.99998)
    assert "proves no bound" in describe_beyond(model, 1.01)
