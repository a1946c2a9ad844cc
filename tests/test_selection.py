"""Structure is found: terms on the free run, orders and delay, what is nonlinear; nothing where there is nothing."""

from __future__ import annotations

import itertools

import numpy as np
import pandas as pd
import pytest
import scipy.signal
from scipy.signal import lfilter
from test_cli import finite_json, one_line, run

import orthaug as oa
from orthaug.data.terms import TermLibrary
from orthaug.physics.problem import pose
from orthaug.reports.selection import SelectResult, selection_text
from orthaug.selection.candidates import SHORTLIST, candidates
from orthaug.selection.forward import Equations, forward
from orthaug.selection.nonlinearity import nonlinearity
from orthaug.selection.term_path import PathModel, judge_all
from orthaug.selection.term_runs import Point

PHYSICS = oa.Baseline.from_terms([oa.Term("a", "y[k-1]"), oa.Term("b", "u[k-1]")])
LAGS, FLOWN = oa.Lags(2, 2, 1), oa.Simulation(128, 20)
TRUE_VALUES = {"y[k-2]**3": -0.2, "u[k-1]*u[k-2]": 0.4}
TRUE = set(TRUE_VALUES)
MOST = 5


def plant(rows: int = 600, noise: float = 0.02, *, terms: bool = True, seed: int = 3) -> oa.Record:
    """Sensor noise on y = 0.6 y1 + u1 − 0.2 y2³ + 0.4 u1 u2."""
    rng = np.random.default_rng(seed)
    u, y = rng.uniform(-1, 1, rows), np.zeros(rows)
    for k in range(2, rows):
        y[k] = 0.6 * y[k - 1] + u[k - 1]
        y[k] += terms * (0.4 * u[k - 1] * u[k - 2] - 0.2 * y[k - 2] ** 3)
    return oa.Record.from_arrays(u=u, y=y + noise * rng.normal(size=rows))


def linear(b: list[float], a: list[float], noise: float = 0.02, rows: int = 600) -> oa.Record:
    rng = np.random.default_rng(1)
    u = rng.normal(size=rows)
    return oa.Record.from_arrays(
        u=u, y=scipy.signal.lfilter(b, a, u) + noise * rng.normal(size=rows)
    )


@pytest.fixture(scope="module")
def selected() -> oa.Selection:
    return oa.select(plant(), PHYSICS, lags=LAGS, criterion=FLOWN, most=MOST)


def test_forward_picks_what_lowers_the_error_most():
    rng = np.random.default_rng(0)
    columns = rng.normal(size=(60, 9)) @ rng.normal(size=(9, 9))
    y = columns @ rng.normal(size=9) + rng.normal(size=60)
    equations = Equations(columns.T @ columns, columns.T @ y, float(y @ y), 60)

    def left(chosen):
        return y - columns[:, chosen] @ np.linalg.lstsq(columns[:, chosen], y, rcond=None)[0]

    chosen, before = [4], float(np.sum(left([4]) ** 2))
    for pick in forward(equations, [4], 5):
        best = min(set(range(9)) - set(chosen), key=lambda j: np.sum(left([*chosen, j]) ** 2))
        assert pick.column == best
        chosen.append(best)
        after = float(np.sum(left(chosen) ** 2))
        assert pick.share == pytest.approx(1 - after / before, abs=1e-9)
        before = after
    p = equations.of(chosen).solve()
    assert equations.of(chosen).miss(p) == pytest.approx(before, rel=1e-9)


def test_forward_picks_no_combination_of_what_is_in():
    rng = np.random.default_rng(1)
    base = rng.normal(size=(50, 3))
    columns = np.column_stack([base, base @ [1.0, 2.0, -1.0], rng.normal(size=50)])
    y = rng.normal(size=50)
    equations = Equations(columns.T @ columns, columns.T @ y, float(y @ y), 50)
    assert [pick.column for pick in forward(equations, [0, 1, 2], 5)] == [4]


