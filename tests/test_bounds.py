"""Bounds on θ: bounded least squares where θ decouples, an active set where it does not, and what is told."""

from __future__ import annotations

import json

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from test_cli import run

from orthaug import (
    MLP,
    AdamLBFGS,
    Additive,
    Baseline,
    BaselinePenalty,
    Function,
    InputError,
    LevenbergMarquardt,
    Orthogonal,
    OrthogonalPenalty,
    Prediction,
    Record,
    Simulation,
    Term,
    estimate,
    load_spec,
    prediction_std,
)
from orthaug.analysis.imitation import imitation

pytestmark = pytest.mark.usefixtures("without_figures", "without_trials")

NAMES, INITIAL, ROWS = ("a", "b", "c"), np.array([0.7, -0.4, 0.2]), 90
LM, GRADIENT = LevenbergMarquardt(60, tolerance=1e-14), AdamLBFGS(20, 400)
JOINT = (Additive(), OrthogonalPenalty(0.5), BaselinePenalty(0.5))
BOX = {"a": (0.0, 0.8), "c": (0.1, np.inf)}  # both active: least squares is near (1.2, -0.5, -0.4)
LINEAR = Function(
    lambda w, z: w @ jnp.stack([z[0] ** 2, z[0] * z[1]]), lambda key: 0.1 * jnp.ones((1, 2))
)


def signals(ny=1):
    rng = np.random.default_rng(ny)
    u = rng.uniform(-0.5, 1.0, (ROWS, 3))
    y = (u @ [1.0, -0.5, -0.4] + 0.3 * u[:, 0] ** 2)[:, None] * np.array([1.0, 40.0])[:ny]
    return u, y + 0.02 * y.std(axis=0) * rng.normal(size=y.shape)


def record(ny=1):
    u, y = signals(ny)
    return Record.from_arrays(u, y, outputs=["y1", "y2"][:ny])


def physics(box=BOX, ny=1, factor=(1.0, 40.0)):
    """The same three parameters in every output, of which one is forty times the other."""
    terms = []
    for output, size in zip(["y1", "y2"][:ny], factor, strict=False):
        for i, (name, initial) in enumerate(zip(NAMES, INITIAL, strict=True)):
            low, high = (
                side if np.isfinite(side) else None for side in box.get(name, (-np.inf, np.inf))
            )
            initial = float(np.clip(initial, *box.get(name, (-np.inf, np.inf))))
            terms.append(
                Term(name, f"{size} * u{i + 1}[k]", initial, output=output, min=low, max=high)
            )
    return Baseline.from_terms(terms)


def limits(box):
    return np.array([box.get(name, (-np.inf, np.inf)) for name in NAMES]).T


def raw_rows(ny=1):
    """Φ and Y with outputs in deviations, stacked."""
    u, y = signals(ny)
    phi = np.concatenate([size * u / y[:, i].std() for i, size in enumerate([1.0, 40.0][:ny])])
    return phi, (y / y.std(axis=0)).T.ravel()


def bounded(matrix, right, low, high):
    """An independent solver: sequential quadratic programming, refined on the entries that it leaves free."""
    r = np.linalg.qr(np.column_stack([matrix, right]), mode="r")
    square, side = r[: len(low), : len(low)], r[: len(low), len(low)]
    size = np.linalg.norm(square) / 10
    found = scipy.optimize.minimize(
        lambda t: np.sum((side - square @ t) ** 2) / size**2,
        np.clip(np.zeros(len(low)), low, high),
        jac=lambda t: -2 * square.T @ (side - square @ t) / size**2,
        bounds=scipy.optimize.Bounds(low, high),
        method="SLSQP",
        options={"ftol": 1e-18, "maxiter": 1000},
    ).x
    held = np.isclose(found, low, rtol=0, atol=1e-6) | np.isclose(found, high, rtol=0, atol=1e-6)
    refined = np.where(np.isclose(found, low, rtol=0, atol=1e-6), low, np.where(held, high, 0.0))
    refined[~held] = np.linalg.lstsq(matrix[:, ~held], right - matrix @ refined, rcond=None)[0]
    np.testing.assert_allclose(refined, found, atol=1e-4)
    return refined


BOXES = {
    "two active": BOX,
    "one active": {"b": (-0.3, 2.0)},
    "all active": {"a": (0.0, 0.8), "b": (-0.3, 0.0), "c": (0.2, 0.5)},
    "touching no more once another stands": {"a": (0.0, 0.5), "c": (-1.0, 0.35)},
    "one side": {"a": (-np.inf, 0.9)},
}


