"""The first lines of a page: what a model that fails is of use for, what comes next, which model to take."""

from __future__ import annotations

from typing import Any

import pytest

from orthaug._base.errors import Warning
from orthaug.analysis.changes import Change
from orthaug.analysis.findings import (
    AdviceResult,
    AdviceTrialsResult,
    BiasResult,
    DiagnosisResult,
    MissingResult,
    MotionFitResult,
    SharedResult,
    ValidationResult,
)
from orthaug.analysis.fit_findings import (
    NoiseResult,
    ParameterResult,
    PartScores,
    ScoreResult,
    StatusResult,
)
from orthaug.reports.page_verdict import compare_verdict, fit_verdict
from orthaug.reports.result import CompareResult, DataResult, DifferenceResult, FitResult, RowResult
from orthaug.reports.text import compare_text

DATA = DataResult(train=[], tests={"far": []})
STATUS = StatusResult(
    code="converged", message="", iterations=1, seconds=0.0, loss=0.0, start_loss=0.0
)
LEARNER = Change(kind="learner", what="a learner", fall=0.3, of="simulation", output=None)
LAG = Change(kind="input_lag", what="u[k-4]", fall=0.1, of="simulation", output=None)
KNOWN = ParameterResult(name="a", unit="", initial=0.0, value=1.0, std=0.01, ci95=[0.98, 1.02])


def scored(one_step: float, free_run: float) -> dict[str, PartScores]:
    def score(value: float) -> ScoreResult:
        return ScoreResult(rmse=[value], nrmse=[value], fit=[100 * (1 - value)])

    return {"tests.far": PartScores(prediction=score(one_step), simulation=score(free_run))}


def told(*changes: Change) -> DiagnosisResult:
    return DiagnosisResult.model_construct(
        verdict="white", text="", changes=list(changes), missing=None
    )


def judged(verdict: str) -> ValidationResult:
    return ValidationResult(verdict=verdict, text="", trials=[], extrapolation=[])


def fitted(one_step: float = 0.01, free_run: float = 0.1, **given: Any) -> FitResult:
    options: dict[str, Any] = {
        "parameters": [KNOWN],
        "residuals": None,
        "validation": None,
        "warnings": [],
    }
    return FitResult.model_construct(
        data=DATA,
        status=STATUS,
        physical_parameters=None,
        motion=None,
        **{"scores": scored(one_step, free_run)} | options | given,
    )


def row(
    name: str, error: float, status: str = "converged", code: str | None = "helps", *warned: str
) -> RowResult:
    return RowResult(
        name=name,
        status=status,
        seconds=1.0,
        weights=1,
        parameters=[],
        orthogonality_defect=None,
        scores=scored(0.01, error),
        residuals=None,
        warnings=[Warning(code=warning, text="") for warning in warned],
        learner_to_physics=None,
        validation=None if code is None else judged(code),
    )


def compared(*rows: RowResult) -> CompareResult:
    return CompareResult.model_construct(
        data=DATA, comparison=list(rows), chosen=None, left_out={}, warnings=[]
    )


def test_a_refuted_model_is_of_use_for_the_next_sample_only_where_that_is_predicted():
    assert fit_verdict(fitted(0.05, 3.0)).use.startswith("Use it to predict the next sample")
    use = fit_verdict(fitted(18.0, 3.0)).use
    assert use == (
        "Use it only to search for missing physics: the RMS error of its one-step prediction on "
        "tests.far is 1800 % of the output's standard deviation, too."
    )
    assert "predict the next" not in fit_verdict(fitted(0.4, 3.0)).use
    assert "simulate within" in fit_verdict(fitted(0.7, 0.1)).use


def test_a_model_that_is_far_off_its_own_data_is_not_usable_by_a_short_test():
    trained = {"train": scored(0.05, 0.9)["tests.far"]}
    found = fit_verdict(fitted(scores=scored(0.05, 0.3) | trained))
    assert found.level == "bad"
    assert "free run on the training data is 90 % of the output" in found.trust
    diverging = fit_verdict(fitted(scores=scored(0.05, 1.2) | trained))
    assert "free run on tests.far is 120 % of the output" in diverging.trust


