"""What does not fit into memory is refused before it is allocated."""

from __future__ import annotations

import subprocess
import sys

import pytest

from orthaug import InputError
from orthaug._base import memory


def test_there_is_some_memory_but_not_everything():
    assert 1e6 < memory.available() < 1e18


def test_what_does_not_fit_is_refused(monkeypatch):
    monkeypatch.setattr(memory, "available", lambda: 3 * 2**30)
    memory.check_memory(3 * 2**30, "this")
    with pytest.raises(InputError, match=r"this would take 4 GiB of memory; 3 GiB are available\."):
        memory.check_memory(4 * 2**30, "this")


@pytest.mark.parametrize(
    ("size", "words"), [(0, "0 bytes"), (1536, "1.5 KiB"), (8e30, "7.11e+15 PiB")]
)
def test_sizes_in_words(size, words):
    assert memory.in_words(size) == words


def test_a_limit_on_the_process_counts():
    program = (
        "import resource; from orthaug._base.memory import available; before = available()\n"
        "resource.setrlimit(resource.RLIMIT_AS, (2**31, 2**31)); print(available() < 2**31)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=True
    )
    assert done.stdout.strip() == "True"