@pytest.mark.parametrize("ny", [1, 2])
@pytest.mark.parametrize("box", BOXES.values(), ids=BOXES.keys())
def test_physics_alone_is_bounded_least_squares(box, ny):
    found = estimate(record(ny), physics(box, ny), learner=None)
    expected = bounded(*raw_rows(ny), *limits(box))
    np.testing.assert_allclose(found.theta, expected, rtol=1e-9)
    for name, value in found.at_bound.items():
        assert found.theta[NAMES.index(name)] == value


def test_the_solver_of_scipy_agrees():
    phi, y = raw_rows()
    found = scipy.optimize.lsq_linear(phi, y, limits(BOX), method="trf", tol=1e-15, max_iter=500).x
    np.testing.assert_allclose(found, bounded(phi, y, *limits(BOX)), rtol=1e-6)


@pytest.mark.parametrize(
    ("solver", "ny"),
    [(LevenbergMarquardt(8), 1), (LevenbergMarquardt(8), 2), (AdamLBFGS(5, 5), 2)],
    ids=str,
)
def test_orthogonal_structure_is_bounded_least_squares_and_its_learner_does_not_know(ny, solver):
    both = [
        estimate(
            record(ny),
            physics(box, ny),
            learner=MLP(hidden=(3,)),
            structure=Orthogonal(),
            solver=solver,
        )
        for box in (BOX, {})
    ]
    np.testing.assert_allclose(both[0].theta, bounded(*raw_rows(ny), *limits(BOX)), rtol=1e-9)
    np.testing.assert_array_equal(both[0].model.numbers.weights, both[1].model.numbers.weights)
    np.testing.assert_array_equal(both[0].model.theta_aux, both[1].model.theta_aux)
    assert both[0].defect < 1e-12
    assert set(both[0].at_bound) == {"a", "c"} and not both[1].at_bound


# --- where θ does not decouple: the joint problem of a learner that is linear in its weights


def joint_rows(structure):
    """Matrix and right-hand side over (θ, w), written out."""
    u, y = signals()
    z = 2 * (u - u.min(axis=0)) / np.ptp(u, axis=0) - 1
    psi = np.stack([z[:, 0] ** 2, z[:, 0] * z[:, 1]], axis=1)
    rows, right = [np.hstack([u, psi])], [y[:, 0]]
    root = np.sqrt(getattr(structure, "weight", 0.0))
    if isinstance(structure, OrthogonalPenalty):
        rows.append(root * np.hstack([np.zeros((3, 3)), np.linalg.qr(u)[0].T @ psi]))
        right.append(np.zeros(3))
    if isinstance(structure, BaselinePenalty):
        rows.append(root * np.hstack([np.diag(1 / INITIAL), np.zeros((3, 2))]))
        right.append(root * np.ones(3))
    return np.concatenate(rows), np.concatenate(right)


def joint(structure, solver, box=BOX):
    return estimate(
        record(),
        physics(box),
        learner=LINEAR,
        structure=structure,
        solver=solver,
        regularization="none",
    )


def unknowns(fit):
    """(θ, w) in the units of `joint_rows`."""
    return np.concatenate([fit.theta, fit.model.numbers.weights * fit.model.numbers.gain[0]])


@pytest.mark.parametrize(
    ("solver", "relative"), [(LM, 1e-9), (GRADIENT, 1e-5)], ids=["lm", "adam-lbfgs"]
)
@pytest.mark.parametrize("structure", JOINT, ids=lambda s: s.name)
def test_joint_structures_end_at_the_bounded_optimum(structure, solver, relative):
    matrix, right = joint_rows(structure)
    low, high = (
        np.concatenate([side, [end, end]])
        for side, end in zip(limits(BOX), (-np.inf, np.inf), strict=True)
    )
    expected = bounded(matrix, right, low, high)
    found = joint(structure, solver)
    np.testing.assert_allclose(
        unknowns(found), expected, rtol=relative, atol=relative * np.abs(expected).max()
    )
    assert found.at_bound and found.status.ok
    for name, value in found.at_bound.items():
        assert found.theta[NAMES.index(name)] == value