def test_the_true_terms_are_found_through_sensor_noise(selected):
    assert selected.terms is not None and isinstance(selected.learner, oa.Terms)
    assert set(selected.learner.terms) == TRUE
    assert selected.nonlinearity is not None and selected.nonlinearity.found
    assert selected.shares == dict.fromkeys(selected.learner.terms, 1.0)
    assert (selected.delays[0].correlation, selected.delays[0].fitted) == (1, 1)
    table = selected.table
    assert (
        list(table.columns[:3]) == ["stage", "model", "size"]
        and table["chosen"].groupby(table["stage"]).sum().eq(1).all()
    )
    assert f"learner     terms {', '.join(selected.learner.terms)}\n" in selected.summary()


def test_the_fit_of_the_choice_has_the_truth_in_its_intervals(selected):
    fit = selected.estimate(blocks=0)
    assert fit.status.ok
    low, high = fit.terms["ci95_low"], fit.terms["ci95_high"]
    for term, value in (("y[k-2]**3", -0.2), ("u[k-1]*u[k-2]", 0.4)):
        assert low[term] < value < high[term]


def test_linearised_equations_are_those_of_the_free_run(selected):
    """What a term lowers the loss by to first order is what it does for a small coefficient."""
    runs = selected.terms.runs
    point = runs.fit(runs.start(), ())
    equations = runs.equations(point)
    nt = len(point.c)
    p = np.concatenate([point.c, np.zeros(len(runs.library))])
    slope = 2 * (equations.hessian @ p - equations.right)[nt:] * runs.rms**2 / equations.rows
    for term in (3, 7):
        moved = []
        for size in (-1e-5, 1e-5):
            one = runs.fit(
                point._replace(chosen=(term,), w=np.array([size])), (term,), iterations=0
            )
            moved.append(one.loss)
        assert (moved[1] - moved[0]) / 2e-5 == pytest.approx(slope[term], rel=2e-3)


def test_halves_choose_on_one_and_fit_the_other():
    record = plant(1200)
    one = oa.select(record, PHYSICS, lags=LAGS, criterion=oa.Prediction(), most=MOST, halves=True)
    options = {"lags": LAGS, "criterion": oa.Prediction(), "most": MOST}
    first = oa.select(record.split(0.5)[0], PHYSICS, halves=False, **options)
    assert one.learner == first.learner and len(one.record) == 600
    np.testing.assert_array_equal(
        one.record.experiments[0].outputs, record.experiments[0].outputs[600:]
    )
    warnings = [note.code for note in first.notes]
    assert "conditional_on_selection" in warnings and "conditional_on_selection" not in [
        n.code for n in one.notes
    ]


def test_where_nothing_helps_nothing_is_chosen():
    one = oa.select(plant(terms=False), PHYSICS, lags=LAGS, criterion=FLOWN, most=MOST)
    assert one.learner is None and "nothing_helps" in [note.code for note in one.notes]
    assert one.nonlinearity is not None and not one.nonlinearity.found


@pytest.mark.parametrize("seed", [2, 12, 15])
def test_blocks_judge_no_terms_that_they_helped_to_choose(seed):
    """Noise in the equation of linear data looks like a term on the rows that it is picked on, and on no others."""
    rng = np.random.default_rng(seed)
    u, y = rng.normal(size=300), np.zeros(300)
    for k in range(2, 300):
        y[k] = (
            1.5 * y[k - 1] - 0.7 * y[k - 2] + 0.5 * u[k - 1] + 0.2 * u[k - 2] + 0.1 * rng.normal()
        )
    physics = oa.Baseline.from_terms(
        [oa.Term(f"{s}{i}", f"{s}[k-{i}]") for s, i in itertools.product("yu", (1, 2))],
    )
    one = oa.select(
        oa.Record.from_arrays(u=u, y=y), physics, lags=LAGS, criterion=oa.Prediction(), most=MOST
    )
    assert one.learner is None and len(one.terms.rungs) > 1


