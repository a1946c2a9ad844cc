"""Forces that equations share: where they are, and what is added to them."""

from __future__ import annotations

import numpy as np
import pytest

import orthaug as oa
from orthaug.analysis.missing_term import products_of, variables_of
from orthaug.analysis.missing_terms import missing_terms
from orthaug.analysis.term_sensitivities import acting_slopes
from orthaug.physics.differences import Difference, Side
from orthaug.physics.shared_forces import SharedForce, shared_forces, with_input


def two_masses(**define: str) -> oa.Motion:
    """Return two masses with a spring and a damper, whose force an output has, too."""
    force = "F" if define else "k*(x - z) + c*(v - w)"
    return oa.Motion.from_equations(
        [
            oa.State("x", "v"),
            oa.State("v", f"(u - ({force}))/m"),
            oa.State("z", "w"),
            oa.State("w", "F/2" if define else "(k*(x - z) - (w - v)*c)/2 - g*(w - u)"),
        ],
        [oa.Output("y", "x"), oa.Output("acc", "-c*(v - w)/2 + k*(x - z)/2")],
        [oa.PhysicalParameter(name, 1.0, min=0) for name in ("m", "k", "c")],
        ["u"],
        constants={"g": 0.1},
        define=define,
    )


DAMPER = Difference(Side("v", "v", 1.0), Side("w", "w", 1.0))


def geared(**own: str) -> oa.Motion:
    """A motor that turns a load through a gear and a spring."""
    equations = {
        "v": "(u - k/N*(x/N - z))/J",
        "w": "k*(x/N - z)/m",
    } | own
    return oa.Motion.from_equations(
        [oa.State("x", "v"), oa.State("v", equations["v"]), oa.State("z", "w")]
        + [oa.State("w", equations["w"])],
        [oa.Output("motor", "x"), oa.Output("load", "z")],
        [oa.PhysicalParameter(name, 1.0, min=0) for name in ("J", "m", "k")],
        ["u"],
        constants={"N": 4.0},
    )


def test_a_force_behind_a_gear_is_one_force() -> None:
    motion = geared()
    (force,) = shared_forces(motion)
    assert str(force) == "k*(x/N - z)"
    longer = with_input(motion, force)
    x, u, p = np.array([0.3, -0.2, 0.1, 0.4]), np.array([0.5]), motion.initial
    rates = longer.rates(x, np.append(u, 0.8), p, np) - motion.rates(x, u, p, np)
    np.testing.assert_allclose(rates, [0, -0.2, 0, 0.8], atol=1e-15)
    (stretch,) = motion.differences
    np.testing.assert_array_equal(stretch.row(("x", "v", "z")), [0.25, 0, -1])


@pytest.mark.parametrize("side", ["x*N", "2*x/N", "N*2*x", "x"])
def test_ratios_of_a_gear_may_be_written_as_one_likes(side: str) -> None:
    motion = geared(v=f"(u - k*({side} - z))/J", w=f"k*({side} - z)/m")
    assert [str(force) for force in shared_forces(motion)] == [f"k*({side} - z)"]


def test_what_is_no_difference_of_two_names_is_none() -> None:
    for text in ("k*(x/J - z)", "k*(x/0 - z)", "k*(x**2 - z)", "k*(x - 2*x)", "k*(x - N)"):
        motion = geared(v=f"(u - {text})/J", w=f"{text}/m")
        assert motion.differences == () and shared_forces(motion) == ()


def test_a_difference_times_an_input_is_tried() -> None:
    """A flow carries heat by a difference of temperatures; as factors of two it is two terms."""
    motion = oa.Motion.from_equations(
        [oa.State("T", "(flow*(cold - T) - k*(T - room))/C")],
        [oa.Output("y", "T")],
        [oa.PhysicalParameter(name, 1.0, min=0) for name in ("k", "C")],
        ["flow", "cold", "room", "lamp", "sun"],
    )
    names, _ = variables_of(motion)
    found = [(names[i], names[j]) for i, j, *_ in products_of(motion)]
    others = {"(cold - T)": ("flow", "room"), "(T - room)": ("flow", "cold")}
    for difference, inputs in others.items():
        mine = [b for a, b in found if a == difference]
        assert mine == [*inputs, "lamp", "sun"]
    assert len(found) == 8  # six variables are too many for their products


def test_the_beginning_of_a_longer_sum_is_a_difference_only_without_numbers() -> None:
    assert geared(v="(u - N*v - k*x)/J", w="x/m").differences == ()
    assert [str(one) for one in geared(v="(u - v - k*x)/J", w="x/m").differences] == ["u - v"]


