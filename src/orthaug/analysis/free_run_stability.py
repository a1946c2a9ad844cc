"""Stability of a free run: all checks of boundedness and contraction together, with their report.

They are evidence from sampled points, no proof, but for the last: beyond the training a held
correction is bounded, and stable linear physics keeps it so (`beyond_training`). Two of them look
at A_k, the derivative of a step by the state: its spectral radius at every step (`feedback`), and a
quadratic norm in which all sampled A_k contract (`contraction`). A third runs the model on larger
and larger inputs (`boundedness`). The paper's `cond:pred_stab` is another matter: it asks for the
one-step predictor, whose past is measured (`lipschitz`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

from orthaug._base.checks import Matrix
from orthaug._base.errors import Warning
from orthaug._base.lines import percent
from orthaug.analysis.beyond_training import describe_beyond, radius_beyond
from orthaug.analysis.boundedness import Divergence, describe_divergence, find_divergence
from orthaug.analysis.contraction import Contraction, contraction
from orthaug.analysis.feedback import Feedback, feedback
from orthaug.analysis.lipschitz import Lipschitz, lipschitz
from orthaug.data.record import Record
from orthaug.models.model import HoldsModel, Model, model_of
from orthaug.models.response import Response


@dataclass(frozen=True, eq=False)
class Stability:
    """Evidence on the free run (None without a state).

    `diverges_at` is searched up to the factor `searched`.

    `lipschitz` is None for a model that does not predict from lagged signals. `radius_beyond` is
    the spectral radius of what goes on far beyond the training (`beyond_training`), None where that
    is not one linear system.
    """

    feedback: Feedback | None
    contraction: Contraction | None
    diverges_at: float | None
    searched: float
    lipschitz: Lipschitz | None
    warnings: tuple[Warning, ...]
    text: str
    radius_beyond: float | None = None


def stability(
    model: Model | HoldsModel,
    record: Record,
    *,
    response: Response | None = None,
    x: Matrix | None = None,
    box: int = 0,
    largest: float = 1024.0,
) -> Stability:
    """Return all checks of a model on a record, with a text that says what they mean.

    Args:
        model: a lagged model; of a fit its model.
        record: measured data.
        response: the model's free run of the record, if it is there already.
        x: the record's usable regressors (N, nx) in the model's layout, if they are stacked
            already.
        box, largest: as in `contraction` and `find_divergence`.

    Raises:
        InputError: no model; as the single checks.

    Examples:
        >>> import orthaug as oa
        >>> u = [1.0, 2.0, 0.0, 3.0, 1.0, 0.0]
        >>> y = [0.0, 0.5, 1.25, 0.625, 1.8125, 1.40625]  # 0.5 (y[k-1] + u[k-1])
        >>> record = oa.Record.from_arrays(u=u, y=y)
        >>> physics = oa.Baseline.from_terms([oa.Term("a", "y[k-1]"), oa.Term("b", "u[k-1]")])
        >>> found = stability(oa.estimate(record, physics, learner=None).model, record)
        >>> print(found.diverges_at, round(found.contraction.rate, 6))
        None 0.5
    """
    model = model_of(model)
    gradients, run = lipschitz(model, record, x=x), feedback(model, record, response=response)
    contracts = contraction(model, record, box=box, along=run)
    divergence = find_divergence(model, record, largest)
    radius = None if run is None else radius_beyond(model, run.points.states, run.points.inputs)
    factor, searched = divergence.factor, divergence.searched
    checks = Stability(run, contracts, factor, searched, gradients, (), "", radius)
    says = list(_sentences(checks, divergence, bool(model.inputs)))
    says += [(sentence, "") for sentence in (describe_beyond(model, radius),) if sentence]
    warnings = tuple(Warning(code, sentence) for sentence, code in says if code)
    return replace(checks, warnings=warnings, text="\n".join(sentence for sentence, _ in says))


def _sentences(
    checks: Stability, divergence: Divergence, driven: bool
) -> Iterator[tuple[str, str]]:
    """Yield what the checks say, sentence by sentence; with the code of a warning, or nothing."""
    run, contracts = checks.feedback, checks.contraction
    if checks.lipschitz:
        steepest = checks.lipschitz.gradient
        gradient = "without bound" if steepest is None else f"by up to {steepest:.4g} times as much"
        yield (
            f"On measured rows a change of past values moves the one-step prediction {gradient}; "
            "the free run is judged apart from that.",
            "",
        )
    if run is None:
        yield (
            "The model uses no past outputs: its free run cannot diverge, and does not depend "
            "on its start.",
            "",
        )
        return
    if run.diverged:
        yield (
            f"The free run diverges ({'; '.join(run.diverged)}); the checks end there.",
            "free_run_diverges",
        )
    if run.share_above_one is not None:
        above = (
            f"above 1 at {percent(run.share_above_one, 3)} of {len(run.radius)} steps of the "
            "free run"
        )
        peak = f"median {run.median:.4g}, largest {run.largest:.4g} at {run.worst}"
        warns = "spectral_radius_above_one" if run.share_above_one > 0.01 else ""
        yield f"The local spectral radius is {above}; {peak}.", warns
    if run.skipped:
        text = (
            f"At {run.skipped} points more the model has no finite derivative; they are left out."
        )
        yield text, "derivative_not_finite"
    if contracts is None:
        text = (
            "Contraction could not be checked: no finite derivatives, or more than 200 past "
            "outputs."
        )
        yield text, "contraction_not_checked"
    elif contracts.rate < 1:
        how = (
            f"contracts in one metric (rate {contracts.rate:.4g}): evidence, not proof, that "
            "it forgets its start"
        )
        yield f"On all {contracts.samples} sampled points the free run {how}.", ""
    else:
        share = f"{percent(1 - contracts.share, 3)} of the {contracts.samples} sampled points"
        worst = f"worst at {contracts.worst}, rate {contracts.rate:.4g}"
        yield (
            f"At {share} the free run does not contract in the best metric that was found, "
            f"{worst}.",
            "",
        )
    yield describe_divergence(divergence, driven)