@pytest.mark.parametrize(
    ("b", "a", "orders"),
    [
        ([0.0, 0.0, 1.0, 0.5], [1.0, -1.2, 0.6], (2, 2, 2)),
        ([0.0, 1.0], [1.0, -0.8], (1, 1, 1)),
        ([0.7, 0.0, 0.9], [1.0], (0, 3, 0)),
    ],
)
def test_orders_and_delay(b, a, orders):
    chosen = oa.select(linear(b, a), learner=None, lags=oa.Lags(3, 4, 0), criterion=FLOWN)
    assert (chosen.orders.chosen.na, *chosen.orders.chosen.nb, *chosen.orders.chosen.nk) == orders
    assert chosen.delays[0].correlation == orders[2]


def test_two_inputs_have_their_own_delays():
    rng = np.random.default_rng(2)
    u = rng.normal(size=(600, 2))
    y = scipy.signal.lfilter([0, 1.0], [1, -0.7], u[:, 0]) + scipy.signal.lfilter(
        [0, 0, 0.8], [1, -0.7], u[:, 1]
    )
    record = oa.Record.from_arrays(u=u, y=y + 0.02 * rng.normal(size=600))
    chosen = oa.select(record, learner=None, lags=oa.Lags(2, 3, 0), criterion=FLOWN).orders.chosen
    assert (chosen.na, chosen.nb, chosen.nk) == (1, (1, 1), (1, 2))


def test_what_is_nonlinear_is_named():
    rng = np.random.default_rng(4)
    u, e = rng.normal(size=(2, 500))
    y = scipy.signal.lfilter(
        [1], [1, -0.5], np.concatenate([[0], u[:-1] + 0.05 * u[:-1] ** 3]) + 0.1 * e
    )
    found = nonlinearity(pose(oa.Record.from_arrays(u=u, y=y), PHYSICS), ["y[k-1]", "u[k-1]"])
    assert found is not None and found.p < 0.01 and found.matter == ("u[k-1]",)
    line = scipy.signal.lfilter([1], [1, -0.5], np.concatenate([[0], u[:-1]]) + 0.1 * e)
    none = nonlinearity(pose(oa.Record.from_arrays(u=u, y=line), PHYSICS), ["y[k-1]", "u[k-1]"])
    assert none is not None and none.p > 0.05


@pytest.mark.parametrize(("pole", "hold"), [(0.9, 10), (0.9, 1), (0.0, 10)])
def test_the_level_of_the_nonlinearity_test_holds_for_coloured_noise_and_held_inputs(pole, hold):
    """40 blocks without their own leverage rejected 13 % of these at the level of 5 %."""
    lags, found = ["y[k-1]", "y[k-2]", "u[k-1]"], 0
    for seed in range(60):
        rng = np.random.default_rng([seed, 31])
        u = np.repeat(rng.normal(size=1000 // hold), hold)
        e, y = lfilter([0.1], [1.0, -pole], rng.normal(size=1000)), np.zeros(1000)
        for k in range(2, 1000):
            y[k] = 1.35 * y[k - 1] - 0.48 * y[k - 2] + 0.5 * u[k - 1] + e[k]
        found += nonlinearity(pose(oa.Record.from_arrays(u=u, y=y), PHYSICS), lags, draws=499).found
    assert found <= 7  # 3 are expected; 8 or more have a probability below 1 % at 5 %


def test_of_very_many_terms_the_right_ones_are_looked_at():
    record = plant(400)
    signals = [f"y[k-{i}]" for i in range(1, 5)] + [f"u[k-{i}]" for i in range(1, 5)]
    library = TermLibrary.of(signals, 4)
    found = candidates(pose(record, PHYSICS), library)
    assert len(library) > SHORTLIST >= len(found.library) and set(found.library.texts) >= TRUE
    assert [note.code for note in found.notes] == ["terms_are_physics", "terms_shortlisted"]
    assert "y[k-1], u[k-1]" in found.notes[0].text


def test_a_term_that_is_not_finite_is_left_out():
    with np.errstate(all="ignore"):
        found = candidates(
            pose(plant(200), PHYSICS), TermLibrary.of((), 0, (), ["1/(u[k-1]-u[k-1])", "u[k-1]**2"])
        )
    assert found.library.texts == ("u[k-1]**2",) and "1/(u[k-1]-u[k-1])" in found.notes[0].text


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"collinear": -0.1}, "`collinear` must be a number, 0 or more"),
        ({"blocks": 1}, "`blocks` must be a whole number, 2 or more"),
        (
            {"learner": oa.Terms(degree=2, exclude=("u[k-9]",))},
            "`exclude` names the term 'u\\[k-9\\]'",
        ),
        ({"learner": oa.Terms(("u[k-1]",))}, "the physics expresses all candidate terms already"),
        ({"learner": oa.Function(lambda w, z: z, lambda key: ())}, "`learner` must be Terms"),
    ],
)
def test_what_cannot_be_selected_from(options, words):
    with pytest.raises(oa.InputError, match=words):
        oa.select(plant(200), PHYSICS, lags=LAGS, criterion=oa.Prediction(), **options)


