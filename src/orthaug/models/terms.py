"""A learner that can be read: a sum of terms, each with a coefficient."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any

import numpy as np
from annotated_types import Ge
from jaxtyping import Float

from orthaug._base.checks import Matrix
from orthaug._base.errors import InputError, show
from orthaug._base.jax import Array, jnp
from orthaug._base.lines import first_words
from orthaug._base.registry import OneOf, check_fields
from orthaug.data.regressors import Lags
from orthaug.data.terms import TermLibrary
from orthaug.models.beyond import BEYOND
from orthaug.models.learners import Scaling, Tree
from orthaug.physics.baseline import Baseline, regressor_of
from orthaug.physics.motion import Motion

_NAMED = 8  # terms
Names = tuple[str, ...]


@dataclass(frozen=True)
class Terms:
    """`f = Σ w_j t_j`, linear in its weights: training, intervals and the split are exact.

    Terms given by hand are what it sees. A `degree` adds all products of so many of its inputs, and
    `functions` of them, when the lags or the states are known (`over`).

    Args:
        terms: expressions such as `v[k-1]**3`, of a motion of states and inputs.
        degree: of the products, the constant included; 0 for none.
        functions: abs, sign, sqrt (of the size), tanh, sin, cos, exp; one in a product, times up to
            `degree − 1` signals.
        exclude: terms of the library to leave out.
        inputs: the signals that the library is made of; None for all lags, or all states and inputs
            of a motion.
        beyond: as of `MLP`; "auto" is "free", for terms are an equation that goes on as it is.

    Examples:
        >>> Terms(degree=2, exclude=["1"]).over(["x", "v"]).terms
        ('x', 'v', 'x**2', 'x*v', 'v**2')
        >>> Terms(("v[k-1]*abs(v[k-1])",)).terms
        ('v[k-1]*abs(v[k-1])',)
    """

    terms: tuple[str, ...] = ()
    degree: Annotated[int, Ge(0)] = 0
    functions: tuple[str, ...] = ()
    exclude: tuple[str, ...] = ()
    inputs: tuple[str, ...] | None = None
    beyond: Annotated[str, OneOf(BEYOND)] = field(default="auto", repr=False)

    def __post_init__(self) -> None:
        for name in ("terms", "functions", "exclude", "inputs"):
            given = getattr(self, name)
            if given is None and name == "inputs":
                continue
            if (
                isinstance(given, str)
                or not isinstance(given, Sequence)
                or any(not isinstance(t, str) for t in given)
            ):
                raise InputError(
                    f"`{name}` must be a tuple of texts, such as ('v[k-1]**3',); got {show(given)}."
                )
            object.__setattr__(self, name, tuple(given))
        check_fields(self)
        if self.functions and not self.degree:
            raise InputError(
                "`functions` are factors of products, so they need a `degree` of 1 or more."
            )
        if not self.degree:
            if not self.terms:
                raise InputError("a learner of terms needs `terms`, or a `degree` of 1 or more.")
            library = TermLibrary.of((), 0, (), self.terms, self.exclude)
            object.__setattr__(self, "terms", library.texts)
            object.__setattr__(self, "exclude", ())
            object.__setattr__(self, "inputs", self.terms)
        TermLibrary.of((), 0, self.functions)  # refuses unknown functions before there are signals

    def __str__(self) -> str:
        named = first_words(self.terms, _NAMED)
        return f"terms {named}" if not self.degree else f"all terms to the degree {self.degree}"

    linear = True
    """Its values are linear combinations of its features."""

    def over(self, signals: Sequence[str]) -> Terms:
        """Return a learner whose library is written out over signals.

        `terms` are then all that it sees.

        Raises:
            InputError: too many terms, or an excluded one that is none.
        """
        if not self.degree:
            return self
        texts = self.library(signals).texts
        return replace(self, terms=texts, degree=0, functions=(), exclude=(), inputs=texts)

    def library(self, signals: Sequence[str]) -> TermLibrary:
        """Return the terms as products of few factors."""
        own = signals if self.inputs is None or not self.degree else self.inputs
        return TermLibrary.of(own, self.degree, self.functions, self.terms, self.exclude)

    def among(self, kept: Sequence[str]) -> Terms:
        """Return a learner with some of its terms."""
        return Terms(tuple(kept), beyond=self.beyond)

    def scaling(self, features: Matrix) -> Scaling:
        """Return a scaling of each term by its largest size, without an offset.

        Coefficients stay those of the terms.
        """
        size = np.abs(features).max(axis=0, initial=0.0)
        return Scaling(np.zeros(len(size)), np.where(size > 0, size, 1.0))

    def weights(self, nz: int, ny: int) -> int:
        """Return the number of weights for `nz` features and `ny` outputs."""
        return nz * ny

    def silent(self, tree: Tree) -> Tree:
        """Return zeros for all coefficients."""
        return np.zeros_like(tree)

    def groups(self, tree: Tree) -> Tree:
        """Return a group for each term."""
        return np.broadcast_to(np.arange(np.shape(tree)[1]), np.shape(tree))

    def layers(self, tree: Tree) -> list[tuple[object, object, str]]:
        """Return one layer without bias."""
        return [(tree, None, "identity")]

    def init(self, key: Array, nz: int, ny: int) -> Tree:
        return np.zeros((ny, nz))

    def apply(self, tree: Tree, z: Float[Array, "nz"]) -> Float[Array, "ny"]:
        return jnp.asarray(tree) @ z


def over_lags(
    learner: Any, baseline: Baseline, lags: Lags | None, outputs: Names, inputs: Names
) -> Any:
    """Return a learner whose library is written out over the lags.

    Other learners are returned unchanged.
    """
    if not hasattr(learner, "over"):
        return learner
    return learner.over(
        [str(lag) for lag in regressor_of(baseline, lags, None, outputs, inputs)[0]]
    )


def over_states(learner: Any, motion: Motion) -> Any:
    """Return a learner whose library is written out over a motion's states and inputs."""
    return learner.over([*motion.visible]) if hasattr(learner, "over") else learner


def scaling_of(learner: Any, features: Matrix) -> Scaling:
    """Return the scaling of a learner's features (N, nz): its own, or into [-1, 1]."""
    return learner.scaling(features) if hasattr(learner, "scaling") else Scaling.fit(features)
