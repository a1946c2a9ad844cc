"""Default standard errors of a fit: plain, robust against colour or uneven size, or none."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from orthaug._base.checks import Matrix, Vector
from orthaug._base.errors import InputError, Warning
from orthaug._base.parallel import one_blas_thread
from orthaug.analysis.attempt import attempt
from orthaug.analysis.residuals import LAGS, PRACTICALLY_WHITE, ROUNDING, errors_of, rms_errors
from orthaug.fitting.colour import correlation_length
from orthaug.fitting.estimates import STD_KINDS, Estimate
from orthaug.fitting.whiteness import ROWS_PER_LAG, autocorrelation, ljung_box
from orthaug.inference.influence import LARGEST, Influence, one_step_slopes
from orthaug.models.response import Response
from orthaug.physics.streamed import StreamedProblem

# Rows that a sum of autocovariances needs, in all and for each of its lags
_FEWEST_ROWS, _ROWS_PER_TERM = (100, 10)
# A variance of a sum needs so many blocks, which Student's t counts; shorter ones covered 85 %.
_FEWEST_BLOCKS = 12
# An autoregressive model needs so many independent errors, less one; Student's t counts them.
_FEWEST_INDEPENDENT = 10
_FEWEST_TESTED = 40  # rows from which White's test is asked
_SHORT = 5  # steps of a block of errors that are white and of uneven size
# Levels of White's test, and of the test whether a residual is white, of all outputs together: of
# errors that are independent and alike 5 % get robust standard errors by chance
UNEVEN, _LEVEL = (0.03, 0.01)
_ROUGH = (
    "the errors are coloured, and there are no robust standard errors of them: those given assume "
    "white errors and are a rough guide."
)
_MEMORIES = 3  # times as many lags as the residual's correlation lasts: Bartlett's weights fade


def with_suited_errors(fit: Estimate, *, ordered: bool = True) -> Estimate:
    """Return a fit of rows in memory with the standard errors that suit its errors.

    As `robust_where_asked`; the fit as it is where that fails. Likewise for physics alone.

    Args:
        ordered: whether the order of the rows means something, so that errors have a colour.
    """
    if fit.physics_alone is not None:
        fit = replace(fit, physics_alone=with_suited_errors(fit.physics_alone, ordered=ordered))
    if isinstance(fit.problem, StreamedProblem) or not fit.status.ok or not fit.robust_kinds:
        return fit
    if not fit.problem.names and not fit.learns:  # known terms alone
        return fit
    return attempt("the robust covariance", lambda: _suited(fit, ordered=ordered), [], fit)


def _suited(fit: Estimate, *, ordered: bool) -> Estimate:
    """Return `with_suited_errors`; plain errors of coloured ones come with a warning."""
    record, simulates = fit.problem.record, fit.criterion.free_run is not None
    response = None if simulates else fit.model.predict(record)
    found = (
        robust_free_run(fit)
        if response is None
        else robust_where_asked(fit, response, ordered=ordered)
    )
    if not ordered or found.std is None or found.std_kind != "plain":
        return found
    if response is None and fit.scores is not None:
        coloured = _is_tested(fit) and _coloured_run(fit)
    else:
        coloured = _memory(fit, response or fit.model.simulate(record)) is not None
    if not coloured:
        return found
    return replace(found, warnings=(*found.warnings, Warning("coloured_residual", _ROUGH)))


def robust_where_asked(fit: Estimate, response: Response, *, ordered: bool = True) -> Estimate:
    """Return the fit with standard errors that suit its errors: plain, or robust.

    Robust ones hold under colour or uneven size.

    One step ahead that is HC3 where White's test finds that the size of the errors goes with what
    moves θ, and Newey and West where they are coloured and the rows suffice. `response` is the
    prediction of the training rows. With a noise model they are plain: those of its innovations.
    Rows that are not `ordered` have no colour.
    """
    if not fit.status.ok or fit.covariance is None or not fit.robust_kinds:
        return fit
    if fit.criterion.free_run is not None:
        return robust_free_run(fit)
    lags, rows = _memory(fit, response) if ordered else None, len(fit.problem.rows)
    if lags is not None:
        most = rows // _ROWS_PER_TERM
        if rows < _FEWEST_ROWS:
            return fit
        if lags > most:
            return _withheld(fit, "one step ahead", f"over too much of the {rows} rows")
        return _robust(fit, lags)
    errors = np.concatenate(errors_of(response)) @ fit.problem.weight.matrix.T
    if np.all(rms_errors(response) / fit.problem.deviation < ROUNDING) or len(errors) != rows:
        return fit
    if not _has_rows(fit, rows) or not _is_uneven(
        fit, one_step_slopes(fit.problem, fit.model), errors
    ):
        return fit
    return _robust(fit, None, "hc3")


def beside_plain(robust: Estimate, plain: Estimate) -> tuple[Warning, ...]:
    """Return a warning on the standard errors that would suit a fit, where plain ones are asked.

    None where these suit.
    """
    if robust.std_kind == plain.std_kind:
        return ()
    begin = 'standard errors are plain, as asked (`standard_errors="plain"`). '
    if robust.std is None:
        text = f"{begin}None would suit: the errors are correlated over too many steps."
        return (Warning("plain_standard_errors", text),)
    listed = ", ".join(
        f"{std:.2g} of {name}"
        for name, std in zip(plain.problem.names, robust.std, strict=True)
        if np.isfinite(std)
    )
    text = f"{begin}Those that suit these errors are {STD_KINDS[robust.std_kind]}: {listed}."
    return (Warning("plain_standard_errors", text),)


def robust_free_run(fit: Estimate) -> Estimate:
    """Return the fit of a free run with standard errors by batch means, where errors are coloured.

    Where they are coloured and the record holds too few stretches that do not remember each other
    for blocks, a model of their colour takes the place of these; where it says that the record is
    too short, there are no standard errors, and no interval.
    """
    if not fit.status.ok or fit.covariance is None or fit.scores is None:
        return fit
    if not _is_tested(fit):
        return fit
    if _coloured_run(fit):
        steps = block_of(fit)
        return _by_colour(fit) if steps is None else _robust(fit, steps)
    segments = fit.scores.segments
    if not _has_rows(fit, segments.count) or not _is_uneven(
        fit, fit.scores.slopes(), fit.scores.whitened()
    ):
        return fit
    return _robust(fit, _SHORT, "batch-means-uneven")


def _by_colour(fit: Any) -> Estimate:
    """Return the fit with the standard errors of an autoregressive model of its errors.

    Without any where these are few.
    """
    if _has_rows(fit, fit.scores.segments.count):
        found = _robust(fit, None, "autoregressive")
        if found.std_kind == "autoregressive" and found.freedom >= _FEWEST_INDEPENDENT:
            return found
    return _too_long(fit)


def _robust(fit: Estimate, lags: int | None, kind: str | None = None) -> Estimate:
    """Return the fit with robust standard errors; as it is where there can be none."""
    try:
        return fit.robust(lags) if kind is None else fit.robust(lags, kind)
    except InputError:  # an ensemble, or a fit without statistics
        return fit


def _has_rows(fit: Estimate, rows: int) -> bool:
    """Return whether the derivatives of every row exist, and fit into memory."""
    gram = fit.model.statistics.gram
    if (
        gram is None
        or fit.model.numbers.tilt is not None
        or isinstance(fit.problem, StreamedProblem)
    ):
        return False
    return rows >= _FEWEST_TESTED and rows * len(fit.problem.deviation) * len(gram) <= LARGEST


def _is_uneven(fit: Estimate, slopes: Any, errors: Matrix) -> bool:
    """Return whether White's test finds the errors' size related to the parameters' slopes."""
    made = fit.moves_by()
    if made is None or not np.isfinite(slopes).all() or not np.isfinite(errors).all():
        return False
    k, moves = made
    nt = len(fit.theta)
    own = fit.model.statistics.among(moves, nt)
    with one_blas_thread():
        return (
            Influence.of(slopes[..., moves], own, k[:, moves], int(moves[:nt].sum())).uneven(errors)
            < UNEVEN
        )


