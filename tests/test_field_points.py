"""The points of a measure along a fitted motion, and how they move."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

import orthaug as oa
from orthaug.fitting.field_points import wobble
from orthaug.inference.splitting import rest_of


def test_the_points_of_the_training_measure_move_with_the_unknowns_as_differences_say():
    """Σ φ_qx dx/d(c, w) against central differences of Σ φ_q over runs of other unknowns."""
    rng = np.random.default_rng(3)
    u, x = np.repeat(rng.uniform(-2, 2, 15), 8), [0.5]
    for value in u[:-1]:
        x.append(x[-1] + 0.1 * (-x[-1] - np.tanh(2 * x[-1]) + value))
    y = np.array(x) + 0.02 * rng.normal(size=len(u))
    motion = oa.Motion.from_equations(
        [oa.State("x", "-a*x + b*u", "y", learned=True)],
        [oa.Output("y", "x")],
        [oa.PhysicalParameter("a", 1.5), oa.PhysicalParameter("b", 1.0)],
        ["u"],
        substeps=3,
    )
    fit = oa.estimate(
        oa.Record.from_arrays(u=u, y=y, sampling_time=0.1),
        motion,
        learner=oa.MLP((2,)),
        criterion=oa.Simulation(segment=37, washout=5),
        blocks=0,
    )
    segmented, numbers = fit.segmented, fit.model.numbers.unsplit.free
    form, segments, states = segmented.dynamics, segmented.segments, np.asarray(fit.states)
    c, w, q, size = (np.asarray(a) for a in (numbers.c, numbers.weights, fit.theta, np.ones(1)))

    step = jax.jit(lambda numbers, x, row: form.step(numbers, x, row)[0])
    inputs_at = jax.jit(lambda x, row: form.inputs_at(numbers, x, row))

    @jax.jit
    def slope_of_half(x, u):
        def half(q):
            return 0.5 * jnp.sum(rest_of(form, numbers, q, c, w, x, u, size) ** 2)

        return jax.grad(half)(q)

    def total(unknowns):
        changed = segmented.numbers(unknowns[: len(c)], unknowns[len(c) :])
        found = np.zeros(len(q))
        for start, inputs, scored in zip(states, segments.inputs, segments.scored, strict=True):
            for lane in range(start.shape[-1]):
                x = start[:, lane]
                for row, there in zip(inputs[..., lane], np.asarray(scored)[:, lane], strict=True):
                    if there:
                        found += slope_of_half(x, inputs_at(x, row))
                    x = step(changed, x, row)
        return found / segments.count

    still = np.zeros((len(states), states.shape[-1], states.shape[1], form.unknowns))
    own = wobble(form, numbers, segments, states, still, size, q)
    at, small = np.concatenate([c, w]), 1e-5
    for place in range(len(at)):
        moved = small * np.eye(len(at))[place]
        expected = (total(at + moved) - total(at - moved)) / (2 * small)
        np.testing.assert_allclose(own[:, place], expected, rtol=1e-5, atol=1e-8)