@pytest.mark.parametrize("structure", JOINT, ids=lambda s: s.name)
def test_first_order_conditions_of_the_joint_criterion(structure):
    matrix, right = joint_rows(structure)
    found = joint(structure, LM)
    gradient = -matrix.T @ (right - matrix @ unknowns(found)) / np.linalg.norm(right)
    low, high = limits(BOX)
    for i, name in enumerate(NAMES):
        value = found.at_bound.get(name)
        if value is None:
            assert abs(gradient[i]) < 1e-7
        else:
            assert value in (low[i], high[i])
            assert gradient[i] > 0 if value == low[i] else gradient[i] < 0
    assert np.abs(gradient[3:]).max() < 1e-7


@pytest.mark.parametrize("structure", JOINT, ids=lambda s: s.name)
def test_no_theta_in_the_box_is_better(structure):
    """Against a learner trained anew for each θ of a grid."""
    matrix, right = joint_rows(structure)
    found = np.sum((right - matrix @ unknowns(joint(structure, LM))) ** 2)
    grid = np.stack(np.meshgrid([0.0, 0.4, 0.8], [-0.6, -0.5, -0.4], [0.1, 0.2]), axis=-1).reshape(
        -1, 3
    )
    others = []
    for theta in grid:
        rest = right - matrix[:, :3] @ theta
        others.append(np.linalg.lstsq(matrix[:, 3:], rest, rcond=None)[1].item())
    assert found <= min(others) * (1 + 1e-12)


@pytest.mark.parametrize(
    "start", [(0.7, -0.4, 0.2), (0.8, -0.6, 0.4)], ids=["inside", "in a corner"]
)
@pytest.mark.parametrize("steps", [(0, 1), (3, 0), (30, 30)], ids=str)
@pytest.mark.parametrize("structure", [JOINT[0], JOINT[2]], ids=lambda s: s.name)
def test_theta_is_inside_the_box_however_early_training_stops(structure, steps, start):
    box = {"a": (0.0, 0.8), "b": (-0.6, 0.0), "c": (0.1, 0.4)}
    declared = physics(box)
    terms = [Term(t.parameter, t.regressor, v, output=t.output, min=t.min, max=t.max)
             for t, v in zip(declared.terms, start, strict=True)]  # fmt: skip
    found = estimate(
        record(),
        Baseline.from_terms(terms),
        learner=LINEAR,
        structure=structure,
        solver=AdamLBFGS(*steps),
    )
    low, high = limits(box)
    assert np.all(found.theta >= low) and np.all(found.theta <= high)


@pytest.mark.parametrize("structure", [Orthogonal(), *JOINT], ids=lambda s: s.name)
def test_bounds_that_are_not_reached_change_nothing(structure):
    wide = {name: (-50.0, 50.0) for name in NAMES}
    found, free = joint(structure, LM, wide), joint(structure, LM, {})
    np.testing.assert_allclose(found.theta, free.theta, rtol=1e-12)
    np.testing.assert_allclose(unknowns(found), unknowns(free), rtol=1e-12)
    assert not found.at_bound and not any("bound" in str(text) for text in found.warnings)
    if free.std is not None:
        np.testing.assert_allclose(found.std, free.std, rtol=1e-12)


# --- beside a learner that sees only some features: what stands at a bound is a known term


def powers(ny, inputs):
    """A learner that is linear in its weights, so that training ends where it should: powers up to the fourth."""
    return Function(
        lambda w, z: w @ jnp.concatenate([jnp.ones(1), z, z**2, z**3, z**4]),
        lambda key: 0.1 * jnp.ones((ny, 1 + 4 * len(inputs))),
        inputs,
    )


def heated(ny=1, fixed=None):
    """Cooling along a curve of the temperature, of which the physics has the line and the learner sees the rest."""
    rng = np.random.default_rng(7)
    u = np.repeat(rng.uniform(0.0, 1.0, 40), 10)
    y = np.zeros((len(u), ny))
    gains = np.array([0.5, -0.3])[:ny]
    for k in range(1, len(u)):
        y[k] = (
            0.9 * y[k - 1] - 0.15 * y[k - 1] ** 3 + gains * u[k - 1] + 0.003 * rng.normal(size=ny)
        )
    terms, names = [], ["y1", "y2"][:ny]
    for i, name in enumerate(names, 1):
        side = {"min": -0.06, "max": 0.0} if fixed is None else {"fixed": True}
        start = -0.02 if fixed is None else fixed
        terms += [Term(f"one{i}", f"{name}[k-1]", 1.0, output=name, fixed=True),
                  Term(f"loss{i}", f"{name}[k-1]", start, output=name, **side),
                  Term(f"gain{i}", "u[k-1]", output=name)]  # fmt: skip
    inputs = tuple(f"{name}[k-1]" for name in names)
    record = Record.from_arrays(u[:, None], y, inputs=["u"], outputs=names)
    return record, Baseline.from_terms(terms), powers(ny, inputs)


