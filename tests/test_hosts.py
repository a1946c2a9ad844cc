"""A run over several hosts: what the environment must say, and the order of what their devices share."""

from __future__ import annotations

import pytest

import orthaug as oa
from orthaug.models import hosts


def test_alone_there_is_nothing_to_join():
    hosts.join({})
    assert not hosts.several() and hosts.waits() is None


@pytest.mark.parametrize(
    ("environment", "told"),
    [
        ({"ORTHAUG_PROCESSES": "two"}, r"ORTHAUG_PROCESSES: found 'two'; expected a whole number"),
        ({"ORTHAUG_PROCESS": "-1"}, r"ORTHAUG_PROCESS: found '-1'; expected a whole number"),
        (
            {"ORTHAUG_PROCESS": "1"},
            r"ORTHAUG_COORDINATOR=127.0.0.1:9: no first process answers there",
        ),
    ],
)
def test_what_is_wrong_with_the_environment_is_reported(monkeypatch, environment, told):
    monkeypatch.setattr(hosts, "_PATIENCE", 0.1)
    with pytest.raises(oa.InputError, match=told):
        hosts.join({"ORTHAUG_COORDINATOR": "127.0.0.1:9"} | environment)


def test_programs_that_share_devices_run_one_after_another():
    running, heard = [], []

    def one(given, item, tell):
        running.append(item)
        tell(given)
        assert len(running) == 1
        return running.pop()

    assert list(
        oa.Devices().map(one, "shared", [3, 1, 2], lambda i, what: heard.append((i, what)))
    ) == [3, 1, 2]
    assert heard == [(0, "shared"), (1, "shared"), (2, "shared")]