def test_a_noise_model_keeps_feedback_right_and_predicts_where_its_free_run_drifts():
    noise = [NoiseResult.model_construct(output="y", model="innovations")]
    looped = [Warning(code="closed_loop", text=""), Warning(code="short_for_noise", text="")]
    said = fit_verdict(fitted(0.03, 5.0, warnings=looped, noise=noise))
    assert said.use.startswith("Use it to predict the next sample. Do not read a as physics yet")
    assert "biases the estimates" not in said.trust
    assert "a noise model needs complete physics" in said.trust
    alone = fit_verdict(fitted(0.03, 5.0, warnings=looped))
    assert alone.use.startswith("Use it only to search for missing physics")
    assert "feedback, which biases the estimates" in alone.trust
    assert "predict" not in fit_verdict(fitted(0.9, 5.0, warnings=looped, noise=noise)).use[:20]


@pytest.mark.parametrize(
    ("residuals", "warnings", "doubt"),
    [
        (None, [], "its residual could not be tested"),
        ("equation_noise", ["coloured_residual"], "correlated with their past"),
        ("equation_noise", [], None),
        ("white", [], None),
    ],
)
def test_a_large_error_that_is_not_white_is_a_doubt(residuals, warnings, doubt):
    given = {
        "residuals": residuals and told().model_copy(update={"verdict": residuals}),
        "warnings": [Warning(code, "text") for code in warnings],
    }
    large, small = (fit_verdict(fitted(0.01, error, **given)) for error in (0.22, 0.05))
    assert small.level == "good"
    assert large.level == ("care" if doubt else "good") and (doubt or "reliable") in large.trust


def test_a_learner_that_was_tried_and_is_not_better_is_not_advised():
    both = told(LEARNER, LAG)
    assert fit_verdict(fitted(residuals=both)).then.startswith(
        "An option, not tried here: a learner, with which"
    )
    for code in ("no_help", "helps"):
        fell_back = [Warning(code="physics_alone", text="")]
        then = fit_verdict(fitted(residuals=both, validation=judged(code), warnings=fell_back)).then
        assert "further input lag u[k-4]" in then
    assert ": a learner, " in fit_verdict(fitted(residuals=both, validation=judged("helps"))).then
    assert (
        ": a learner, "
        not in fit_verdict(fitted(residuals=told(LEARNER), validation=judged("no_help"))).then
    )


def test_what_was_tried_comes_first_and_what_was_not_is_an_option():
    text = (
        "With an offset the free run on rows held out improves from 0.2 to 0.1 of the output's "
        "deviation."
    )
    tried = AdviceTrialsResult(text="", tried=2, not_tried=0)
    better = [AdviceResult(change={"motion.hold": "spline"}, text=text, before=0.2, after=0.1)]
    both = told(LEARNER, LAG)
    assert fit_verdict(fitted(residuals=both, advice=better, advice_trials=tried)).then == text
    # Both were tried and did not improve it
    then = fit_verdict(fitted(residuals=both, advice_trials=tried)).then
    assert (
        then.startswith("None of the changes that were tried improves the free run")
        and "lag" not in then
    )


def test_physics_alone_that_was_taken_for_a_learner_is_not_reported_to_be_hurt_by_it():
    fell_back = [Warning(code="physics_alone", text="")]
    assert fit_verdict(fitted(validation=judged("hurts"))).level == "bad"
    found = fit_verdict(fitted(validation=judged("hurts"), warnings=fell_back))
    assert found.level == "good" and "Take physics alone" not in found.then


def test_a_cause_of_most_of_what_was_learned_comes_before_changes():
    def biased(share: float) -> list[ParameterResult]:
        return [
            KNOWN.model_copy(
                update={"bias": BiasResult(value=-0.1, cause="cubic of y[k-1]", share=share)}
            )
        ]

    assert (
        "“cubic of y[k-1]”"
        in fit_verdict(fitted(parameters=biased(0.98), residuals=told(LAG))).then
    )
    assert "u[k-4]" in fit_verdict(fitted(parameters=biased(0.5), residuals=told(LAG))).then
    assert "“cubic of y[k-1]”" in fit_verdict(fitted(parameters=biased(0.5), residuals=told())).then