OPTIONS = {"regularization": "none", "solver": LevenbergMarquardt(60, tolerance=1e-12)}


def of(names, fit):
    order = [fit.problem.baseline.names.index(name) for name in names]
    return fit.theta[order], fit.std[order]


@pytest.mark.parametrize(
    "criterion", [Prediction(), Simulation(40, 5)], ids=["one step", "free run"]
)
@pytest.mark.parametrize("ny", [1, 2])
def test_a_bound_leaves_the_others_as_a_fixed_term_does(ny, criterion):
    """The loss is steeper than the bound allows: the learner has to express the rest, for nothing else can."""
    fits = []
    for fixed in (None, -0.06):
        given, baseline, learner = heated(ny, fixed)
        fits.append(
            estimate(
                given,
                baseline,
                learner=learner,
                criterion=criterion,
                blocks=0,
                standard_errors="plain",  # of a fit at a bound there are no others
                **OPTIONS,
            )
        )
    found, known = fits
    gains = [f"gain{i}" for i in range(1, ny + 1)]
    assert dict(found.at_bound) == {f"loss{i}": -0.06 for i in range(1, ny + 1)}
    (value, std), (expected, error) = of(gains, found), of(gains, known)
    np.testing.assert_allclose(value, expected, rtol=1e-4)
    np.testing.assert_allclose(std, error, rtol=1e-3)
    assert np.all(np.abs(value - np.array([0.5, -0.3])[:ny]) < 4 * std)
    assert found.status.loss == pytest.approx(known.status.loss, rel=1e-4) and found.defect < 1e-12
    assert found.status.iterations <= 60 and found.status.loss <= found.status.start_loss
    assert not any(warning.code == "no_standard_errors" for warning in found.warnings)


def test_what_the_learner_could_imitate_is_reported_for_the_others():
    given, baseline, learner = heated()
    fit = estimate(given, baseline, learner=learner, **OPTIONS)
    found = imitation(fit.problem, others=False, held=tuple(fit.at_bound))
    assert found.determined == ("gain1",) and found.directions == () and not fit.model.shared.size
    assert found.text.startswith("loss1 is at a bound: the orthogonal split does not move it.")
    assert "imitate nothing of the other physics" in found.text
    (warning,) = (str(text) for text in fit.warnings if text.code == "at_a_bound")
    assert "is a known term" in warning and "the learner is not made orthogonal to it" in warning


def test_an_ensemble_keeps_its_bounds():
    given, baseline, learner = heated()
    fit = estimate(given, baseline, learner=learner, restarts=3, ensemble=True, **OPTIONS)
    single = estimate(given, baseline, learner=learner, **OPTIONS)
    assert fit.at_bound == single.at_bound
    np.testing.assert_allclose(fit.theta, single.theta, rtol=1e-8)
    assert fit.status.loss == pytest.approx(single.status.loss, rel=1e-8)


def test_predictions_have_the_errors_of_a_fit_with_that_term_fixed():
    stds = []
    for fixed in (None, -0.06):
        given, baseline, learner = heated(fixed=fixed)
        stds.append(
            prediction_std(estimate(given, baseline, learner=learner, **OPTIONS).model, given)[0][
                2:
            ]
        )
    np.testing.assert_allclose(stds[0], stds[1], rtol=1e-6)


def seen_in_part(truth=1.0):
    """Two inputs that go together; the second acts along a curve, which the learner sees."""
    rng = np.random.default_rng(3)
    second = rng.uniform(0.0, 1.0, 400)
    first = second**3 + 0.2 * rng.normal(size=400)
    y = truth * first + 0.5 * second + 0.8 * second**4 + 0.01 * rng.normal(size=400)
    return Record.from_arrays(np.column_stack([first, second]), y, outputs=["y"])


def two_inputs(box, fixed=None):
    terms = []
    for name, regressor in (("a", "u1[k]"), ("b", "u2[k]")):
        (low, high), known = box.get(name, (None, None)), name in (fixed or {})
        start = fixed[name] if known else high if low is None else low
        terms.append(Term(name, regressor, start or 0.0, fixed=known, min=low, max=high))
    return Baseline.from_terms(terms)


