"""The paper's figures and tables, one file each: what is run, drawn, and compared with the published numbers."""

from __future__ import annotations

from typing import Any

from orthaug.studies.entry import Reproduction


def catalogue() -> dict[str, Reproduction]:
    """All of them, in the paper's order."""
    from orthaug.studies import (
        consistency,
        covariance,
        coverage,
        data_length,
        regularization_weight,
        solver_times,
        static_errors,
        static_noise,
    )

    modules: list[Any] = [
        static_errors,
        data_length,
        static_noise,
        covariance,
        consistency,
        regularization_weight,
        coverage,
        solver_times,
    ]
    return {module.REPRODUCTION.name: module.REPRODUCTION for module in modules}