def test_several_outputs_are_refused():
    record = oa.Record.from_arrays(u=np.ones(50), y=np.zeros((50, 2)))
    with pytest.raises(
        oa.InputError, match="a structure is chosen for one output; the record has 2"
    ):
        oa.select(record)


def test_stopping_keeps_the_best_so_far():
    judged = itertools.count()

    def stop(stage: str, rung: object) -> None:
        if stage == "terms" and next(judged) == 2:
            raise KeyboardInterrupt

    one = oa.select(plant(), PHYSICS, lags=LAGS, criterion=FLOWN, most=MOST, progress=stop)
    assert (
        one.stopped and len(one.terms.rungs) == 3 and "stopped" in [note.code for note in one.notes]
    )
    assert isinstance(one.learner, oa.Terms) and one.terms.chosen.score < one.terms.rungs[0].score


SLOW = {
    "y[k-1]**2": lambda y, u: y + 0.1 * (3 * u - 0.3 * y - 0.5 * y * abs(y)),
    "u[k-1]**2": lambda y, u: y + 0.1 * (u**2 - 0.4 * y),
}


@pytest.mark.parametrize("term", SLOW)
def test_a_term_of_a_slow_signal_is_of_the_lag_that_the_physics_reads(term):
    """Where one way through all lags took `y[k-3]*u[k-3]`, and picks about physics alone `u[k-1]**3`."""
    rng = np.random.default_rng(1)
    u, y = np.repeat(rng.uniform(0.2, 1.0, 41), 20)[:800], np.zeros(800)
    y[0] = 1.0
    for k in range(1, 800):
        y[k] = SLOW[term](y[k - 1], u[k - 1])
    y += 0.1 * y.std() * rng.normal(size=800)
    one = oa.select(oa.Record.from_arrays(u=u[:300], y=y[:300], sampling_time=0.1), PHYSICS, most=2)
    assert one.learner.terms == (term,) and one.shares[term] > 0.5


HEAT = oa.Baseline.from_terms(
    [oa.Term("a1", "y[k-1]"), oa.Term("b1", "u[k-1]"), oa.Term("b0", "1")]
)


def exchanger(seed: int, rows: int = 1000, noise: float = 0.02) -> oa.Record:
    """A temperature near 97, its flow slow and persistent: a saturating gain, a wall that stores heat, a drift."""
    rng = np.random.default_rng(seed)
    u = 0.4 + 0.2 * np.tanh(
        scipy.signal.lfilter([1], [1, -0.97], rng.normal(size=rows + 300))[300:] / 4
    )
    drift = scipy.signal.lfilter([0.02], [1, -0.995], rng.normal(size=rows))
    y, wall = np.zeros(rows), 0.0
    for k in range(1, rows):
        v = np.tanh(2.5 * (u[k - 1] - 0.4))
        wall += 0.05 * (v - wall)
        y[k] = y[k - 1] + 0.1 * (-8 * v * (1 + 0.3 * v) - 4 * wall + drift[k - 1] - y[k - 1])
    return oa.Record.from_arrays(u=u, y=97 + y + noise * rng.normal(size=rows))


ANY = {"halves": False, "level": 1}


