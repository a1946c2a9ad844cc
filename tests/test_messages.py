"""The page of messages is current, and its sentences are short and free of words of our own."""

from __future__ import annotations

import ast
import re
import textwrap

import messages
import pytest

PRIVATE = re.compile(
    r"\b(told|tell|tells|flown|fly|flies|laid|lay|stands|stand|ground|no one|runs away)\b"
)  # words of our own for plain things


def test_the_page_has_every_message_of_the_source():
    written = messages.PAGE.read_text(encoding="utf-8")
    assert written == messages.page(), "run `python tests/messages.py`"


def test_no_sentence_is_too_long():
    assert not messages.long_sentences()


def test_no_message_uses_private_words():
    texts = [text for found in messages.messages().values() for _, text in found]
    assert len(texts) > 1500
    assert not [text for text in texts if PRIVATE.search(text)]


def groups(source: str) -> list[messages.Text]:
    return list(messages.texts_of(ast.parse(textwrap.dedent(source))))


def test_texts_are_grouped_by_where_they_appear():
    found = groups('''
        """A docstring is read by nobody who runs the program."""
        def f(path, rows):
            if rows:
                raise InputError(f"{path}: the file has {len(rows)} rows.")
            text = f"the record of {path.name} {'is' if rows else 'are'} short."
            warnings.append(Warning("short", text))
            text = "the same name holds another text."
            return Warning("other", text), _caused(rows), "a sentence of the report"

        def _caused(rows):
            return KeyedError("a caller raises this text")
    ''')
    assert found == [
        ("errors", "{path}: the file has {number} rows."),
        ("short", "the record of {name} {is/are} short."),
        ("other", "the same name holds another text."),
        ("reports", "a sentence of the report"),
        ("errors", "a caller raises this text"),
    ]


def test_the_help_of_commands_is_among_the_texts():
    found = groups('''
        @app.command()
        def fit(out: Annotated[Path, Option("--out", help="The folder of the result.")]):
            """Fit a spec, print a summary."""
    ''')
    assert found == [
        ("help", "The folder of the result."),
        ("help", "Fit a spec, print a summary."),
    ]


@pytest.mark.parametrize(
    ("text", "sentences"),
    [
        ("One thing. `b` another; a third", ["One thing.", "`b` another; a third"]),
        ("{number of rows} rows. Give 1.5 s.", ["{…} rows.", "Give 1.5 s."]),
    ],
)
def test_sentences_end_with_a_stop(text, sentences):
    assert messages.sentences_of(text) == sentences


@pytest.mark.parametrize("text", ["double y = a + b;", "one two three", "a <b>c</b> d"])
def test_code_and_labels_are_no_messages(text):
    assert not messages.is_message(text)
