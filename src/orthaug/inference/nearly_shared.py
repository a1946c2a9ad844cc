"""Intervals beside a learner that could nearly imitate a direction of the physics.

What functions of the features leave of a direction, a share λ of its squares, is all that
determines it beside *any* such function. So its variance is at least that of physics alone over λ,
whatever the trained learner's own tangents say: those of other weights follow more of it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from orthaug._base.checks import Matrix
from orthaug._base.errors import Warning
from orthaug._base.lines import join_words, percent
from orthaug.models.statistics import JointCovariance, Statistics
from orthaug.physics.motion import Motion
from orthaug.physics.shared import SharedDirections

# share of a direction's squares below which it is split off, and has the variance of the split
_NOTHING = 1e-3


def enlarge_covariance(
    covariance: Matrix | None, statistics: Statistics, shared: SharedDirections | None
) -> Matrix | None:
    """Return Cov θ̂ (nθ, nθ), larger along directions that the features leave little of.

    With `D = Σ v_i λ_i^(−1/2) v_iᵀW` of `L v_i = λ_i W v_i`, W the Gram matrix of the slopes and L
    of what is left of them, the least covariance is `D C Dᵀ`, C that of physics alone.
    """
    if (
        covariance is None
        or shared is None
        or not shared.nearly
        or not np.isfinite(covariance).all()
    ):
        return covariance
    rest, gram, middle = shared.rest, statistics.gram, statistics.middle
    nt = len(covariance)
    if rest is None or gram is None or middle is None or not np.isfinite(gram).all():
        return covariance
    alone = JointCovariance(gram[:nt, :nt], 0.0, middle[:nt, :nt], nt).of(np.eye(nt))
    size = np.sqrt(np.maximum(np.diag(rest.whole), 1e-300))
    values, vectors = np.linalg.eigh(rest.whole / np.outer(size, size))
    kept = values > 1e-10 * values.max()
    white = (vectors[:, kept] / np.sqrt(values[kept])) / size[:, None]
    shares, turned = np.linalg.eigh(white.T @ rest.left @ white)
    directions = white @ turned
    factor = np.where(shares > _NOTHING, 1 / np.sqrt(np.clip(shares, _NOTHING, 1.0)), 1.0)
    d = (directions * factor) @ directions.T @ rest.whole
    least = d @ alone @ d.T
    unit = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    values, vectors = np.linalg.eigh((least - covariance) / np.outer(unit, unit))
    more = (vectors * np.maximum(values, 0.0)) @ vectors.T
    return covariance + more * np.outer(unit, unit)


def shared_warnings(shared: SharedDirections | None, inputs: Sequence[str]) -> list[Warning]:
    """Return warnings where the rows contradict directions that the names call determined.

    Args:
        inputs: what the learner sees.
    """
    if shared is None or shared.rest is None:
        return []
    found, sees = [], ", ".join(inputs)
    remedy = (
        "Give data in which it moves independently, a learner with fewer inputs, or a learner "
        'of named terms (kind = "terms").'
    )
    if shared.on_data:
        share = dict(zip(shared.names, shared.rest.share, strict=True))
        names = " and ".join(f"{name} ({percent(share[name], 2)} left)" for name in shared.on_data)
        text = (
            f"on these rows, functions of the learner's inputs ({sees}) reproduce the "
            f"regressor of {names}, although its expression reads other signals. Up to "
            f"{percent(shared.rest.limit, 2)} would be left of a function that the learner can "
            "form exactly. The data do not separate the parameter from the learner, so it is "
            "split off as a direction that the learner could imitate. Its interval excludes "
            f"any share that the learner took. {remedy}"
        )
        found.append(Warning("shared_on_data", text))
    nearly = {name: share for name, share in shared.nearly.items() if name not in shared.on_data}
    if nearly:
        names = " and ".join(
            f"{percent(share, 2)} of the regressor of {name}" for name, share in nearly.items()
        )
        text = (
            f"functions of the learner's inputs ({sees}) explain all but {names} on these "
            "rows. Only this part determines the parameter, which widens its interval. "
            f"{remedy}"
        )
        found.append(Warning("nearly_shared", text))
    if shared.little:
        names = " and ".join(
            f"{percent(share, 2)} of the regressor of {name}"
            for name, share in shared.little.items()
        )
        text = (
            f"functions of the learner's inputs ({sees}) follow all but {names}: only this part "
            "determines the parameter. An effect that the physics lacks and that depends on the "
            "same signals as this part goes into the parameter in full, and its interval does "
            "not count it. Compare the value with that of physics alone. "
            "Where they differ, declare the effect in [[suspects]] or write it into the physics, "
            "or give data in which these signals move more."
        )
        found.append(Warning("little_left", text))
    return found


def output_warnings(motion: Motion) -> tuple[Warning, ...]:
    """Return a warning on outputs that have parameters of an equation with a learner, but no own.

    A measured acceleration is that: what its equation lacks is missing in the output, too.
    """
    states, outputs = motion.learned
    if motion.functions is not None or not states:
        return ()
    learned = {name for i in states for name in motion.parameters_in(motion.names_of_states[i])}
    uses = {}
    for i, output in enumerate(motion.outputs):
        own = [name for name in motion.parameters_of_output(i) if name in learned]
        if own and i not in outputs:
            uses[output.name] = own
    if not uses:
        return ()
    names = [*dict.fromkeys(name for own in uses.values() for name in own)]
    have = "has" if len(uses) == 1 else "have"
    text = (
        f"{join_words(list(uses))} {have} the parameters {join_words(names)} of equations with a "
        "learner, but no learner. What the physics lacks there is missing in the output as well, "
        "and moves these parameters; their intervals do not count it. Give the output a learner, "
        "too (`learned = true`)."
    )
    return (Warning("output_without_learner", text),)
