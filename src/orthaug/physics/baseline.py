"""The baseline: physics that is linear in its parameters, ŷ_k = φ(x_k) θ (eq:fp_model)."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from orthaug._base.checks import Matrix, check_finite, check_label, check_type, check_unique
from orthaug._base.errors import LONGEST, InputError, show
from orthaug._base.views import NotebookView
from orthaug.data.channels import Channel
from orthaug.data.expressions import (
    RESERVED,
    SAMPLING_TIME,
    Expression,
    Lag,
    is_identifier,
    is_name,
    parse,
)
from orthaug.data.record import same_step
from orthaug.data.regressors import Features, Lags, Layout, in_order
from orthaug.data.writing import coefficient_unit

_PARAMETERS = "a tuple of Parameters; `Baseline.from_terms` makes them from terms"


@dataclass(frozen=True)
class Parameter:
    """One entry of θ: name, initial value θ⁰, unit and the bounds `min` and `max`.

    `selected` says that the form of its term was selected from the data: other forms that fit as
    well then count in the intervals of all parameters.
    """

    name: str
    initial: float = 0.0
    unit: str = ""
    min: float = -math.inf
    max: float = math.inf
    selected: bool = False

    def __post_init__(self) -> None:
        check_parameter_name(self.name)
        check_label(self.unit, f"the unit of '{self.name}'")
        check_finite(self.initial, f"the initial value of '{self.name}'")
        check_bounds(self.name, self.min, self.max)


def check_parameter_name(name: Any) -> None:
    """Raise InputError unless `name` is an identifier."""
    if not is_identifier(name):
        raise InputError(
            f"{show(name)} cannot name a parameter; use letters, digits and underscores, at "
            f"most {LONGEST}, not starting with a digit."
        )


def check_sampling_constant(constants: Sequence[tuple[str, float]], sampling_time: float) -> None:
    """Raise InputError where a constant `Ts` is not the sampling time."""
    declared = dict(constants).get(SAMPLING_TIME, sampling_time)
    if not same_step(declared, sampling_time):
        raise InputError(
            f"the constant '{SAMPLING_TIME}' is {declared:g}, but the data are sampled every "
            f"{sampling_time:g} s. {SAMPLING_TIME} is the sampling time without being "
            "declared: leave it out, or rename it if it is another quantity."
        )


def check_bounds(name: str, low: Any, high: Any) -> None:
    """Raise InputError for bounds of a parameter that are no numbers, empty or reversed."""
    if any(isinstance(b, bool) or not isinstance(b, int | float | np.number) for b in (low, high)):
        raise InputError(
            f"the bounds of '{name}' must be numbers; got min = {show(low)}, max = {show(high)}."
        )
    if not low < high:
        raise InputError(
            f"the bounds of '{name}' are empty or reversed: min = {low:g}, max = {high:g}."
        )


@dataclass(frozen=True)
class Term:
    """`parameter * regressor`, a summand of one output.

    The same parameter in several terms shares θ.

    `initial`, `unit` and the bounds `min` and `max` belong to the parameter: one of its terms gives
    them, or none (0, no unit, no bounds). `fixed` keeps `initial` as a known coefficient: the term
    is subtracted from the output first, and the learner is not made orthogonal to it. `output` may
    be left out where there is only one. `selected` says that the form of the regressor was selected
    from the data: other forms that fit as well then count in the intervals.

    Examples:
        >>> kept = Term("one", "y[k-1]", initial=1.0, fixed=True)
        >>> Baseline.from_terms([kept, Term("b", "Ts*u[k-1]", unit="m/N")])
        Baseline(1*y[k-1] + b*(Ts*u[k-1]))
    """

    parameter: str
    regressor: str
    initial: float | None = None
    unit: str | None = None
    output: str | None = None
    fixed: bool = False
    min: float | None = None
    max: float | None = None
    selected: bool | None = None


@dataclass(frozen=True)
class Baseline(NotebookView):
    """φ and the parameters it multiplies; make one with `from_terms` or `from_function`.

    Examples:
        >>> spring = Baseline.from_terms([Term("a", "y[k-1]", initial=0.9), Term("b", "u[k-1]")])
        >>> spring
        Baseline(a*y[k-1] + b*u[k-1])
        >>> spring.names
        ('a', 'b')
    """

    parameters: tuple[Parameter, ...]
    terms: tuple[Term, ...] = ()
    constants: tuple[tuple[str, float], ...] = ()
    function: Callable[[Any], Any] | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        check_type(self.parameters, tuple, "parameters", _PARAMETERS)
        for one in self.parameters:
            check_type(one, Parameter, "parameters", _PARAMETERS)

    def __repr__(self) -> str:
        if self.function is not None:
            return f"Baseline(a function of the regressor, θ: {', '.join(self.names)})"
        sums: dict[str, list[str]] = {}
        for term in self.terms:
            factor = f"{term.initial:g}" if term.fixed else term.parameter
            alone = re.fullmatch(r"\w+\[[^][]*\]", term.regressor)
            regressor = term.regressor if alone else f"({term.regressor})"
            sums.setdefault(term.output or "", []).append(f"{factor}*{regressor}")
        outputs = (f"{name} = " * bool(name) + " + ".join(terms) for name, terms in sums.items())
        return f"Baseline({'; '.join(outputs)})"

    @classmethod
    def from_terms(
        cls, terms: Sequence[Term], constants: Mapping[str, float] | None = None
    ) -> Baseline:
        """Return a baseline with one term per summand.

        Expressions may use the names in `constants`, and `Ts` for the sampling time.

        Args:
            terms: several may have the same parameter.
            constants: numbers by name.

        Raises:
            InputError: an expression that is not arithmetic on lagged channels, or terms of one
                parameter that disagree on its initial value, unit or being fixed.

        Examples:
            >>> Baseline.from_terms([Term("g", "c*u[k]**2")], constants={"c": 0.5}).names
            ('g',)
        """
        if not isinstance(terms, Sequence) or not all(isinstance(term, Term) for term in terms):
            raise InputError(
                "`terms` must be a list of Terms, such as [Term('a', 'y[k-1]')]; got "
                f"{show(terms)}."
            )
        if not terms:
            raise InputError("the baseline has no terms; give at least one, such as y[k-1].")
        check_type(constants, Mapping | None, "constants", "numbers by name")
        constants = dict(constants or {})
        for name, value in constants.items():
            if not is_name(name):
                raise InputError(
                    f"{show(name)} cannot name a constant; use letters, digits and "
                    "underscores, not starting with a digit, and no keyword; "
                    f"{', '.join(sorted(RESERVED))} are taken."
                )
            check_finite(value, f"the constant '{name}'")
        terms = _unify(terms)
        parameters = {t.parameter: _parameter(t) for t in terms if not t.fixed}
        baseline = cls(tuple(parameters.values()), tuple(terms), tuple(sorted(constants.items())))
        _ = baseline.expressions  # report what does not parse here, not at first use
        return baseline

    @classmethod
    def from_function(
        cls, function: Callable[[Any], Any], parameters: Sequence[str | Parameter]
    ) -> Baseline:
        """Return a baseline of a JAX function φ(x) that returns (ny, nθ).

        x (nx,) is the regressor in the order of `Lags`.
        """
        if (
            not callable(function)
            or isinstance(parameters, str)
            or not isinstance(parameters, Sequence)
        ):
            raise InputError(
                "`from_function` takes a function of the regressor and a list of parameter names."
            )
        entries = tuple(p if isinstance(p, Parameter) else Parameter(p) for p in parameters)
        check_unique((p.name for p in entries), "parameter")
        return cls(entries, function=function)

    @property
    def linear(self) -> bool:
        """Always true: φ(x) θ is linear in θ by its form."""
        return True

    @property
    def names(self) -> tuple[str, ...]:
        """Parameter names in order of first appearance."""
        return tuple(p.name for p in self.parameters)

    @property
    def names_taken(self) -> list[str]:
        """Names that a further parameter cannot have."""
        return [*dict(self.constants), *(term.parameter for term in self.terms)]

    @property
    def initial(self) -> np.ndarray:
        """θ⁰, (nθ,)."""
        return np.array([p.initial for p in self.parameters], dtype=float)

    def check_initial(self) -> None:
        """Raise InputError for an initial value beyond its bounds; 0 is the default."""
        for p in self.parameters:
            if not p.min <= p.initial <= p.max:
                raise InputError(
                    f"the initial value of '{p.name}' is {p.initial:g}; its bounds are "
                    f"{p.min:g} and {p.max:g}. Give an `initial` between them."
                )

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bounds of θ, each (nθ,); infinite where there are none."""
        return np.array([p.min for p in self.parameters]), np.array(
            [p.max for p in self.parameters]
        )

    @property
    def state_units(self) -> dict[str, str]:
        """Units of states: lagged physics has none."""
        return {}

    @property
    def measured_states(self) -> dict[str, str]:
        """The states that outputs are: lagged physics has none."""
        return {}

    @cached_property
    def expressions(self) -> tuple[Expression, ...]:
        """The parsed regressor of each term."""
        parsed = []
        for term in self.terms:
            try:
                parsed.append(parse(term.regressor, dict(self.constants)))
            except InputError as error:
                raise InputError(f"baseline term '{term.parameter}': {error}") from None
        return tuple(parsed)

    @property
    def lags(self) -> tuple[Lag, ...]:
        """The raw lags that the expressions read (none known for a function)."""
        return tuple(
            dict.fromkeys(lag for expression in self.expressions for lag in expression.lags)
        )

    def sampled(self, sampling_time: float) -> Baseline:
        """Return the baseline with `Ts` [s] given, where its expressions read it undeclared.

        Raises:
            InputError: a constant `Ts` of another value.
        """
        check_sampling_constant(self.constants, sampling_time)
        if not any(expression.unsampled for expression in self.expressions):
            return self
        return replace(
            self, constants=tuple(sorted((*self.constants, (SAMPLING_TIME, float(sampling_time)))))
        )

    def check_channels(self, outputs: Sequence[str], inputs: Sequence[str]) -> None:
        """Raise InputError for a term with an unknown channel or output, or an output at lag 0."""
        for name, _ in self.constants:
            if name in (*outputs, *inputs):
                raise InputError(
                    f"'{name}' is a constant and a channel; give one of them another name."
                )
        for term, expression in zip(self.terms, self.expressions, strict=True):
            try:
                in_order(expression.lags, outputs, inputs)
            except InputError as error:
                raise InputError(
                    f"baseline term '{term.parameter}' = {term.regressor}: {error}"
                ) from None
            if term.output is None and len(outputs) != 1:
                raise InputError(
                    f"baseline term '{term.parameter}' = {term.regressor}: `output` is missing; "
                    f"one of {', '.join(outputs)}."
                )
            if term.output is not None and term.output not in outputs:
                raise InputError(
                    f"baseline term '{term.parameter}' = {term.regressor}: unknown output "
                    f"'{term.output}'; known are {', '.join(outputs)}."
                )

    def phi(self, x: Any, layout: Layout, outputs: Sequence[str], xp: Any) -> Any:
        """Return φ(x), (…, ny, nθ), of regressors x (…, nx).

        Several terms of a parameter and output add up.
        """
        if self.function is not None:
            return self._call(x, len(outputs), xp)
        return self._matrix([p.name for p in self.parameters], x, layout, outputs, xp)

    def known(self, x: Any, layout: Layout, outputs: Sequence[str], xp: Any) -> Any:
        """Return the sum of the fixed terms, (…, ny)."""
        fixed = {term.parameter: term.initial or 0.0 for term in self.terms if term.fixed}
        if not fixed:
            return xp.zeros((*x.shape[:-1], len(outputs)))
        return self._matrix(list(fixed), x, layout, outputs, xp) @ xp.asarray(list(fixed.values()))

    def on(
        self, x: Matrix, layout: Layout, outputs: Sequence[str]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return `phi` and `known` by NumPy; not finite where an expression has no value."""
        with np.errstate(all="ignore"):
            return np.asarray(self.phi(x, layout, outputs, np)), np.asarray(
                self.known(x, layout, outputs, np)
            )

    def _matrix(
        self, names: list[str], x: Any, layout: Layout, outputs: Sequence[str], xp: Any
    ) -> Any:
        columns = {lag: x[..., j] for j, lag in enumerate(layout)}
        entries = [[xp.zeros(x.shape[:-1]) for _ in names] for _ in outputs]
        for term, expression in zip(self.terms, self.expressions, strict=True):
            if term.parameter in names:
                row = outputs.index(term.output) if term.output is not None else 0
                column = names.index(term.parameter)
                entries[row][column] = entries[row][column] + expression.evaluate(columns, xp)
        if not names:
            return xp.zeros((*x.shape[:-1], len(outputs), 0))
        return xp.moveaxis(
            xp.stack([xp.stack(row) for row in entries]), (0, 1), (-2, -1)
        )  # a column in one piece

    def _call(self, x: Any, ny: int, xp: Any) -> Any:
        assert self.function is not None
        if x.ndim == 1:
            phi = self.function(x)
        else:
            from orthaug._base.jax import jax

            phi = jax.vmap(self.function)(x)
        wanted = (*x.shape[:-1], ny, len(self.parameters))
        if np.shape(phi) != wanted:
            raise InputError(
                f"the baseline function returned shape {np.shape(phi)[x.ndim - 1 :]} for one row; "
                f"expected (ny, nθ) = {wanted[x.ndim - 1 :]}."
            )
        return xp.asarray(phi)


_SHARED = (
    "initial",
    "unit",
    "fixed",
    "min",
    "max",
    "selected",
)  # what the terms of one parameter share


def _unify(terms: Sequence[Term]) -> list[Term]:
    """Return the terms with their parameters' attributes made common.

    An attribute that one term gives to a parameter holds in all of its terms.
    """
    said: dict[tuple[str, str], object] = {}
    for term in terms:
        check_parameter_name(term.parameter)
        check_label("" if term.unit is None else term.unit, f"the unit of '{term.parameter}'")
        check_type(term.fixed, bool, f"fixed of '{term.parameter}'", "true or false")
        check_type(
            term.output, str | None, f"output of '{term.parameter}'", "the name of an output"
        )
        for what, value in (
            ("initial value", term.initial),
            ("lower bound", term.min),
            ("upper bound", term.max),
        ):
            if value is not None:
                check_finite(value, f"the {what} of '{term.parameter}'")
        for attribute in _SHARED:
            value = getattr(term, attribute)
            if value is not None and said.setdefault((term.parameter, attribute), value) != value:
                first = said[term.parameter, attribute]
                raise InputError(
                    f"the terms of '{term.parameter}' disagree on `{attribute}`: "
                    f"{show(first)} and {show(value)}."
                )
    for term in terms:
        if term.fixed and (term.parameter, "initial") not in said:
            raise InputError(
                f"the term of '{term.parameter}' is fixed but gives no `initial`: its known "
                "coefficient."
            )
    return [
        replace(term, **{a: said.get((term.parameter, a), getattr(term, a)) for a in _SHARED})
        for term in terms
    ]


def _parameter(term: Term) -> Parameter:
    low = -math.inf if term.min is None else float(term.min)
    high = math.inf if term.max is None else float(term.max)
    own = float(term.initial or 0.0), term.unit or "", low, high, bool(term.selected)
    return Parameter(term.parameter, *own)


def derived_units(
    baseline: Baseline, outputs: Sequence[Channel], inputs: Sequence[Channel]
) -> dict[str, str]:
    """Return the unit of each parameter by its name, "1" where it has none.

    Units that do not follow from those of the channels are left out.

    Examples:
        >>> spring = Baseline.from_terms([Term("a", "y[k-1]"), Term("b", "u[k-1]")])
        >>> derived_units(spring, [Channel("y", "mm")], [Channel("u", "N")])
        {'a': '1', 'b': 'mm/N'}
    """
    units, constants = (
        {channel.name: channel.unit for channel in (*outputs, *inputs)},
        dict(baseline.constants),
    )
    found: dict[str, set[str | None]] = {}
    for term in baseline.terms:
        own = units[term.output or outputs[0].name]
        unit = coefficient_unit(own, parse(term.regressor, constants), units) if own else None
        found.setdefault(term.parameter, set()).add("1" if unit == "" else unit)
    agreed = {name: next(iter(given)) for name, given in found.items() if len(given) == 1}
    return {name: unit for name, unit in agreed.items() if unit is not None}


def regressor_of(
    baseline: Baseline,
    lags: Lags | None,
    learner_inputs: tuple[str, ...] | None,
    outputs: tuple[str, ...],
    inputs: tuple[str, ...],
) -> tuple[Layout, Features]:
    """Return the regressor of the whole model, and the learner's features of it.

    Raises:
        InputError: unknown channels, outputs at lag 0, learner inputs that cannot be read.
    """
    chosen = (
        in_order(baseline.lags, outputs, inputs) if lags is None else lags.layout(outputs, inputs)
    )
    features = Features.of(chosen)
    if learner_inputs is not None:
        if not learner_inputs:
            raise InputError(
                "the learner has no inputs; give `inputs` such as y[k-1], or leave the key out "
                "for all lags."
            )
        constants = dict(baseline.constants)
        try:
            expressions = [parse(text, constants) for text in learner_inputs]
            for expression in expressions:
                in_order(expression.lags, outputs, inputs)
        except InputError as error:
            raise InputError(f"learner input: {error}") from None
        features = Features(tuple(expressions))
    if baseline.function is not None:  # it takes the regressor exactly as `lags` orders it
        if lags is None:
            raise InputError(
                "a baseline function needs `lags`: they define the regressor x that it is "
                "called with."
            )
        missing = set(features.lags) - set(chosen)
        if missing:
            raise InputError(
                f"the learner inputs use {', '.join(map(str, missing))}, which `lags` does not "
                "contain."
            )
        return chosen, features
    return in_order((*chosen, *features.lags, *baseline.lags), outputs, inputs), features
