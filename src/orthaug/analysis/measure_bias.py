"""Bias of θ and of physical parameters by each suspect, under the measure of a spec."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool

from orthaug._base.checks import Matrix, Vector
from orthaug._base.errors import InputError
from orthaug.analysis.absorbed import term_effects
from orthaug.analysis.bias import (
    SuspectedBias,
    TermResponse,
    bias_table,
    has_term,
    seen_table,
)
from orthaug.analysis.bias_hull import MOST_PHYSICS
from orthaug.analysis.catalogue import RIVALS, Argument, Catalogue, saturations
from orthaug.analysis.causes import Considered
from orthaug.analysis.imitation import other_inputs
from orthaug.analysis.mapped_bias import physical_of, physical_slopes
from orthaug.analysis.rival_forms import Forms
from orthaug.analysis.suspects import Suspect, evaluate_rows
from orthaug.data.expressions import parse
from orthaug.data.regressors import Features
from orthaug.fitting.lagged_estimate import LaggedEstimate
from orthaug.inference.linearization import Linearization
from orthaug.inference.measures import (
    Measure,
    Symmetrized,
    Uniform,
    WeighedPhysics,
    weigh_problem,
)
from orthaug.physics.excitation import excitation, require_rank
from orthaug.physics.output_weights import times
from orthaug.physics.parameters import PhysicsMap
from orthaug.physics.problem import Problem
from orthaug.physics.shared import seen_columns, shared_directions

# Of a measure at most, over which certificates are sought for suspects that no one named
CERTIFIED_ROWS = 200_000
_REMOVED = 0.1  # of a bias may remain
_MEASURED_ROWS = 50_000  # above which no other measure is tried
_FORM_ROWS = 20_000  # on which other forms of a term are tried
_SAME = 1e-9  # of a term's size: it is one form in several outputs
_NOTHING = 0.01  # of the noise: a learner that is smaller found nothing that could be explained


class RowEquations(NamedTuple):
    """Normal equations of θ and of the coefficients of further terms (`FormEquations`)."""

    information: Matrix
    gradient: Vector
    fitted: Bool[np.ndarray, "n"]


@dataclass(frozen=True, eq=False)
class LaggedTerms:
    """Terms that physics on lagged signals may lack, under a measure (`TermPhysics`).

    Args:
        weighed: the measure's points and the physics there, of one parameter or more.
        theta: θ̂ for relative biases and for dp/dθ.
        map: from physical parameters to θ.
        learned: f at the measure's points (M, ny) after a fit, to find how much of it a suspect
            explains.
        directions: (nθ, s) along which θ is split; None for all.
        fit: where these are of a fit.
    """

    weighed: WeighedPhysics
    problem: Problem
    theta: Vector
    map: PhysicsMap | None = None
    learned: Matrix | None = None
    directions: Matrix | None = None
    fit: LaggedEstimate | None = None

    @property
    def names(self) -> tuple[str, ...]:
        return self.problem.baseline.names

    @property
    def value(self) -> Vector:
        return self.theta

    @property
    def slopes(self) -> Vector:
        return np.ones(len(self.theta))

    @property
    def physical(self) -> tuple[dict[str, Vector], Vector] | None:
        return self._physical

    @cached_property
    def _physical(self) -> tuple[dict[str, Vector], Vector] | None:
        return physical_slopes(self.map, self.problem, self.theta)

    @property
    def bounds(self) -> Matrix:
        return np.array([[p.min, p.max] for p in self.problem.baseline.parameters])

    @cached_property
    def catalogue(self) -> Catalogue:
        """The terms that no one named."""
        return Catalogue.of_problem(self.problem)

    def usual(self) -> list[Suspect]:
        """Return the usual suspects that the physics does not have."""
        jacobian = self.linearization.jacobian
        return [s for s in self.catalogue.usual() if not has_term(jacobian, self.values(s))]

    @property
    def memory(self) -> tuple[str, ...]:
        return ()

    @property
    def certifies(self) -> bool:
        return len(self.weighed.points.x) <= CERTIFIED_ROWS

    @property
    def linearization(self) -> Linearization:
        return self._linearization

    @cached_property
    def _linearization(self) -> Linearization:
        projection = self.weighed.projection
        count = projection.q.shape[0] * projection.q.shape[1]
        require_rank(excitation(projection.r, self.names), count)
        learner = None if self.learned is None else self._weigh(self.learned)
        return Linearization(projection, self.directions, learner)

    def equation(self, suspect: Suspect) -> None:
        return None

    def values(self, suspect: Suspect) -> Matrix:
        problem, x = self.problem, self.weighed.points.x
        lengths = problem.lengths if x is problem.rows.x else None  # else they are no record
        found = self._sampled(suspect).values(x, problem.layout, problem.outputs, lengths)
        return self._weigh(found)

    def sees(self, suspects: Sequence[Suspect]) -> list[bool | None]:
        """Return None where the learner could imitate every change of θ: then all is the split."""
        if self.directions is None:
            return [None] * len(suspects)
        problem, layout = self.problem, self.problem.layout
        static = [suspect for suspect in suspects if suspect.memory is None]

        def forms(x: Matrix) -> Matrix:
            return np.stack([self._sampled(one).form(x, layout) for one in static], axis=-1)

        seen = iter(seen_columns(problem.features, layout, problem.rows.x, forms) if static else ())
        # A function of the past is none of one row
        return [suspect.memory is None and bool(next(seen)) for suspect in suspects]

    def respond(self, suspects: Sequence[Suspect], *, run: bool) -> list[TermResponse]:
        if self.directions is None:
            held = [self.values(suspect) for suspect in suspects]
            return [TermResponse(np.zeros(len(self.theta)), one, None, one) for one in held]
        visible = [bool(seen) for seen in self.sees(suspects)]
        terms = map(self._term, suspects)
        effects = term_effects(self.problem, terms, visible, self.weighed.points.x)
        weighed = ((effect, self._weigh(effect.held)) for effect in effects)
        return [TermResponse(effect.moved, held, effect.seen, held) for effect, held in weighed]

    def expected_shifts(self, bias: Vector) -> dict[str, dict[str, float | None]] | None:
        """Return p of θ̂ less p without the bias."""
        if self.map is None:
            return None
        biased, true = (
            physical_of(self.map, self.problem, t) for t in (self.theta, self.theta - bias)
        )
        return {
            name: {"bias": float(b - t), "relative": float((b - t) / t) if t else None}
            for name, b, t in zip(self.map.names, biased, true, strict=True)
        }

    def considered(
        self, declared: Sequence[Suspect], named: Sequence[SuspectedBias] | None = None
    ) -> Iterator[Considered]:
        """Yield the declared suspects, then the usual terms and families that the learner sees.

        What it does not see counts only if it was declared: else it is no likely cause.
        """
        if named is None:
            named = bias_table(self, declared, certify=False, every=False)
        usual = seen_table(self, (*self.usual(), *self.catalogue.two_lags()))
        families = seen_table(self, self.catalogue.families())
        families = [entry for entry in families if (entry.cosine or 0.0) <= MOST_PHYSICS]
        zones = [entry.suspect for entry in (*named, *usual, *families)]
        alike = bias_table(self, saturations(zones), certify=False, every=False)
        every = (*named, *usual)
        # Difference equations have no families beside declared terms: half is enough for these
        yield Considered(named, (), (), every, (*families, *alike))
        yield Considered(usual, (), families, every, alike)

    def parts(self) -> list[tuple[str | None, LaggedTerms]]:
        """Return for each output of which anything is learned the fit with that part alone."""
        fit, learned, outputs = self.fit, self.learned, self.problem.outputs
        if fit is None or learned is None or not np.all(np.isfinite(learned)):
            return []
        noise = fit.model.statistics.noise
        least = 0.0 if noise is None else _NOTHING**2 * np.diag(noise)
        something = np.mean(learned**2, axis=0) >= least
        if len(outputs) == 1:
            return [(None, self)] if something.any() else []
        return [
            (outputs[i], replace(self, learned=learned * np.eye(len(outputs))[i]))
            for i in np.flatnonzero(something)
        ]

    def is_negligible(self, bias: Vector) -> bool:
        """Return False: outputs of which nothing is learned are no parts."""
        return False

    def noise_share(self) -> float:
        """Return ν, the share of noise in what the learner holds beside the physics.

        Noise takes σ² for each weight that the learner uses.
        """
        fit, own = self.fit, np.asarray(self.linearization.unshared_learner)
        if fit is None or fit.model.statistics.noise is None:
            return 0.0
        rows = np.ones((len(own), 1)) * np.sqrt(np.diag(fit.model.statistics.noise))
        # innovations: no filter of a noise model
        noise = np.sum(times(self.weighed.unit, rows) ** 2) / own.shape[1]
        taken = fit.effective_weights / self.problem.count * noise
        return float(taken / max(np.sum(own**2), np.finfo(float).tiny))

    def forms(self, selected: int) -> Forms[Suspect] | None:
        """Return other forms of the term of a parameter: on its own lags, and the usual ones.

        None where it has other forms in other outputs.
        """
        problem, shares = self.problem, self._shares(selected)
        if shares is None:
            return None
        x, place = problem.rows.x[self._every], int(np.argmax(shares != 0))
        output, name = problem.outputs[place], problem.names[selected]
        phi = problem.phi(x)[:, place]
        read = [
            str(lag)
            for term in problem.baseline.terms or ()
            if term.parameter == name
            for lag in parse(term.regressor, dict(problem.baseline.constants)).lags
        ]
        read = list(dict.fromkeys(read))
        steps = [one.text for one in self.catalogue.arguments if one.text not in read]
        steps = [text for text in steps if {*map(str, parse(text).lags)} <= {*read}]
        seen = [Argument(text, self._values_of(text, x)) for text in (*read, *steps)]
        catalogue = replace(self.catalogue, places=(output,), seen=(*seen,))
        every_form = (*catalogue.usual(), *catalogue.two_lags(), *catalogue.products_of(read))
        every_form = (*every_form, *catalogue.families(RIVALS))
        own = np.delete(phi, selected, axis=1)
        with np.errstate(all="ignore"):  # of an exponential that overflows none is tried
            values = [self._values_of(form.expression, x) for form in every_form]
        return Forms(every_form, np.stack(values, axis=1), own, phi[:, selected], linear=True)

    def with_forms(self, selected: int, forms: Sequence[Suspect]) -> RowEquations | None:
        """Return the least squares of θ and of further forms of a term on the training rows."""
        problem, shares = self.problem, self._shares(selected)
        if shares is None:
            return None
        every = self._every if problem.noise is None else slice(None)  # its filter needs all rows
        x, weight = problem.rows.x[every], problem.weight.matrix
        values = np.stack([self._sampled(form).form(x, problem.layout) for form in forms], axis=-1)
        rows = np.concatenate([problem.phi(x), shares[:, None] * values[:, None]], axis=-1)
        rows = rows if problem.noise is None else problem.noise.rows(rows)
        rows = np.einsum("oi,nik->nok", weight, rows).reshape(-1, rows.shape[-1])
        count = len(self.theta)
        basis = np.linalg.qr(rows[:, :count])[0]
        left = problem.unexplained[every].ravel()
        left = left - basis @ (basis.T @ left)
        fitted = np.arange(rows.shape[1]) < count
        return RowEquations(rows.T @ rows, rows.T @ left, fitted)

    def _shares(self, selected: int) -> Vector | None:
        """Return what a term does to each output over what it does to the first that has it.

        None where that differs between rows: it then has several forms.
        """
        own = self.problem.phi(self.problem.rows.x[self._every])[:, :, selected]
        size = np.linalg.norm(own, axis=0)
        first = own[:, int(np.argmax(size > 0))]
        shares = first @ own / max(float(first @ first), np.finfo(float).tiny)
        return shares if np.all(np.abs(own - shares * first[:, None]) <= _SAME * size) else None

    def shapes(self, selected: int) -> Bool[np.ndarray, "nt"]:
        """Return none: all parameters multiply their terms."""
        return np.zeros(len(self.theta), dtype=bool)

    @property
    def _every(self) -> slice:
        """Every so many of the training rows."""
        return slice(None, None, 1 + len(self.problem.rows.x) // _FORM_ROWS)

    def _values_of(self, text: str, x: Matrix) -> Vector:
        return evaluate_rows(parse(text), x, self.problem.layout, f"'{text}'")

    def remedies(self, cause: SuspectedBias, biased: Sequence[str]) -> list[str]:
        """Return sentences on how to remove the bias of the named parameters, easiest first."""
        return [*_by_inputs(self, cause, biased), *_by_measure(self, cause, biased)]

    def _weigh(self, rows: Matrix) -> Matrix:
        return self.weighed.times(np.asarray(rows))

    def _sampled(self, suspect: Suspect) -> Suspect:
        return suspect.sampled(self.problem.record.sampling_time)

    def _term(self, suspect: Suspect) -> Callable[[Matrix], Matrix]:
        """Return the values (N, ny) of a term on rows of the regressor, or on every so many."""
        problem, suspect = self.problem, self._sampled(suspect)
        layout, outputs = problem.layout, problem.outputs
        if suspect.memory is None:
            return lambda x: suspect.values(x, layout, outputs)
        along = suspect.values(problem.rows.x, layout, outputs, problem.lengths)
        return lambda x: along[:: -(-len(along) // len(x))]


def bias_under(
    terms: LaggedTerms, suspects: Sequence[Suspect] = (), *, certify_usual: bool = True
) -> list[dict[str, Any]]:
    """Return the bias by every suspect under a measure, as plain data for JSON.

    Args:
        suspects: those that were named; without any, the usual ones that have an effect.
        certify_usual: seek certificates, a linear program each, for suspects that no one named,
            too.
    """
    named = bool(suspects)
    certify = named or (certify_usual and terms.certifies)
    table = bias_table(
        terms,
        suspects or terms.usual(),
        certify=certify,
        every=named,
    )
    return [entry.as_dict() for entry in table]


def linearization_of(
    fit: LaggedEstimate,
    measure: Measure,
    physics: PhysicsMap | None = None,
    problem: Problem | None = None,
) -> LaggedTerms:
    """Return a fit for biases by terms, under the measure that θ was split under.

    Args:
        problem: whose rows are weighed; None for that of the fit.
    """
    problem = fit.problem if problem is None else problem
    weighed = weigh_problem(measure, problem)
    learned = fit.model.learner_at(weighed.points.x) if fit.learns else None
    return LaggedTerms(weighed, problem, fit.theta, physics, learned, fit.model.shared, fit)


def _by_inputs(terms: LaggedTerms, cause: SuspectedBias, biased: Sequence[str]) -> Iterator[str]:
    """Yield the choice of learner inputs that frees most of the parameters."""
    problem, suspect = terms.problem, cause.suspect
    if suspect.memory is not None:  # a function of the past is one of no inputs of one row
        return
    if len(problem.outputs) > 1:  # all outputs have these inputs, and lack different things
        return
    layout, x = problem.layout, problem.rows.x
    now = {str(entry) for entry in problem.features.entries}
    best: tuple[tuple[str, ...], tuple[str, ...]] = ((), ())
    for inputs in dict.fromkeys(
        (*(((suspect.on,),) if suspect.on else ()), *other_inputs(problem))
    ):
        if set(inputs) == now:
            continue
        features = Features(tuple(parse(text, dict(problem.baseline.constants)) for text in inputs))
        if not set(features.lags) <= set(layout):
            continue
        if not seen_columns(features, layout, x, lambda rows: suspect.form(rows, layout)[:, None])[
            0
        ]:
            continue
        shared = shared_directions(problem.baseline, features, layout, problem.outputs, x)
        if shared.all:
            continue
        left = _bias_of(replace(terms, directions=shared.basis), suspect)
        freed = _freed_parameters(terms, cause, left, biased)
        if len(freed) > len(best[1]):
            best = (inputs, freed)
    if best[1]:
        listed = ", ".join(f'"{text}"' for text in best[0])
        rest = "" if len(best[1]) == len(biased) else f" for {', '.join(best[1])}"
        yield f"set learner.inputs = [{listed}]{rest}, where what is missing depends on no more"


def _by_measure(terms: LaggedTerms, cause: SuspectedBias, biased: Sequence[str]) -> Iterator[str]:
    """Yield a measure that brings the bias of all of them near zero."""
    if cause.seen is False or len(terms.problem.rows) > _MEASURED_ROWS:
        return
    for measure in (Symmetrized(), Uniform()):
        if measure.name == terms.weighed.measure.name:
            continue
        try:
            other = replace(terms, weighed=weigh_problem(measure, terms.problem), learned=None)
            left = _bias_of(other, cause.suspect)
        except InputError:
            continue
        if len(_freed_parameters(terms, cause, left, biased)) == len(biased):
            yield f"split under the {measure.name} measure"
            return


def _bias_of(terms: LaggedTerms, suspect: Suspect) -> Vector:
    """Return the bias per unit of a suspect that the learner sees."""
    return terms.linearization.project(terms.values(suspect))


def _freed_parameters(
    terms: LaggedTerms, cause: SuspectedBias, left: Vector, biased: Sequence[str]
) -> tuple[str, ...]:
    """Return the parameters, physical ones by their slopes, whose bias shrinks to a small part."""
    names, before = terms.problem.baseline.names, np.array(cause.bias)
    rows = dict(zip(names, np.eye(len(names)), strict=True)) | (
        terms.physical[0] if terms.physical else {}
    )
    return tuple(
        name for name in biased if abs(rows[name] @ left) <= _REMOVED * abs(rows[name] @ before)
    )