def test_no_term_within_the_span_of_the_physics_is_taken():
    """All terms allowed, y[k-2] is taken, of which 0.1 % is left: it makes the interval of a1 27 times as wide."""
    loose, kept = (
        oa.select(
            exchanger(5), HEAT, criterion=oa.Prediction(), most=12, collinear=collinear, **ANY
        ).physics
        for collinear in (0.0, 0.05)
    )
    widened = [max(s.after_std / s.before_std for s in one.shifts) for one in (loose, kept)]
    assert min(loose.left.values()) < 0.01 and widened[0] > 20 > widened[1]
    assert all(left > 0.03 for left in kept.left.values()) and kept.condition < loose.condition / 10
    assert kept.excluded > 10 and loose.excluded == 0
    text = {note.code: note.text for note in kept.notes}["terms_within_span"]
    assert text.startswith(f"{kept.excluded} of 217 candidate terms lie within the span")
    assert f"condition number is {kept.condition:.3g}" in text


def test_parameters_that_the_terms_move_are_shown_before_and_after():
    one = oa.select(exchanger(1), HEAT, criterion=oa.Prediction(), most=4, halves=False)
    alone = oa.estimate(exchanger(1), HEAT, criterion=oa.Prediction(), blocks=0).parameters
    fitted = oa.estimate(
        exchanger(1), HEAT, blocks=0, standard_errors="plain", **one.options
    ).parameters
    for shift in one.physics.shifts:
        assert shift.before == pytest.approx(alone["value"][shift.parameter], rel=0.02)
        assert shift.after == pytest.approx(fitted["value"][shift.parameter], rel=0.02)
        assert shift.after_std == pytest.approx(fitted["std"][shift.parameter], rel=0.05)
    b1 = next(shift for shift in one.physics.shifts if shift.parameter == "b1")
    assert b1.moved and b1.times > 3
    text = {note.code: note.text for note in one.notes}["physics_moved"]
    assert (
        f"b1 from {b1.before:.4g} ± {b1.before_std:.2g} to {b1.after:.4g} ± {b1.after_std:.2g}"
        in text
    )


@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(seed, marks=pytest.mark.proof) for seed in (1, 2))]
)
@pytest.mark.parametrize("of", ["input", "output"])
def test_the_level_of_a_signal_is_no_delay(seed, of):
    rng = np.random.default_rng(seed)
    u = rng.normal(size=600)
    y = scipy.signal.lfilter([0, 0, 0, 1.0], [1, -0.8], u) + 0.05 * rng.normal(size=600)
    record = oa.Record.from_arrays(u=u + 5 * (of == "input"), y=y + 5 * (of == "output"))
    one = oa.select(record, learner=None, lags=oa.Lags(3, 5, 0), criterion=FLOWN)
    assert (one.orders.chosen.na, one.orders.chosen.nb, one.orders.chosen.nk) == (1, (1,), (3,))
    assert one.delays[0].fitted == 3 and one.learner.terms == ("y[k-1]", "u[k-3]", "1")


@pytest.mark.parametrize("seed", [1, 2, 5])
def test_an_input_that_acts_by_its_square_stays_a_candidate(seed):
    """No linear lag of it helps, so that the orders keep none; its functions are looked at all the same."""
    rng = np.random.default_rng(seed)
    u = rng.normal(size=600)
    y = scipy.signal.lfilter([0, 1.0], [1, -0.8], u**2)
    record = oa.Record.from_arrays(u=u, y=y + 0.05 * y.std() * rng.normal(size=600))
    one = oa.select(record, learner=oa.Terms(degree=2), criterion=FLOWN, most=4)
    assert one.nonlinearity.found and "u[k-1]" in one.nonlinearity.matter
    assert set(one.learner.terms) == {"u[k-1]**2", "y[k-1]"}
    assert one.delays[0].correlation is None and one.delays[0].square == 1
    assert one.delays[0].fitted is None and one.lags.nb[0] > 0


