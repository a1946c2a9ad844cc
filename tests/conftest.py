"""Settings of the whole suite: hypothesis draws the same examples on every run, and nothing is timed."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

settings.register_profile(
    "orthaug",
    derandomize=True,
    database=None,
    deadline=None,
    max_examples=60,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile("orthaug")


@pytest.fixture(scope="session")
def data_folder() -> Path:
    """The measured data sets; the test is skipped where they are absent."""
    default = Path(__file__).resolve().parents[2] / "shared" / "data"
    folder = Path(os.environ.get("ORTHAUG_DATA", default))
    if not folder.is_dir():
        pytest.skip(f"no data sets in {folder}; set ORTHAUG_DATA to their folder")
    return folder