def _too_long(fit: Any) -> Any:
    """Return the fit of a free run without standard errors: its errors are correlated too long."""
    segments = fit.scores.segments
    lengths = [correlation_length(errors) for errors in fit.scores.errors()]
    known = [length for length in lengths if length is not None]
    if len(known) == len(lengths) and max(known) <= fit.scores.longest:
        why = (
            f"over {max(known)} steps. The {segments.count} steps of training contain too few "
            "stretches of that length"
        )
    else:
        why = (
            f"over more than a segment of training ({fit.scores.longest} steps) or much of the "
            "record"
        )
    trained = fit.criterion.free_run
    whole = trained is None or not trained.steps
    return _withheld(fit, "of the free run", why, "" if whole else "longer segments, ")


def _withheld(fit: Any, errors: str, why: str, longer: str = "") -> Any:
    """Return the fit without standard errors, which says why.

    Args:
        errors: which they are, in words.
        why: over how long they are correlated.
        longer: a remedy beside a longer record.
    """
    each = (
        ""
        if fit.std is None
        else " A formula for white errors gives standard errors of "
        + ", ".join(
            f"{std:.2g} of {name}"
            for name, std in zip(fit.problem.names, fit.std, strict=True)
            if np.isfinite(std)
        )
        + ", which are too small."
    )
    text = (
        f"no standard errors and no intervals: the errors {errors} are correlated {why}.{each} Use "
        f"{longer}a longer record, or physics with smaller errors."
    )
    return replace(
        fit,
        covariance=None,
        plain_covariance=fit.covariance,
        std_kind="none",
        warnings=(*fit.warnings, Warning("too_long_memory", text)),
    )