def test_an_input_that_the_physics_reads_may_act_by_the_square_of_another_lag():
    """The linear lag of the physics does not keep the test from the input's other lags."""
    rng = np.random.default_rng(3)
    u = rng.normal(size=600)
    y = scipy.signal.lfilter([0, 0, 0.4], [1, -0.8], u**2) + 0.02 * rng.normal(size=600)
    record, learner = oa.Record.from_arrays(u=u, y=y), oa.Terms(degree=2)
    one = oa.select(record, PHYSICS, learner=learner, criterion=FLOWN, most=3)
    assert one.nonlinearity.found and one.nonlinearity.matter == ("u[k-2]",)
    texts = {warning.code: warning.text for warning in one.notes}
    if not one.terms.chosen.size:  # picked without a block, the terms are others
        assert "Picked on all rows, u[k-2]**2 would lower it" in texts["nothing_helps"]
    else:
        assert "u[k-2]**2" in one.learner.terms


def test_what_is_far_worse_on_every_block_is_not_as_good():
    """The blocks of a model that drifts differ by more than the mean of its squares."""
    point, held = Point((), np.zeros(1), np.zeros(1)), np.array([0.6, 0.57, 9.6, 1.3, 0.6])
    alone = PathModel(point, (), held, 0.0, 0)
    better = PathModel(point, (), 0.001 * held[::-1], 0.0, 1)
    assert [one.within for one in judge_all([alone, better])] == [False, True]
    near = PathModel(point, (), np.where(held > 9, 0.6, held + 0.1), 0.0, 1)
    assert judge_all([alone, near])[0].within


def test_lags_of_the_chosen_orders_reach_the_terms():
    """Beside first-order physics, the terms of a second-order plant took y[k-3] for y[k-2], and six instead of four."""
    rng = np.random.default_rng(1)
    u = rng.normal(size=600)
    y = scipy.signal.lfilter([0, 1, 0.5], [1, -1.2, 0.6], u + 0.2 * u**2) + 0.02 * rng.normal(
        size=600
    )
    record, learner = oa.Record.from_arrays(u=u, y=y), oa.Terms(degree=2)
    one = oa.select(
        record, PHYSICS, lags=oa.Lags(3, 3, 1), learner=learner, criterion=FLOWN, most=6
    )
    assert set(one.learner.terms) == {"y[k-2]", "u[k-2]", "u[k-1]**2", "u[k-2]**2"}
    begun = [rung.change for rung in one.terms.rungs if rung.change[:1] == ("physics alone",)]
    assert "+ u[k-2]" in begun[0]


def test_a_network_is_as_wide_as_it_pays():
    one = oa.select(
        plant(300),
        PHYSICS,
        learner=oa.MLP((8,)),
        lags=LAGS,
        criterion=oa.Prediction(),
        widths=(2, 6),
    )
    assert isinstance(one.learner, oa.MLP) and one.learner.hidden[0] in (2, 6)
    learners = one.table[one.table["stage"] == "learner"]
    assert list(learners["model"])[:3] == [
        "physics alone",
        "2 neurons of all lags",
        "6 neurons of all lags",
    ]
    assert learners["score"].iloc[1:].max() < learners["score"].iloc[0]


SPEC = """# my plant
[data]
inputs = ["u"]
outputs = ["y"]
train = { files = ["run.csv"], rows = [10, 600] }

[data.tests.rest]
files = ["run.csv"]
rows = [500, 600]

[[baseline.terms]]
parameter = "a"
regressor = "y[k-1]"

[[baseline.terms]]
parameter = "b"
regressor = "u[k-1]"  # gain

[lags]
na = 2
nb = 2

[learner]
kind = "terms"
degree = 3

[selection]
terms = 4

[training]
segment = 128
washout = 20
"""


@pytest.fixture
def project(tmp_path, monkeypatch):
    record = plant()
    table = np.column_stack([record.experiments[0].inputs, record.experiments[0].outputs])
    (tmp_path / "data").mkdir()
    np.savetxt(
        tmp_path / "data" / "run.csv", table, delimiter=",", header="u,y", comments="", fmt="%.17g"
    )
    (tmp_path / "data" / "plant.toml").write_text(SPEC)
    monkeypatch.chdir(tmp_path)
    return tmp_path / "data" / "plant.toml"


