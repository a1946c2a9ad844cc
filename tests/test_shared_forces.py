"""Forces that equations share: where they are, and what is added to them."""

from __future__ import annotations

import numpy as np
import pytest

import orthaug as oa
from orthaug.analysis.term_sensitivities import acting_slopes
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
    force = SharedForce("c", "v", "w")
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
        ("2*c*(v - w)", "2*c*(v - w)"),  # a product with more in it
        ("a  +  c *( w-v )", "a + (c *( w-v ) - h)"),
        ("(v - w)*c/ä", "((v - w)*c + h)/ä"),
        ("ä*x - c*(v - w)", "ä*x - (c*(v - w) + h)"),
    ],
)
def test_a_force_is_changed_where_it_is(text: str, expected: str) -> None:
    assert SharedForce("c", "v", "w").with_added(text, "h") == expected
