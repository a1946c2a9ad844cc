"""The script that compares two results sees what must not change, and nothing else."""

from __future__ import annotations

import json

import pytest
from compare_results import main

RESULT = {
    "schema": 1,
    "status": {"code": "converged", "seconds": 1.0, "loss": 0.5},
    "parameters": [{"name": "a", "value": 2.0, "std": None}],
    "orthogonality_defect": 1e-16,
    "worst": {"row": 3, "where": "/tmp/one/run.csv: line 5"},
    "text": "at experiment 0, /tmp/one/run.csv: line 5",
    "warnings": ["the model of a/b.csv is poor"],
}


def compared(tmp_path, **changes) -> int:
    for name, content in (("before", RESULT), ("after", RESULT | changes)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "result.json").write_text(json.dumps(content))
    return main(str(tmp_path / "before"), str(tmp_path / "after"))


UNCHANGED = [
    {},
    {"schema": 2, "status": RESULT["status"] | {"seconds": 9.0, "loss": 0.5 * (1 + 1e-10)}},
    {
        "orthogonality_defect": 3e-14,
        "warnings": [{"code": "poor", "text": "the model of b.csv is poor"}],
    },
    {"text": "at experiment 0, run.csv: line 5", "worst": {"row": 3, "where": "run.csv: line 5"}},
]


@pytest.mark.parametrize("changes", UNCHANGED)
def test_what_may_change(tmp_path, capsys, changes):
    assert compared(tmp_path, **changes) == 0
    assert capsys.readouterr().out == "equal\n"


CHANGED = [
    ({"status": RESULT["status"] | {"loss": 0.5 * (1 + 1e-8)}}, "status.loss: 0.5, then"),
    ({"parameters": []}, "parameters: 1 entries, then 0"),
    (
        {"parameters": [{"name": "a", "value": 2.0, "std": 0.0}]},
        "parameters[0].std: None, then 0.0",
    ),
    ({"parameters": [{"name": "a", "value": 2.0}]}, "parameters[0].std: None, then absent"),
    ({"text": "at experiment 0, run.csv: line 6"}, "text: "),
    ({"warnings": [{"code": "poor", "text": "the model is good"}]}, "warnings[0]: "),
    ({"orthogonality_defect": 1e-9}, "orthogonality_defect: "),
]


@pytest.mark.parametrize(("changes", "words"), CHANGED)
def test_what_must_not_change(tmp_path, capsys, changes, words):
    assert compared(tmp_path, **changes) == 1
    assert capsys.readouterr().out.startswith(words)
