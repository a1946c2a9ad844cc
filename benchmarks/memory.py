"""Peak memory of a whole fit of 2·10⁶ rows, 6 regressors and 257 weights (a dense Jacobian would hold 4.1 GB).

The fit runs in a process of its own, so that the peak is its own. Run: python benchmarks/memory.py
"""

from __future__ import annotations

import subprocess
import sys

from machine import describe

ROWS, ALLOWED = 2_000_000, 1.2

FIT = f"""
import resource, time
import numpy as np
import scipy.signal
import orthaug as oa
rng = np.random.default_rng(0)
u = rng.normal(size={ROWS})
y = scipy.signal.lfilter([0, 1.0], [1, -0.5, 0.3], u + 0.3 * np.tanh(2 * u)) + 0.1 * rng.normal(size=len(u))
record = oa.Record.from_arrays(u, y)
del u, y
baseline = oa.Baseline.from_terms([oa.Term(n, e) for n, e in (("a1", "y[k-1]"), ("a2", "y[k-2]"), ("b1", "u[k-1]"))])
began = time.perf_counter()
fit = oa.estimate(record, baseline, lags=oa.Lags(na=3, nb=3, nk=1), learner=oa.MLP((32,)),
                  solver=oa.LevenbergMarquardt(iterations=3), regularization="none")
assert fit.model.form.bound.size == 257 and fit.status.iterations == 3
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
print(f"{{peak / 1e9:.3f}} {{time.perf_counter() - began:.1f}}")
"""


def main() -> None:
    print(describe())
    done = subprocess.run([sys.executable, "-c", FIT], capture_output=True, text=True, check=True)
    peak, seconds = done.stdout.split()
    print(
        "| rows | regressors | weights | peak | allowed | seconds, 3 iterations "
        "|\n|---|---|---|---|---|---|"
    )
    print(f"| {ROWS} | 6 | 257 | {peak} GB | {ALLOWED} GB | {seconds} |")


if __name__ == "__main__":
    main()