def _memory(fit: Estimate, response: Response) -> int | None:
    """Return lags for the one-step residual; None where it is white, or rounding.

    As many as there are rows where it is correlated over all lags that are looked at.
    """
    memory = 0
    if np.all(rms_errors(response) / fit.problem.deviation < ROUNDING):
        return None
    for i in range(len(fit.problem.outputs)):
        pieces = [errors[:, i] for errors in errors_of(response)]
        if _is_coloured(pieces, len(fit.problem.outputs)):
            rows = sum(map(len, pieces))
            acf = np.asarray(autocorrelation(pieces, rows // ROWS_PER_LAG))
            quiet = np.abs(acf) < 2 / np.sqrt(rows)
            memory = max(memory, int(np.argmax(quiet)) if quiet.any() else rows)
    return _MEMORIES * memory or None


def block_of(fit: Estimate) -> int | None:
    """Return steps of a block for the errors of the free run.

    None where these are white, or leave too few blocks.
    """
    if fit.scores is None or not _is_tested(fit) or not _coloured_run(fit):
        return None
    steps = fit.scores.block()
    if steps is None or fit.scores.segments.count < max(_FEWEST_BLOCKS * steps, _FEWEST_ROWS):
        return None
    return steps


def _is_tested(fit: Any) -> bool:
    """Return whether the errors of the free run are finite and more than rounding."""
    errors = fit.scores.errors()  # (ny, segments, steps), 0 where a step is not scored
    size = np.sqrt(np.sum(errors**2, axis=(1, 2)) / max(fit.scores.segments.count, 1))
    return bool(np.isfinite(size).all() and not np.all(size / fit.problem.deviation < ROUNDING))


def _coloured_run(fit: Any) -> bool:
    """Return whether the errors of the free run are coloured in some output."""
    every = fit.scores.errors()
    return any(_is_coloured([one[one != 0] for one in output], len(every)) for output in every)


def _is_coloured(pieces: list[Vector], outputs: int) -> bool:
    """Return whether Ljung-Box rejects a white residual and a correlation is sizable.

    The test is one of as many as there are outputs (Bonferroni).
    """
    box, acf = (
        ljung_box(pieces, LAGS),
        autocorrelation(pieces, sum(map(len, pieces)) // ROWS_PER_LAG),
    )
    return (
        box is not None
        and acf is not None
        and outputs * box.p < _LEVEL
        and np.abs(acf[1:]).max() >= PRACTICALLY_WHITE
    )