def test_select_from_the_shell_leaves_a_spec_that_runs(project, tmp_path, without_figures):
    done = run("select", project, "--out", tmp_path / "out", "--json")
    assert done.code == 0, done.err
    result = finite_json(done.out)
    terms = {term["term"]: term for term in result["terms"]}
    assert {name for name, term in terms.items() if term["q"] < result["level"]} == TRUE
    assert all(term["chosen"] > 0.4 and term["rate"] <= 0.05 for term in terms.values())
    assert result["focus"] == "simulation" and not result["stopped"]
    doubted = next(
        warning["text"]
        for warning in result["warnings"]
        if warning["code"] == "terms_not_confirmed"
    )
    assert set(terms) - TRUE == {
        doubted.split(": ")[1].split(".")[0]
    }  # one that noise resembles on 293 rows
    assert (
        result["intervals"]["source"] == "split sample"
        and "293 rows" in result["intervals"]["text"]
    )
    shifts = {shift["parameter"]: shift for shift in result["physics"]}
    assert set(shifts) == {"a", "b"} and shifts["b"]["before_std"] > 0 and result["condition"] > 1
    assert all(0 < term["left"] <= 1 for term in result["terms"])
    assert result["orders"] == {"na": 1, "nb": [1], "nk": [1]} or result["orders"]["na"] >= 1
    files = {
        str(p.relative_to(tmp_path / "out")) for p in (tmp_path / "out").rglob("*") if p.is_file()
    }
    assert files == {
        "result.json",
        "spec.toml",
        "table.csv",
        "figures/selection.png",
        "manifest.json",
    }
    assert len(pd.read_csv(tmp_path / "out" / "table.csv")) == len(result["models"])
    spec = (tmp_path / "out" / "spec.toml").read_text()
    assert "# my plant" in spec and "# gain" in spec and '"../data/run.csv"' in spec
    fitted = run("fit", tmp_path / "out" / "spec.toml", "--out", tmp_path / "fit", "--json")
    assert fitted.code == 0, fitted.err
    content = finite_json(fitted.out)
    assert {term["term"] for term in content["terms"]} == set(terms) and content[
        "intervals"
    ] == result["intervals"]
    assert all(
        term["ci95"][0] < TRUE_VALUES.get(term["term"], 0.0) < term["ci95"][1]
        for term in content["terms"]
    )
    assert (
        content["equation"]["text"].startswith("y[k] = ")
        and r"y_{k} = " in content["equation"]["latex"]
    )


@pytest.mark.parametrize(
    ("p", "learner", "said"),
    [
        (0.75, {"kind": "mlp", "hidden": [1]}, "A network is chosen all the same"),
        (0.75, {"kind": "terms", "terms": ["y[k-1]"]}, ""),
        (0.75, {"kind": "terms", "terms": ["y[k-1]**2"]}, "Terms are chosen all the same"),
        (0.01, {"kind": "mlp", "hidden": [1]}, ""),
    ],
)
def test_the_page_names_the_unit_of_its_errors_and_why_a_nonlinear_learner_is_chosen(
    p, learner, said
):
    stages = (("orders", 2, 0.03), ("learner", 0, 0.6), ("learner", 6, 0.031))
    rows = [
        {"stage": stage, "model": "m", "size": size, "score": score, "chosen": size > 0}
        | {"standard_error": 0.001, "within": True, "seconds": 1.0}
        for stage, size, score in stages
    ]
    test = {"p": p, "regressors": {"y[k-1]": p}, "matter": [], "text": "nothing is found."}
    content = {"orders": {"na": 1, "nb": [1], "nk": [1]}, "nonlinearity": test, "models": rows}
    content |= {"data": {"train": []}, "delays": [], "learner": learner, "focus": "simulation"}
    content |= {"terms": None, "intervals": {"source": "none", "text": "none."}, "level": 0.05}
    content |= {"seconds": 1.0, "stopped": False, "warnings": []}
    page = " ".join(
        selection_text(SelectResult.model_validate(content), oa.Channel("y", "mm")).split()
    )
    assert "error: root mean square error of y in free runs, in mm, on blocks" in page
    assert ("all the same" in page) == bool(said) and said in page
    assert ("from 0.6 mm to 0.031 mm. Linear lags alone reach 0.03 mm" in page) == bool(said)