def test_a_comparison_has_the_doubts_of_its_model():
    assert (
        compare_verdict(
            compared(row("physics alone", 0.5, code=None), row("orthogonal", 0.1))
        ).level
        == "good"
    )
    doubted = row("orthogonal", 0.1, "iteration_limit", "helps", "spectral_radius_above_one")
    found = compare_verdict(compared(row("physics alone", 0.5, code=None), doubted))
    assert found.level == "care"
    assert "But training stopped before it converged and its stability is not proved" in found.trust


def test_saved_results_with_the_same_parameters_differ_by_nothing():
    one = DifferenceResult(name="theta1", result="second", value=0.0, of_std=0.0)
    both = compared(row("first", 0.1), row("second", 0.1)).model_copy(update={"differences": [one]})
    assert compare_verdict(both).use == "The parameters are the same."


def test_of_models_that_are_as_good_the_one_whose_parameters_mean_something_is_taken():
    def taken(*rows: RowResult) -> str:
        return compare_verdict(compared(*rows)).trust.partition("”")[0]

    alone = row("physics alone", 0.3, code=None)
    assert taken(alone, row("additive", 0.1), row("orthogonal", 0.105)) == "Take “orthogonal"
    assert taken(alone, row("additive", 0.1), row("orthogonal", 0.15)) == "Take “additive"
    near = row("physics alone", 0.105, code=None)
    assert taken(near, row("additive", 0.1)) == "Take “physics alone"
    assert taken(near, row("additive", 0.1), row("orthogonal", 0.104)) == "Take “orthogonal"
    assert (
        taken(near, row("additive", 0.1), row("orthogonal", 0.104, code="no_help"))
        == "Take “physics alone"
    )
    lower = compare_verdict(compared(alone, row("additive", 0.1), row("orthogonal", 0.105)))
    assert "the smallest of all models" not in lower.trust


def test_the_terminal_ends_with_the_verdict_that_the_page_begins_with():
    result = compared(row("orthogonal", 0.05), row("physics alone", 0.3))
    verdict = compare_verdict(result)
    last = compare_text(result.model_copy(update={"differences": None}), {}).split("\n\n")[-1]
    assert " ".join(last.split()) == f"Verdict: {verdict.trust} {verdict.use}"
    assert verdict.trust.startswith("Take “orthogonal”: the RMS error of its free run")


@pytest.mark.parametrize("noise", [[object()], None])
def test_feedback_is_no_doubt_where_errors_are_white(noise):
    """The warning said 'consistent here', and the verdict 'which biases the estimates': of six
    loops with complete physics and white noise on the sensor, every interval held the truth."""
    looped = [Warning("closed_loop", "")]
    found = fit_verdict(fitted(residuals=told(), warnings=looped, noise=noise))
    assert found.level == "good" and "feedback" not in found.trust
    assert "read a as physics" in found.use and "Do not" not in found.use
    coloured = told().model_copy(update={"verdict": "equation_noise"})
    left = fit_verdict(fitted(residuals=coloured, warnings=looped, noise=noise))
    assert left.level == "care" and "under feedback" in left.trust


@pytest.mark.parametrize("code", ["wild_rows", "unit_mismatch", "wrapped_angle"])
def test_wrong_data_are_mended_before_physics_is_searched(code):
    """A search finds terms that imitate what is wrong with the data."""
    wrong = [Warning(code, "")]
    for ahead in (0.8, 0.3):
        found = fit_verdict(fitted(ahead, 0.9, residuals=told(), warnings=wrong))
        assert found.trust.startswith("Do not use the model as it is")
        assert found.use.startswith("Mend the data first")
    assert "search for missing physics" in fit_verdict(fitted(0.8, 0.9)).use
    assert "Mend" not in fit_verdict(fitted(warnings=wrong)).use


