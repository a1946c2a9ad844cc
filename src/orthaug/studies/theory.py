"""Statements of the paper: where the program computes each, and what shows it.

They are assumptions, conditions, lemmas, theorems and remarks.
"""

from __future__ import annotations

from typing import NamedTuple


class Statement(NamedTuple):
    """One statement of the paper, by its label."""

    label: str
    says: str
    computed: str
    shown: str


THEORY: tuple[Statement, ...] = (
    Statement(
        "assum:phi_full_rank",
        "The data determine θ: the stacked regressor matrix Φ has full column rank.",
        "physics.excitation.excitation, physics.excitation.require_rank; whether any data could: "
        "physics.excitation.identifiability",
        "tests/test_excitation.py; every fit reports rank and condition, and a deficient Φ is "
        "refused by name",
    ),
    Statement(
        "exmp:non-uniqueness",
        "With a linear learner on the physics' own regressors, any θ and W of the right sum is "
        "a minimum.",
        "fitting.status.Ending.SPANNED (P⊥J = 0), fitting.conclusion.conclude warns",
        "test_paper.test_example_1, test_example_1_without_orthogonality",
    ),
    Statement(
        "property:orthogonality",
        "Lemma: ΦᵀF̃ = 0, the projected learner has no share in the physics on the training "
        "rows (eq:theta_aux).",
        "physics.projection.Projection.solve (θ_aux), fitting.elimination.split_theta; the "
        "defect ‖QᵀF̃‖/‖F‖ is in every result",
        "test_paper.test_lemma_1; at most 1e-12",
    ),
    Statement(
        "cond:special_PE",
        "Physics and unmodelled term are orthogonal on the data: Σ φᵀ(x)δ(x) = 0. δ is "
        "unknown, so only suspected terms can be checked. Over a domain "
        "(eq:phi-delta-orthog-functions) it is the same under a uniform measure.",
        "analysis.bias.bias_table, inference.linearization.find_certificate; for another measure "
        "inference.measures.Uniform, inference.splitting.split_by_measure",
        "tests/test_bias.py; studies static_errors and data_length: set 1 meets it, 2 in the "
        "limit, 3 never, and 3 does under the uniform measure",
    ),
    Statement(
        "Remark after cond:special_PE",
        "If δ can be suspected, the input can be designed so that the condition holds.",
        "analysis.design.design_input, analysis.signals.sign_symmetric, analysis.suspects.Suspect",
        "tests/test_design.py, tests/test_signals.py",
    ),
    Statement(
        "assum:data_gen_sys_recovered",
        "Training reproduces the true function exactly on the training rows.",
        "status and loss of fitting.estimates.Estimate; residual tests: "
        "analysis.residuals.analyse, verdict: analysis.diagnosis.diagnose. θ of the orthogonal "
        "structure under the training measure does not need it: θ̂ = Φ⁺Y for every learner",
        "study static_errors (test RMSE 1e-6); test_paper.test_theta_is_the_same_for_every_learner",
    ),
    Statement(
        "thm:error_val",
        "‖θ* − θ̂‖ = ‖Φ⁺Δ‖ (eq:error_val), which is zero under cond:special_PE.",
        "physics.projection.Projection.solve; for suspected terms analysis.bias.bias_table",
        "test_paper.test_theorem_1; study static_errors: 0, 0.07955, 0.14333 on the three sets",
    ),
    Statement(
        "assum:baseline_mdl_dominant",
        "The physics dominates: ‖Φθ*‖ > ‖Δ‖. The paper concludes e_std > e_orth from the "
        "member θ = 0 of the equivalence set (eq:eqivalence_set_std), whose error is θ*. That "
        "step holds in the norm ‖Φ·‖, as ‖Φθ*‖ > ‖Δ‖ ≥ ‖ΦΦ⁺Δ‖, not in the Euclidean norm that "
        "is claimed: where columns of Φ nearly depend on each other, ‖Φ⁺Δ‖ can be a thousand "
        "times ‖θ*‖. Repair, without the assumption: if the learner can take the values (I − "
        "ΦΦ⁺)Δ, the orthogonal solution θ* + Φ⁺Δ is itself in the set, so the supremum is no "
        "less than its error; if it can also take Φv more for a small v ≠ 0 with vᵀΦ⁺Δ ≤ 0, "
        "the supremum is larger.",
        "With θ̂ and the learner in place of what is unknown: analysis.validation.dominance, "
        "the size of the learner against the physics in `orthaug compare`. No program can take "
        "the supremum over all weights",
        "test_paper.test_a_dominant_physics_orders_the_errors_in_the_norm_of_phi_alone, "
        "test_the_orthogonal_solution_is_in_the_equivalence_set. Study static_errors: over ten "
        "starts additive errors of 0.11 to 1.5, against 0, 0.080 and 0.143 on the three sets",
    ),
    Statement(
        "eq:baseline_error_simple_augm and the remark after it",
        "Without orthogonality the error is ‖Φ⁺(F − Δ)‖: zero only if the learner finds the "
        "unmodelled term and nothing else.",
        "fitting.elimination.split_theta (Additive)",
        "test_paper.test_error_of_the_additive_structure; study static_errors, figure learner",
    ),
    Statement(
        "cond:stable_sys",
        "The data-generating system forgets its initial state exponentially.",
        "Of the fitted model: analysis.free_run_stability.contraction, "
        "analysis.boundedness.find_divergence, analysis.feedback.feedback",
        "tests/test_free_run_stability.py. The true system is not at hand: out of a program's "
        "scope",
    ),
    Statement(
        "cond:pred_stab",
        "The one-step predictor and its gradient in the parameters forget and bound their data.",
        "analysis.lipschitz.lipschitz: with finitely many lags bounded slopes are enough; of "
        "the predictor, of its gradient in θ and of that in the learner's weights. Not "
        "checked: other parameters than the fitted ones, regressors off the measured rows, "
        "kinks as those of relu, and a learner without a derivative",
        "test_free_run_stability.test_lipschitz_of_known_gradients, "
        "test_lipschitz_of_the_weights_of_a_known_learner, "
        "test_lipschitz_of_the_weights_of_a_network",
    ),
    Statement(
        "Remark after thm:convergence",
        "The condition can be checked numerically after training; stable-by-design "
        "parametrisations are future work.",
        "analysis.free_run_stability.stability, shown by `orthaug fit`",
        "tests/test_free_run_stability.py; a parametrisation that is stable by design is not "
        "part of orthaug either",
    ),
    Statement(
        "thm:convergence",
        "The criterion converges to its expectation uniformly over the parameters, with "
        "probability 1.",
        "—",
        "A limit over all parameters: proved in the paper, out of a program's scope. Its "
        "consequence for θ is shown by study consistency",
    ),
    Statement(
        "cond:PE",
        "Models that differ have different criteria on the data.",
        "For θ: physics.excitation.excitation. For the learner: effective weights "
        "(fitting.solvers.compiled.effective_weights)",
        "tests/test_excitation.py. For all weights of a network it fails by construction "
        "(neurons can be exchanged); what the data see is what counts",
    ),
    Statement(
        "lem:minimal_cost",
        "As N → ∞ the least criterion is the trace of Σ_e, reached only by models equal to the "
        "true one.",
        "inference.covariance.noise_covariance: residual over its degrees of freedom",
        "test_covariance.test_a_learner_uses_up_freedom; the limit itself is proved in the paper",
    ),
    Statement(
        "thm:consistency",
        "Under the conditions above θ̂ → θ* with probability 1.",
        "fitting.estimation.estimate; under other measures fitting.estimates.Estimate.split",
        "study consistency: slope −1/2 on set 1; on set 3 a constant, but falling under the "
        "uniform measure",
    ),
    Statement(
        "Remark after thm:consistency",
        "Without noise the error formula holds at every N, with noise only in the limit.",
        "physics.projection.Projection.solve",
        "study data_length against study consistency; test_paper.test_theorem_1",
    ),
    Statement(
        "eq:cov_approx",
        "The covariance of θ and the weights from the Jacobian, with a factor 2 in the middle.",
        "inference.covariance.joint_covariance, convention “paper”; the default leaves the 2 "
        "out, which cancels (Ljung 1999)",
        "test_uncertainty.test_the_papers_convention_is_eq_cov_approx; study coverage: 95 % "
        "intervals hold in 95 % without the factor, in 99 % with it",
    ),
    Statement(
        "thm:zero_cov",
        "Cov of θ̂ and the learner's weights is zero. It holds for the sum over rows, not per "
        "row as the proof has it; outputs that share θ need Σ_e = σ²I, not only a diagonal one.",
        "inference.covariance.joint_covariance",
        "test_uncertainty.test_theta_and_the_learner_are_uncorrelated, "
        "test_outputs_that_share_theta_need_equal_noise_for_zero_covariance; study covariance",
    ),
)
