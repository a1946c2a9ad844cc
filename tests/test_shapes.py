"""The shapes in the annotations, checked at run time through whole fits (in a process of its own)."""

import subprocess
import sys

import pytest

PROGRAM = """
from jaxtyping import install_import_hook

with install_import_hook("orthaug", "beartype.beartype"):
    import numpy as np
    import orthaug as oa

    rng = np.random.default_rng(0)
    u = rng.normal(size=(300, 2))
    y = np.zeros((300, 2))
    for k in range(2, 300):
        y[k] = 0.5 * y[k - 1] - 0.2 * y[k - 2, ::-1] + u[k - 1] + 0.1 * np.tanh(u[k]) + 0.01 * rng.normal(size=2)
    one = oa.Record.from_arrays(u[:, 0], y[:, 0], inputs=["u1"], outputs=["y1"])
    two = oa.Record.from_arrays(u, y)
    terms = [oa.Term("a", "y1[k-1]", output="y1"), oa.Term("b", "u1[k-1]", output="y1")]
    shared = [*terms, oa.Term("a", "y2[k-1]", output="y2")]
    for record, physics, learner in ((one, terms, None), (two, shared, oa.MLP((3,)))):
        fit = oa.estimate(record, oa.Baseline.from_terms(physics), lags=oa.Lags(2, 2, 0), learner=learner,
                          solver=oa.LevenbergMarquardt(5), regularization="evidence", structure=oa.Orthogonal())
        fit.summary(), fit.parameters
        fit.model.simulate(record).scores(), fit.model.predict(record, horizon=3).scores()
print("shapes hold")
"""


@pytest.mark.proof
def test_shapes_of_whole_fits():
    pytest.importorskip("beartype")
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=False
    )
    assert done.stdout.strip() == "shapes hold", done.stderr[-3000:]