@pytest.mark.parametrize("code", ["short_for_noise", "parameter_drift", "local_minimum"])
def test_a_warning_that_intervals_leave_something_out_is_in_the_verdict(code):
    found = fit_verdict(fitted(warnings=[Warning(code, "")]))
    assert found.level == "care"
    assert "Do not read a as physics yet" in found.use
    assert "read a as physics" in fit_verdict(fitted()).use


def test_what_a_warning_supposes_of_a_parameter_the_verdict_does_not_assert():
    """Missing memory, as creep, looks like an offset that moves over the record."""
    for code, supposed in (
        ("parameter_drift", "a parameter seems to change over its record"),
        ("parameter_depends", "a parameter seems to depend on a signal"),
    ):
        said = fit_verdict(fitted(warnings=[Warning(code=code, text="")]))
        assert said.level == "care" and supposed in said.trust
        assert "as physics yet" in said.use


@pytest.mark.parametrize(("p", "share"), [(0.03, 0.9), (0.2, 0.9), (0.03, 0.3)])
def test_terms_that_may_be_missing_behind_coloured_errors_keep_parameters_from_being_read(p, share):
    """Few rows do not tell disturbances from missing physics; both colour the error."""
    missing = MissingResult.model_construct(p=p, freedom=[2, 100], share=share, terms=[])
    found = told().model_copy(update={"verdict": "equation_noise", "missing": missing})
    said = fit_verdict(fitted(residuals=found))
    doubted = p < 0.05 and share > 0.5
    assert ("explain 90 % of its error (p = 0.03)" in said.trust) == doubted
    assert ("Do not read a as physics yet" in said.use) == doubted
    assert ("what the residual still contains" in said.use) == doubted


@pytest.mark.parametrize("moved", [0.004, 0.006])
def test_a_parameter_that_a_finer_integrator_would_move_is_not_read_as_physics(moved):
    motion = MotionFitResult.model_construct(substep_bias={"a": moved})
    said = fit_verdict(fitted().model_copy(update={"motion": motion}))
    coarse = moved > 0.5 * 0.01
    assert ("to read a as physics" in said.use) != coarse
    assert ("more substeps of its integrator would move a" in said.trust) == coarse


@pytest.mark.parametrize("code", ["no_help", "helps"])
def test_a_learner_that_does_not_help_is_no_reason_to_leave_parameters_undetermined(code):
    both = [KNOWN, KNOWN.model_copy(update={"name": "b", "shared": True})]
    found = fitted(parameters=both, validation=judged(code))
    said = fit_verdict(found).use
    assert "The data alone do not determine b" in said
    without = 'without it (`learner.kind = "none"`) the data determine b, if no physics is missing'
    assert (without in said) == (code == "no_help")
    doubted = found.model_copy(
        update={"residuals": told().model_copy(update={"verdict": "unmodelled"})}
    )
    assert "without it" not in fit_verdict(doubted).use


def test_what_no_learner_imitates_is_not_said_to_be_imitated():
    free = KNOWN.model_copy(update={"name": "b", "shared": True, "ci95": None})
    found = fitted(parameters=[KNOWN, free], warnings=[Warning("not_identified", "")])
    said = fit_verdict(found).use
    assert "not determine b, because the learner could make up for other values" in said


def test_what_is_in_doubt_beside_the_learner_is_not_read_as_physics():
    doubt = "training had not converged"
    shared = SharedResult.model_construct(withdrawn=["a"], doubt=doubt)
    said = fit_verdict(fitted().model_copy(update={"shared": shared}))
    assert f"Do not read a as physics yet: {doubt}" in said.use
    clear = SharedResult.model_construct(withdrawn=None, doubt=None)
    said = fit_verdict(fitted().model_copy(update={"shared": clear}))
    assert "to read a as physics" in said.use


def test_a_parameter_without_an_interval_is_not_called_uncertain():
    bare = KNOWN.model_copy(update={"name": "b", "std": None, "ci95": None})
    use = fit_verdict(fitted(parameters=[KNOWN, bare])).use
    assert "read a as physics. b has no interval" in use and "too uncertain" not in use
