"""What a saved model's learner has found: what `orthaug explain` does."""

from __future__ import annotations

from collections.abc import Sequence

from orthaug._base.errors import InputError
from orthaug.commands.run import ModelOnData
from orthaug.reports.explanation import ExplainResult


def explain_model(opened: ModelOnData, *, degree: int, functions: Sequence[str], most: int) -> ExplainResult:
    """The content of the explanation of a model over its data.

    Raises:
        InputError: physics alone, data without what the learner is evaluated at, too many candidates.
    """
    from orthaug.selection.explanation import explain

    try:
        explained = explain(opened.model, opened.record, degree=degree, functions=functions, most=most)
    except InputError as error:
        raise type(error)(f"{opened.source}: {error}") from None
    return ExplainResult.model_validate(explained)