CURVED = powers(1, ("u2[k]",))
ALIKE = {
    True: 1e-4,
    False: 1 / 300,
}  # the free run counts what has bounds among its 400 degrees of freedom
CRITERIA = pytest.mark.parametrize(
    "criterion", [Prediction(), Simulation(40, 0)], ids=["one step", "free run"]
)
ALONE = {
    "found by the fit": {"a": (None, 1.2)},
    "shared": {"b": (0.8, None)},
}  # (1.31, 0.70) alone, (1.00, 0.88) beside
BESIDE = {"found by the fit": {"a": (1.2, None)}, "shared": {"b": (None, 0.75)}}


def partly(box, criterion, learner=CURVED, fixed=None):
    return estimate(
        seen_in_part(),
        two_inputs(box, fixed),
        learner=learner,
        criterion=criterion,
        blocks=0,
        **OPTIONS,
    )


@CRITERIA
@pytest.mark.parametrize("box", ALONE.values(), ids=ALONE.keys())
def test_a_bound_of_physics_alone_is_left_with_the_learner(box, criterion):
    alone, found, free = partly(box, criterion, None), partly(box, criterion), partly({}, criterion)
    assert set(alone.at_bound) == set(box) and not found.at_bound
    assert abs(found.theta[0] - 1.0) < 4 * found.std[0]
    np.testing.assert_allclose(found.theta, free.theta, rtol=1e-6)
    np.testing.assert_allclose(found.std, free.std, rtol=ALIKE[criterion.one_step])
    assert found.status.iterations <= 60 and found.status.loss <= found.status.start_loss


@CRITERIA
@pytest.mark.parametrize("box", BESIDE.values(), ids=BESIDE.keys())
def test_a_bound_that_only_the_learner_reaches(box, criterion):
    alone, found = partly(box, criterion, None), partly(box, criterion)
    ((name, at),) = found.at_bound.items()
    known = partly({}, criterion, fixed=found.at_bound)
    assert not alone.at_bound and at in box[name]
    other = 1 - ("a", "b").index(name)
    np.testing.assert_allclose(found.theta[other], known.theta[0], rtol=1e-6)
    np.testing.assert_allclose(found.std[other], known.std[0], rtol=ALIKE[criterion.one_step])
    assert found.status.iterations <= 60 and found.status.loss <= found.status.start_loss


@pytest.mark.parametrize("iterations", [1, 3])
@pytest.mark.parametrize("box", [*ALONE.values(), *BESIDE.values()], ids=str)
def test_no_run_ends_above_physics_alone_with_bounds(box, iterations):
    options = {**OPTIONS, "solver": LevenbergMarquardt(iterations), "restarts": 3}
    learner = MLP(hidden=(4,), inputs=("u2[k]",))
    found = estimate(seen_in_part(), two_inputs(box), learner=learner, **options)
    assert all(run.loss <= found.status.start_loss * (1 + 1e-12) for run in found.restarts)
    assert all(run.iterations <= iterations for run in found.restarts)
    low, high = found.problem.baseline.bounds
    assert np.all((low <= found.theta) & (found.theta <= high))


# --- what is told


@pytest.mark.parametrize("learner", [None, LINEAR], ids=["physics alone", "with a learner"])
def test_what_stands_at_a_bound_is_named(learner):
    found = estimate(record(), physics(), learner=learner, solver=LM, regularization="none")
    assert dict(found.at_bound) == {"a": 0.8, "c": 0.1}
    (text,) = (str(text) for text in found.warnings if text.code == "at_a_bound")
    assert text.startswith("at a bound")
    assert "a = 0.8" in text and "c = 0.1" in text and "b =" not in text
    np.testing.assert_array_equal(np.isnan(found.std), [True, False, True])
    np.testing.assert_array_equal(np.isnan(found.interval).any(axis=1), [True, False, True])
    assert "a = 0.8" in found.summary()


def test_the_others_have_the_standard_errors_of_a_fit_with_that_term_fixed():
    found = estimate(record(), physics(), learner=None)
    terms = [
        Term(
            t.parameter,
            t.regressor,
            found.at_bound.get(t.parameter, t.initial),
            fixed=t.parameter in found.at_bound,
        )
        for t in physics().terms
    ]
    refit = estimate(record(), Baseline.from_terms(terms), learner=None)
    assert refit.model.form.baseline.names == ("b",)
    np.testing.assert_allclose(found.theta[1], refit.theta[0], rtol=1e-10)
    np.testing.assert_allclose(found.std[1], refit.std[0], rtol=1e-10)
    np.testing.assert_allclose(found.interval[1], refit.interval[0], rtol=1e-10)