def test_select_of_halves_fits_the_other_rows(project, tmp_path):
    project.write_text(
        SPEC.replace("terms = 4", "terms = 4\nhalves = true").replace(
            "[training]", '[training]\nfocus = "prediction"'
        )
    )
    done = run("select", project, "--out", tmp_path / "out")
    assert done.code == 0, done.err
    assert "rows = [305, 600]" in (tmp_path / "out" / "spec.toml").read_text()
    assert (
        "physics alone" in done.out and "condition number of physics and terms together" in done.out
    )
    assert "orders" in done.out and "→" in done.out and "next: orthaug fit" in done.out


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("terms = 4", "collinear = 1.5", "'selection.collinear': found 1.5"),
        ("terms = 4", "terms = -1", "'selection.terms': found -1"),
        ("terms = 4", "term = 4", "unknown key 'selection.term', did you mean 'terms'?"),
        (
            "degree = 3",
            'degree = 3\nfunctions = ["cosh"]',
            "a library has no terms of the function 'cosh', did you mean 'cos'",
        ),
        ("degree = 3", 'terms = ["v[k-1]"]', "v"),
    ],
)
def test_specs_that_cannot_be_selected_from(project, tmp_path, old, new, words):
    project.write_text(SPEC.replace(old, new))
    done = run("select", project, "--out", tmp_path / "out")
    assert done.code == 2 and one_line(done.err, words) and not (tmp_path / "out").exists()


def test_a_motion_is_refused(tmp_path):
    (tmp_path / "run.csv").write_text("u,y\n0,0\n1,1\n")
    (tmp_path / "motion.toml").write_text(
        '[data]\ninputs = ["u"]\noutputs = ["y"]\ntrain = { files = ["run.csv"] }\n'
        '[motion.states]\nx = { derivative = "-k*x + u" }\n[motion.outputs]\ny = "x"\n'
        "[motion.parameters]\nk = { initial = 1.0 }\n"
    )
    done = run("select", tmp_path / "motion.toml", "--out", tmp_path / "out")
    assert done.code == 2 and one_line(done.err, "structure is selected for lagged signals")


def test_a_path_is_the_same_twice():
    options = {"lags": LAGS, "criterion": oa.Prediction(), "most": 3}
    one, other = (oa.select(plant(300), PHYSICS, **options) for _ in range(2))
    pd.testing.assert_frame_equal(*(found.table.drop(columns="seconds") for found in (one, other)))
    assert one.learner == other.learner and one.shares == other.shares


def test_a_fit_says_where_terms_leave_little_of_the_physics(tmp_path):
    """No name says that y[k-2] could imitate y[k-1]; on the rows of a slow plant it nearly does."""
    record = exchanger(5).experiments[0]
    table = np.column_stack([record.inputs, record.outputs])
    np.savetxt(tmp_path / "run.csv", table, delimiter=",", header="u,y", comments="", fmt="%.17g")
    spec = """
[data]
inputs = ["u"]
outputs = ["y"]
train = { files = ["run.csv"] }
[baseline]
terms = [
    { parameter = "a1", regressor = "y[k-1]" },
    { parameter = "b1", regressor = "u[k-1]" },
    { parameter = "b0", regressor = "1" },
]
[training]
focus = "prediction"
[learner]
kind = "terms"
terms = ["TERM"]
"""
    texts = []
    for name, term in (("near", "y[k-2]"), ("far", "u[k-1]**3")):
        (tmp_path / f"{name}.toml").write_text(spec.replace("TERM", term))
        done = run("check", tmp_path / f"{name}.toml", "--json")
        assert done.code == 0, done.err
        texts.append(finite_json(done.out)["shared"]["text"])
    assert "the data determine every parameter" in texts[0] and "the terms span" in texts[0]
    assert "% of the regressor of a1" in texts[0] and "the terms span" not in texts[1]
