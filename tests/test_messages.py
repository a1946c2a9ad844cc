"""The page of messages is current, and its sentences are said as an engineer would say them."""

from __future__ import annotations

import re

import messages

PRIVATE = re.compile(r"\b(told|tell|tells|flown|fly|flies|laid|lay|stands|stand|ground)\b")  # words of our own for plain things


def test_the_page_has_every_message_of_the_source():
    assert messages.PAGE.read_text(encoding="utf-8") == messages.page(), "run `python tests/messages.py`"


def test_no_sentence_is_too_long():
    assert not messages.long_sentences()


def test_no_message_uses_private_words():
    assert not [text for texts in messages.messages().values() for text in texts if PRIVATE.search(text)]


def test_what_is_a_message():
    assert list(messages.texts_of(messages.ast.parse('def f():\n    "A docstring of some words."\n    g(f"the file {p} has no rows")'))) == [
        "the file {…} has no rows"
    ]
    assert messages.sentences_of("One thing. `b` another; a third") == ["One thing.", "`b` another;", "a third"]
    assert not messages.is_message("for (int i = 0; i < n; i++)")
