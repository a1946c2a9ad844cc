"""Messages are one line: what was asked is shown visibly and cut where it is long, whoever writes the message."""

from __future__ import annotations

import pickle
import time
from pathlib import Path

import numpy as np
import pytest

from orthaug import Channel, InputError, TrainingError, read_record
from orthaug._base.checks import check_choice, check_count, check_label, check_number, check_type
from orthaug._base.errors import LONGEST, KeyedError, show

ROUGH = "a\nb\r\x1b[31mred\x07\x00\u202e\ud800end"


@pytest.mark.parametrize(
    "kind", [InputError, TrainingError, lambda text: KeyedError(text, "key", "words")]
)
def test_a_message_is_one_visible_line(kind):
    text = str(kind(f"{ROUGH}: wrong."))
    assert text.isprintable() and text.startswith(
        r"a\nb\r\x1b[31mred\x07\x00\u202e\ud800end: wrong"
    )


def test_names_and_values_are_cut_and_the_remedy_stays():
    for name in ("x" * 10**6, "x y " * 10**5, "'" * 10**5, "x" * 61):
        for text in (
            f"no column '{name}'; the file has 'u'.",
            f"`{name}` is wrong; the file has 'u'.",
            f"a [{name}] 'u'.",
        ):
            said = str(InputError(text))
            assert len(said) <= 1210 and said.endswith("'u'."), said[-40:]
    assert str(InputError(f"no '{'x' * 61}' there")) == f"no '{'x' * 59}…' there"
    assert str(InputError(f"no '{'x' * 60}' there")) == f"no '{'x' * 60}' there"
    assert str(InputError("the learner's " + "long word " * 10 + "plants'")).endswith("plants'")


def test_a_path_is_whole_unless_a_name_in_it_is_too_long():
    path = "/home/someone/" + "folder/" * 30 + "run.csv"
    assert str(InputError(f"{path}: no such file.")) == f"{path}: no such file."
    assert (
        str(InputError(f"/tmp/{'n' * 200}.csv: no such file.")) == f"/tmp/{'n' * 59}… no such file."
    )


def test_messages_are_quick_whatever_they_hold():
    began = time.process_time()
    for text in ("'a" * 500_000, "[" * 10**6, "`" * 10**6, "' '" * 300_000):
        assert len(str(InputError(text))) <= 1210
    assert time.process_time() - began < 5


def test_a_message_in_a_message_is_escaped_once():
    inner = InputError(f"'{ROUGH}'")
    assert str(InputError(f"spec.toml: {inner}")) == f"spec.toml: {inner}"
    assert str(pickle.loads(pickle.dumps(inner))) == str(inner)


class Rude:
    def __repr__(self) -> str:
        raise RuntimeError("no")


VALUES = {
    "huge": 10**5000,
    "rude": Rude(),
    "array": np.zeros((300, 300)),
    "list": [1] * 10**6,
    "text": "x" * 10**6,
}


@pytest.mark.parametrize("value", VALUES.values(), ids=VALUES.keys())
def test_values_are_shown_on_one_line(value):
    assert len(show(value)) <= LONGEST and show(value).isprintable()
    for check in (
        lambda: check_number(value, "x"),
        lambda: check_count(value if not isinstance(value, int) else -value, "x"),
        lambda: check_choice(value, ("a", "b"), "x"),
        lambda: check_label(value if isinstance(value, str) else 3, "x"),
        lambda: check_type(value, Path, "x", "a path"),
    ):
        with pytest.raises(InputError) as refused:
            check()
        assert len(str(refused.value)) < 250


def test_a_file_whose_name_is_no_line(tmp_path):
    with pytest.raises(InputError, match=r"a\\nb\\x1b.csv: no such file"):
        read_record(tmp_path / "a\nb\x1b.csv", outputs=["y"])
    path = tmp_path / "a\nb.csv"
    path.write_text("y\n1\nx\n")
    with pytest.raises(InputError, match=r"a\\nb.csv: line 3"):
        read_record(path, outputs=["y"])
    assert read_record(path, outputs=["y"], rows=[0, 1]).experiments[0].where(0).isprintable()


@pytest.mark.parametrize("unit", ["m\ns", "\x1b[31m", "m" * 61, 3, None])
def test_units_are_visible_and_short(unit):
    with pytest.raises(InputError, match="the unit of 'y' must be visible characters on one line"):
        Channel("y", unit)
