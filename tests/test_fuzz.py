"""A small seeded part of the fuzz trials; benchmarks/fuzz.py runs them all."""

from __future__ import annotations

import time
from collections import Counter

import pytest
from fuzzing import SPEC, TYPES, model_files, try_file, try_model, try_spec, write_original
from fuzzing_bytes import TARGETS
from fuzzing_runs import model_of, try_command, try_export, try_folder, try_forged, try_state

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
    assert (
        judged(lambda seed: try_model(seed, content, tmp_path / "model"), range(60))["refused"] > 40
    )


def test_forged_models(tmp_path):
    content, _ = model_of(tmp_path / "model")
    assert (
        judged(lambda seed: try_forged(seed, content, tmp_path / "model"), range(15))["refused"] > 5
    )


def test_commands(tmp_path):
    write_original("csv", tmp_path / "run.csv")
    (tmp_path / "spec.toml").write_text(SPEC)
    assert judged(lambda seed: try_command(seed, tmp_path), range(30))["refused"] > 20


def test_states_of_training(tmp_path):
    assert judged(lambda seed: try_state(seed, tmp_path), range(30)) == {"equal": 3, "refused": 27}


def test_folders(tmp_path):
    ends = judged(lambda seed: try_folder(seed, tmp_path), range(40))
    assert ends["refused"] > 15 and ends["equal"] > 3


def test_exports(tmp_path):
    _, model = model_of(tmp_path / "model")
    assert judged(lambda seed: try_export(seed, model, tmp_path), range(12))["equal"] > 2


@pytest.mark.parametrize(
    "data", [b"", b"x", b"\xff\xfe", b"(" * 4000, b"{}", b'{"kind": "motion"}', b"\x02PK\x03\x04"]
)
@pytest.mark.parametrize("target", TARGETS)
def test_entry_points_of_a_guided_fuzzer_raise_nothing(target, data):
    TARGETS[target](data)


def test_an_hdf5_file_whose_visit_never_ends(tmp_path):
    pytest.importorskip("h5py")
    write_original("h5", original := tmp_path / "original.h5")
    assert try_file("h5", 5487, original.read_bytes(), tmp_path) == "refused"


@pytest.mark.parametrize("seed", [453, 952, 969, 1471, 1680])
def test_matlab_files_on_which_scipy_ends_the_process(tmp_path, seed):
    write_original("v5.mat", original := tmp_path / "original.mat")
    assert try_file("v5.mat", seed, original.read_bytes(), tmp_path) == "refused"