@pytest.mark.parametrize(
    ("low", "high", "words"),
    [
        (1.0, 1.0, r"bounds of 'a'.*min = 1.*max = 1"),
        (2.0, -1.0, r"bounds of 'a'.*min = 2.*max = -1"),
        (float("nan"), 1.0, "lower bound of 'a'.*finite"),
        (0.0, float("inf"), "upper bound of 'a'.*finite"),
        ("0", 1.0, "lower bound of 'a'.*finite"),
    ],
    ids=str,
)
def test_bounds_that_are_none_are_refused(low, high, words):
    with pytest.raises(InputError, match=words):
        Baseline.from_terms([Term("a", "u[k]", min=low, max=high)])


def test_terms_of_one_parameter_share_its_bounds():
    baseline = Baseline.from_terms([Term("a", "u[k]", min=0.0), Term("a", "u[k-1]", max=2.0)])
    np.testing.assert_array_equal(baseline.bounds, [[0.0], [2.0]])
    with pytest.raises(InputError, match="'a' disagree on `min`"):
        Baseline.from_terms([Term("a", "u[k]", min=0.0), Term("a", "u[k-1]", min=1.0)])


SPEC = """
[data]
sampling_time = 1.0
inputs = ["u1", "u2", "u3"]
outputs = ["y1"]
train = { files = ["run.csv"] }
[[baseline.terms]]
parameter = "a"
regressor = "u1[k]"
min = 0
max = 0.8
[[baseline.terms]]
parameter = "b"
regressor = "u2[k]"
[[baseline.terms]]
parameter = "c"
regressor = "u3[k]"
initial = 0.2
min = 0.1
[learner]
kind = "none"
"""


def project(folder, spec=SPEC):
    u, y = signals()
    columns = np.column_stack([u, y])
    np.savetxt(
        folder / "run.csv", columns, delimiter=",", header="u1,u2,u3,y1", comments="", fmt="%.17g"
    )
    (folder / "plant.toml").write_text(spec)
    return folder / "plant.toml"


def test_a_spec_carries_bounds(tmp_path):
    baseline = load_spec(project(tmp_path)).problem.baseline
    np.testing.assert_array_equal(baseline.bounds, [[0.0, -np.inf, 0.1], [0.8, np.inf, np.inf]])


@pytest.mark.parametrize("kind", ["none", "mlp"])
def test_a_fit_from_a_spec(tmp_path, kind):
    spec = project(
        tmp_path, SPEC.replace('"none"', f'"{kind}"\nhidden = [3]\n[training]\niterations = 5')
    )
    done = run("fit", spec, "--out", tmp_path / "out")
    assert done.code == 0, done.err
    result = json.loads((tmp_path / "out" / "result.json").read_text(encoding="utf-8"))
    a, b, c = result["parameters"]
    assert (a["value"], c["value"]) == (0.8, 0.1)
    assert b["value"] == pytest.approx(bounded(*raw_rows(), *limits(BOX))[1], rel=1e-9)
    for entry in (a, c):
        assert entry["std"] is None and entry["ci95"] is None
    assert b["std"] > 0 and b["ci95"][0] < b["value"] < b["ci95"][1]
    assert any("a = 0.8" in w["text"] and "c = 0.1" in w["text"] for w in result["warnings"])


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("max = 0.8", "max = 0", ("'a'", "min = 0", "max = 0")),
        ("max = 0.8", "max = -3", ("'a'", "min = 0", "max = -3")),
        ("max = 0.8", "max = 0.8\ninitial = 0.9", ("initial value of 'a' is 0.9", "0 and 0.8")),
        ("initial = 0.2\n", "", ("initial value of 'c' is 0;", "0.1 and inf", "Give an `initial`")),
        ("max = 0.8", "max = inf", ("max", "finite")),
        ("max = 0.8", "max = nan", ("max", "finite")),
        ("max = 0.8", 'max = "high"', ("max", "high", "number")),
    ],
    ids=str,
)
def test_bad_bounds_in_a_spec(tmp_path, old, new, words):
    spec = project(tmp_path, SPEC.replace(old, new))
    done = run("fit", spec, "--out", tmp_path / "out")
    assert done.code == 2 and done.err.count("\n") == 1
    for word in ("plant.toml", *words):
        assert word in done.err
    assert not (tmp_path / "out").exists()