def test_forces_of_several_equations_are_found_either_way_round() -> None:
    assert [str(force) for force in shared_forces(two_masses())] == ["k*(x - z)", "c*(v - w)"]


def test_a_force_of_a_definition_is_that_of_all_who_use_it() -> None:
    found = shared_forces(two_masses(F="k*(x - z) + c*(v - w)"))
    assert [str(force) for force in found] == ["k*(x - z)", "c*(v - w)"]


def test_functions_have_none() -> None:
    one = [oa.PhysicalParameter("a", 1.0)]
    motion = oa.Motion.from_functions(lambda x, u, p: -x, lambda x, u, p: x, ["x"], ["y"], one)
    assert shared_forces(motion) == ()


def test_what_is_added_acts_in_every_equation() -> None:
    motion = two_masses()
    force = SharedForce("c", DAMPER)
    longer = with_input(motion, force)
    x, u, p = np.array([0.3, -0.2, 0.1, 0.4]), np.array([0.5]), motion.initial
    added = np.append(u, 0.7)
    rates = longer.rates(x, added, p, np) - motion.rates(x, u, p, np)
    np.testing.assert_allclose(rates, [0, -0.7, 0, 0.35], atol=1e-15)
    outputs = longer.observed(x, added, p, np) - motion.observed(x, u, p, np)
    np.testing.assert_allclose(outputs, [0, -0.35], atol=1e-15)
    number = 4 + 2 + 1 + 1  # behind states, outputs, inputs and the spring
    slopes = acting_slopes(motion, np.append(x, u)[None], p, number)
    np.testing.assert_allclose(slopes, [[0, -1, 0, 0.5, 0, -0.5]], rtol=1e-8, atol=1e-12)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("k*(v - w)", "k*(v - w)"),
        ("2*c*(v - w)", "(2*c*(v - w) + 2*(h))"),
        ("c/N*(v - w) - u", "(c/N*(v - w) + (h)/N) - u"),
        ("c*N/(2*N)*(w - v)", "(c*N/(2*N)*(w - v) - N*(h)/(2*N))"),
        ("m*c*(v - w)", "m*c*(v - w)"),  # a parameter more is another force
        ("c*(v/N - w)", "c*(v/N - w)"),
        ("a  +  c *( w-v )", "a + (c *( w-v ) - h)"),
        ("(v - w)*c/ä", "((v - w)*c + h)/ä"),
        ("ä*x - c*(v - w)", "ä*x - (c*(v - w) + h)"),
    ],
)
def test_a_force_is_changed_where_it_is(text: str, expected: str) -> None:
    assert SharedForce("c", DAMPER).with_added(text, "h", {"N": 3.0}) == expected


def test_a_damper_that_grows_with_its_speed_is_one_missing_term() -> None:
    """Two masses of 1 and 2 kg on a spring and a damper; a fit knows the damper's linear part."""
    rng = np.random.default_rng(0)
    push, x, rows = np.repeat(rng.normal(scale=15.0, size=60), 10), np.zeros(4), []

    def rates(x: np.ndarray, u: float) -> np.ndarray:
        speed = x[1] - x[3]
        force = 8 * (x[0] - x[2]) + 0.3 * speed + 0.5 * speed * abs(speed)
        return np.array([x[1], u - force - x[0], x[3], (force - x[2]) / 2])

    for u in push:
        rows.append([x[0], x[2]])
        for _ in range(10):
            middle = x + 2.5e-3 * rates(x, u)
            x = x + 5e-3 * rates(middle, u)
    y = np.array(rows)
    y += 0.001 * y.std(axis=0) * rng.normal(size=y.shape)
    motion = oa.Motion.from_equations(
        [
            oa.State("x", "v", "x"),
            oa.State("v", "u - k*(x - z) - c*(v - w) - x"),
            oa.State("z", "w", "z"),
            oa.State("w", "(k*(x - z) + c*(v - w) - z)/2"),
        ],
        [oa.Output("x", "x"), oa.Output("z", "z")],
        [oa.PhysicalParameter("k", 6.0, min=0), oa.PhysicalParameter("c", 0.5, min=0)],
        ["u"],
    )
    record = oa.Record.from_arrays(push, y, sampling_time=0.05, inputs=["u"], outputs=["x", "z"])
    found = missing_terms(oa.estimate(record, motion, learner=None, blocks=0))
    assert found is not None and found.p < 1e-6
    best = found.terms[0]
    assert (best.beside, best.variable, best.shape) == ("c*(v - w)", "(v - w)", "drag")
    assert 0.25 < best.coefficient < 0.75  # one step, from a linear part that holds some of it
    assert "beside the term c*(v - w) acts something odd in (v - w)" in str(best)
