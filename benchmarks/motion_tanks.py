"""Cascaded tanks as equations of motion, from ten starts: test error of the free run, and what the parameters become.

By the spec in examples/, and with the upper rim as one more parameter: the upper level was not measured, so its scale
is then told by nothing but the width of the spill's edge and the prior of the weights.
The set is read from ORTHAUG_DATA (default ../shared/data beside the project).
Run: python benchmarks/motion_tanks.py [starts]
"""

from __future__ import annotations

import sys
from dataclasses import replace
from functools import cache

import numpy as np
from machine import describe
from measured_sets import job

import orthaug as oa
from orthaug import MotionEstimate
from orthaug.fitting.estimation import fit

RIM = "h1"
STARTS = 10


@cache
def fits(free_rim: bool, starts: int) -> list[MotionEstimate]:
    """The spec's fit from each start; none where the data are absent."""
    opened = job("cascaded_tanks_motion")
    if opened is None:
        return []
    spec, problem = opened.spec, opened.problem
    if free_rim:
        motion = problem.motion
        rim = oa.PhysicalParameter(RIM, dict(motion.constants)[RIM], "V", min=0)
        constants = tuple(pair for pair in motion.constants if pair[0] != RIM)
        problem = replace(
            problem,
            motion=replace(motion, parameters=(*motion.parameters, rim), constants=constants),
        )
    options = {"learner": spec.declared_learner(), "criterion": spec.declared_criterion()}
    options |= {"solver": spec.declared_solver(), "blocks": 0, "fallback": False}
    return [fit(problem, seed=seed, **options) for seed in range(starts)]


def test_errors(free_rim: bool = False, starts: int = STARTS) -> list[float]:
    """RMSE of the free run on the official test, V."""
    opened = job("cascaded_tanks_motion")
    if opened is None:
        return []
    (test,) = opened.tests
    found = fits(free_rim, starts)
    return [float(fit.model.simulate(test.record).scores(test.skip).rmse[0]) for fit in found]


def summary() -> list[float | None]:
    """Median and largest test error by the spec, then with the rim free."""
    found = [test_errors(free) for free in (False, True)]
    return [None if not one else float(part(one)) for one in found for part in (np.median, max)]


def main(starts: int) -> None:
    print(describe())
    for free, what in ((False, "rim a constant"), (True, "rim a parameter")):
        errors = test_errors(free, starts)
        if not errors:
            sys.exit("The data are absent.")
        print(
            f"\n{what}: median {np.median(errors):.3f} V, largest {max(errors):.3f} V of "
            f"{starts} starts"
        )
        print("test errors:", ", ".join(f"{error:.3f}" for error in errors))
        found = fits(free, starts)
        for i, name in enumerate(found[0].problem.motion.names):
            values = [fit.values[i] for fit in found]
            std = [np.nan if fit.std is None else fit.std[i] for fit in found]
            missing = int(np.isnan(std).sum())
            error = f"{np.nanmedian(std):.2g}" if missing < starts else "none"
            print(
                f"  {name:5} {min(values):9.4g} to {max(values):9.4g}, median standard error "
                f"{error}, without {missing}"
            )


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else STARTS)
