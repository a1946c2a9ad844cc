"""A small seeded part of the fuzz trials; benchmarks/fuzz.py runs them all."""

from __future__ import annotations

import time
from collections import Counter

import pytest
from fuzzing import SPEC, TYPES, model_files, try_file, try_model, try_spec, write_original

LONGEST = 10.0  # s of one trial


def judged(trial, seeds: range) -> Counter:
    """How the trials end; every fault is told with its seed."""
    ends: Counter = Counter()
    faults = []
    for seed in seeds:
        began = time.monotonic()
        end = trial(seed)
        if time.monotonic() - began > LONGEST:
            end = "hangs"
        ends[end] += 1
        if end not in ("refused", "equal"):
            faults.append((seed, end))
    assert faults == []
    return ends


@pytest.mark.parametrize("kind", TYPES)
def test_data_files(tmp_path, kind):
    if kind in ("xlsx", "parquet", "v73.mat", "h5"):
        pytest.importorskip({"xlsx": "openpyxl", "parquet": "pyarrow"}.get(kind, "h5py"))
    write_original(kind, original := tmp_path / f"original.{kind}")
    content = original.read_bytes()
    assert judged(lambda seed: try_file(kind, seed, content, tmp_path), range(40))["refused"] > 5


def test_specs(tmp_path):
    write_original("csv", tmp_path / "run.csv")
    ends = judged(lambda seed: try_spec(seed, SPEC, tmp_path), range(60))
    assert ends["refused"] > 20 and ends["equal"] > 5


def test_saved_models(tmp_path):
    content = model_files(tmp_path / "model")
    assert judged(lambda seed: try_model(seed, content, tmp_path / "model"), range(60))["refused"] > 40


def test_an_hdf5_file_whose_visit_never_ends(tmp_path):
    pytest.importorskip("h5py")
    write_original("h5", original := tmp_path / "original.h5")
    assert try_file("h5", 5487, original.read_bytes(), tmp_path) == "refused"


@pytest.mark.parametrize("seed", [453, 952, 969, 1471, 1680])
def test_matlab_files_on_which_scipy_ends_the_process(tmp_path, seed):
    write_original("v5.mat", original := tmp_path / "original.mat")
    assert try_file("v5.mat", seed, original.read_bytes(), tmp_path) == "refused"
