"""Saved models: `model.json` for what a model is, `arrays.safetensors` for its numbers.

Every model has channels, numbers, statistics of training and a learner. Its physics are terms on
lagged signals, or equations of motion as text. A file holds neither kind nor fields of a callable.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from orthaug._base.checks import check_type, is_number
from orthaug._base.errors import InputError, MissingFileError, show
from orthaug._base.folders import whole_folder
from orthaug._base.jax import jax
from orthaug._base.registry import freeze
from orthaug.data.channels import Channel
from orthaug.data.expressions import SAMPLING_TIME, Expression, Lag, parse_named
from orthaug.data.record import Preparation
from orthaug.data.regressors import Features
from orthaug.models.dynamics import Numbers
from orthaug.models.kinds import LEARNERS
from orthaug.models.lagged import LaggedDynamics
from orthaug.models.learners import Bound, Learner, nothing_learned
from orthaug.models.model import HoldsModel, Model, TrainedSegments, model_of
from orthaug.models.moving import MotionDynamics
from orthaug.models.packed_files import has_files, pack, read_packed, write_packed
from orthaug.models.starts import EstimatedStates
from orthaug.models.statistics import Statistics
from orthaug.physics import source_kinds
from orthaug.physics.baseline import Baseline, Parameter, Term
from orthaug.physics.closed_loop import close_loop, controller_of
from orthaug.physics.consent import CONSENTS
from orthaug.physics.controller import Controller
from orthaug.physics.innovations import InnovationsModel
from orthaug.physics.motion import Motion
from orthaug.physics.noise import NoiseModel
from orthaug.physics.parameters import PhysicalParameter
from orthaug.physics.states import Output, State

FORMAT = 2
_DECLARATION, _ARRAYS = "model.json", "arrays.safetensors"
_LONGEST_LAG = 1_000_000  # rows: a state has an entry for each
_WORDS = ("structure", "measure", "sampling_time", "time_column")  # of every model, as they are
_LIMITS = {"min": -math.inf, "max": math.inf}
_SEGMENTATION = ("segment", "washout", "rows")  # of `TrainedSegments`
_ON_SEGMENTS = ("states", "alone", "slope")


def save(model: Model | HoldsModel, folder: str | Path, *, force: bool = False) -> None:
    """Write a model to a folder of its own, whole or not at all.

    A model that `save` wrote there before is replaced.

    A baseline, motion or learner that is a Python callable cannot be written. Its numbers can;
    `load` asks for the callable.

    Args:
        model: what to write; of a fit its model.
        folder: a new one, or one that holds a saved model.
        force: replace the folder whatever it holds.

    Raises:
        InputError: no model; the folder cannot be written, or holds something else.

    Examples:
        >>> import tempfile
        >>> import numpy as np
        >>> import orthaug as oa
        >>> record = oa.Record.from_arrays(u=np.sin(np.arange(50.0)), y=2 * np.sin(np.arange(50.0)))
        >>> physics = oa.Baseline.from_terms([oa.Term("gain", "u[k]")])
        >>> fit = oa.estimate(record, physics, learner=None)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save(fit, Path(folder, "model"))
        ...     load(Path(folder, "model"))
        Model(orthogonal, gain = 2, learner: none)
    """
    model = model_of(model)
    with whole_folder(Path(folder), force=force) as partial:
        write(model, partial)


def write(model: Model, folder: Path) -> None:
    """Write the two files into an existing folder, with the file that its physics come from."""
    write_packed(_pack(model), folder / _DECLARATION, folder / _ARRAYS)
    source_kinds.write_kept(getattr(getattr(model.form, "motion", None), "source", None), folder)


def digest(model: Model) -> str:
    """Return the sha256 that identifies a model: `checksum` in the file of this version."""
    return _pack(model)[0]["checksum"]


def _pack(model: Model) -> tuple[dict[str, Any], bytes]:
    """Return the contents of the two files."""
    return pack(FORMAT, *_declare(model))


def load(
    folder: str | Path,
    *,
    baseline: Baseline | Motion | None = None,
    learner: Learner | None = None,
    run_fmu: bool = False,
) -> Model:
    """Read a model that `save` or `orthaug fit` wrote.

    Args:
        folder: the model's folder, or the result folder that holds it as `model/`.
        baseline, learner: the Python callables again, where the saved model had such; a motion
            counts as a baseline.
        run_fmu: whether the native code of an FMU in the model may run. One that this program, or
            a spec that was fitted on this account, names itself runs without.

    Raises:
        InputError: no model there; a file that is cut, altered, or from a newer version; an FMU
            without consent.
    """
    check_type(folder, str | os.PathLike, "folder", "a folder's name")
    folder = Path(folder)
    if not has_files(folder, _DECLARATION) and has_files(folder / "model", _DECLARATION):
        folder = folder / "model"
    if not has_files(folder, _DECLARATION, _ARRAYS):
        raise MissingFileError(
            f"{folder}: no saved model there; expected {_DECLARATION} and {_ARRAYS}."
        )
    declared, arrays = read_packed(
        folder / _DECLARATION, folder / _ARRAYS, FORMAT, "model", "fit again, or copy it again"
    )
    path = folder / _DECLARATION
    try:
        with CONSENTS.given_to_all(run_fmu):
            model = _rebuild(declared, arrays, baseline, learner, path)
        check_loaded(model, path)
        return model
    except InputError:
        raise
    except (
        Exception
    ) as error:  # the checksum holds, so someone made it: there is no list of what that can hold
        raise InputError(
            f"{path}: not a model of this version (missing or misplaced: {error})."
        ) from None


def _declare(model: Model) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return the declaration of a model, and its arrays; arrays that are None are left out."""
    kind = next(name for name, physics in _PHYSICS.items() if type(model.form) is physics.form)
    kept, form = model.statistics, model.form
    of_form, of_training, own_arrays = _PHYSICS[kind].declare(model)
    declared = {"kind": kind} if kind != _FIRST else {}
    declared |= {name: getattr(model, name) for name in _WORDS}
    declared |= {
        group: [asdict(channel) for channel in getattr(model, group)]
        for group in ("outputs", "inputs")
    }
    declared |= {"flown": kept.simulated, "verdict": kept.verdict}
    if model.prepared:
        declared["prepared"] = [asdict(step) for step in model.prepared]
    if model.experiment_column:
        declared["experiment_column"] = model.experiment_column
    declared |= of_form | {"learner": _declare_bound(form.bound)} | of_training
    arrays = {f"numbers.{name}": value for name, value in model.numbers._asdict().items()}
    arrays |= {
        "largest_output": model.largest_output,
        "deviation": model.deviation,
        "output_weight": model.weight,
        "scalars": np.array([0.0 if np.ndim(kept.ridge) else kept.ridge, kept.freedom]),
        "gram": kept.gram,
        "noise": kept.noise,
        "middle": kept.middle,
        "disturbance": kept.disturbance,
        "sensor": kept.sensor,
        "ridge": kept.ridge if np.ndim(kept.ridge) else None,
        **own_arrays,
    }
    return declared, {
        name: np.asarray(value) for name, value in arrays.items() if value is not None
    }


def _rebuild(
    declared: dict[str, Any],
    arrays: dict[str, np.ndarray],
    given: object,
    learner: Learner | None,
    path: Path,
) -> Model:
    """Return the model that a file declares.

    Raises:
        InputError: a callable is asked for.
    """
    kind = _PHYSICS[declared.get("kind", _FIRST)]
    physics = kind.rebuild(declared, given, path)
    weights = arrays.get("numbers.weights", np.zeros(0))
    outputs = len(declared["outputs"]) if kind.adds_to_outputs else 0
    bound = _rebuild_bound(declared["learner"], weights, learner, outputs, path)
    channels = {
        group: tuple(Channel(**channel) for channel in declared[group])
        for group in ("outputs", "inputs")
    }
    statistics = Statistics(
        gram=arrays.get("gram"),
        middle=arrays.get("middle"),
        noise=arrays.get("noise"),
        ridge=arrays["ridge"] if "ridge" in arrays else float(arrays["scalars"][0]),
        freedom=float(arrays["scalars"][1]),
        simulated=bool(declared.get("flown", kind.simulated)),
        verdict=str(declared.get("verdict", "")),
        disturbance=arrays.get("disturbance"),
        sensor=arrays.get("sensor"),
    )
    # models that weighed every output by itself kept `weight`, the inverse of the deviation
    return Model(
        numbers=Numbers(
            **{n: arrays.get(f"numbers.{n}") for n in Numbers._fields}  # type: ignore[arg-type]
        ),
        statistics=statistics,
        **{name: declared[name] for name in _WORDS},
        **channels,
        largest_output=arrays["largest_output"],
        deviation=arrays["deviation"] if "deviation" in arrays else 1 / arrays["weight"],
        weight=arrays["output_weight"] if "output_weight" in arrays else np.diag(arrays["weight"]),
        prepared=tuple(Preparation(**step) for step in declared.get("prepared", ())),
        experiment_column=declared.get("experiment_column"),
        **kind.fields(declared, arrays, physics, bound),
    )


class _Physics(NamedTuple):
    """The part of a file that depends on the kind of physics."""

    form: type[Any]
    declare: Callable[[Any], tuple[dict[str, Any], dict[str, Any], dict[str, Any]]]
    """Returns the form and the training as a file declares them, and their arrays."""
    rebuild: Callable[[dict[str, Any], Any, Path], Any]
    """Returns the physics that a file declares; of a callable the given one."""
    fields: Callable[[dict[str, Any], dict[str, np.ndarray], Any, Bound], dict[str, Any]]
    """Returns the form and the other fields that only these models have."""
    adds_to_outputs: bool
    """True if a learner adds to every output."""
    simulated: bool
    """True if files that do not say so were trained on a free run."""


def _declare_lagged(
    model: Model[LaggedDynamics],
) -> tuple[dict[str, Any], dict[str, Any], dict[str, Any]]:
    form, baseline = model.form, model.form.baseline
    declared = {
        "layout": [list(lag) for lag in form.layout],
        "features": [
            {"text": e.text, "constants": dict(e.constants)} for e in form.features.entries
        ],
        "baseline": {
            "kind": "terms" if baseline.function is None else "callable",
            "parameters": [asdict(parameter) for parameter in baseline.parameters],
            "terms": [asdict(term) for term in baseline.terms],
            "constants": dict(baseline.constants),
        },
    }
    arrays = {"shared": model.shared}
    if isinstance(model.noise, NoiseModel):
        declared["noise"] = [list(orders) for orders in model.noise.orders]
        arrays |= {"noise.values": model.noise.values, "noise.covariance": model.noise.covariance}
    return declared, {}, arrays


def _rebuild_noise(declared: dict[str, Any], arrays: dict[str, np.ndarray]) -> NoiseModel | None:
    """Return the noise model that a file declares; None for white errors, as of older files."""
    if "noise" not in declared:
        return None
    orders = tuple((int(p), int(q)) for p, q in declared["noise"])
    noise = NoiseModel.of(orders, arrays["noise.values"])
    return replace(noise, covariance=arrays.get("noise.covariance"))


def _rebuild_baseline(declared: dict[str, Any], given: Baseline | None, path: Path) -> Baseline:
    physics = declared["baseline"]
    if physics["kind"] == "terms":
        terms = [Term(**term) for term in physics["terms"]]
        return Baseline.from_terms(terms, physics["constants"])
    if given is None:
        raise InputError(
            f"{path}: the baseline was a Python function; give it again, load(…, baseline=…)."
        )
    return replace(given, parameters=tuple(Parameter(**p) for p in physics["parameters"]))


def _lagged_fields(
    declared: dict[str, Any], arrays: dict[str, np.ndarray], baseline: Baseline, bound: Bound
) -> dict[str, Any]:
    entries = tuple(
        Expression(e["text"], tuple(e["constants"].items()))
        for e in declared["features"][: bound.nz]
    )
    form = LaggedDynamics(
        baseline,
        Features(entries, bound.linear),
        tuple(Lag(*lag) for lag in declared["layout"]),
        tuple(channel["name"] for channel in declared["outputs"]),
        bound,
    )
    noise = _rebuild_noise(declared, arrays)
    return {"form": form, "shared": arrays.get("shared"), "noise": noise}


def _declare_motion(
    model: Model[MotionDynamics],
) -> tuple[dict[str, Any], dict[str, Any], dict[str, Any]]:
    form, trained = model.form, model.trained
    loop, motion = form.motion, form.motion.plant
    source = {} if motion.source is None else {"source": source_kinds.declare(motion.source)}
    of_form = {
        "motion": {
            "kind": "equations" if motion.functions is None else "callable",
            **source,
            "states": [asdict(state) for state in motion.states],
            "outputs": [asdict(output) for output in motion.outputs],
            "inputs": list(motion.inputs),
            "parameters": _declare_parameters(motion.parameters),
            "constants": dict(motion.constants),
            "define": {name: expression.text for name, expression in motion.definitions},
            "integrator": motion.integrator,
            "substeps": motion.substeps,
            "hold": motion.hold,
        },
        "features": [entry.text for entry in form.features],
    }
    controller = controller_of(loop)
    if controller is not None:
        own = {"parameters": _declare_parameters(controller.parameters), "inputs": loop.external}
        of_form["controller"] = asdict(controller) | own
    of_training: dict[str, Any] = {
        "substeps": form.substeps,
        "window": model.window,
        "trained": None,
    }
    assert isinstance(model.starts, EstimatedStates)
    arrays = {"loose": model.starts.loose, "seen": model.seen}
    if isinstance(model.noise, InnovationsModel):
        of_form["noise"] = "innovations"
        arrays |= {"noise.gain": model.noise.gain, "noise.covariance": model.noise.covariance}
    if trained is not None:
        of_training["trained"] = {key: getattr(trained, key) for key in _SEGMENTATION}
        arrays |= {f"trained.{key}": getattr(trained, key) for key in _ON_SEGMENTS}
    return of_form, of_training, arrays


def _declare_parameters(parameters: Sequence[PhysicalParameter]) -> list[dict[str, Any]]:
    """Return the fields of parameters, None for a limit that is infinite."""
    entries = [asdict(parameter) for parameter in parameters]
    return [e | {k: None for k, limit in _LIMITS.items() if e[k] == limit} for e in entries]


def _rebuild_parameters(kept: Any) -> list[PhysicalParameter]:
    return [
        PhysicalParameter(**(p | {k: limit for k, limit in _LIMITS.items() if p[k] is None}))
        for p in kept
    ]


def _rebuild_motion(declared: dict[str, Any], given: Any, path: Path) -> Motion:
    motion = _rebuild_plant(declared, given, path)
    kept = declared.get("controller")
    if kept is None:
        return motion
    controller = Controller(
        outputs=tuple(map(tuple, kept["outputs"])),
        states=tuple(State(**state) for state in kept["states"]),
        parameters=tuple(_rebuild_parameters(kept["parameters"])),
        constants=tuple(map(tuple, kept["constants"])),
        definitions=tuple(map(tuple, kept["definitions"])),
    )
    outputs = [channel["name"] for channel in declared["outputs"]]
    return close_loop(motion, controller, kept["inputs"], outputs)


def _rebuild_plant(declared: dict[str, Any], given: Any, path: Path) -> Motion:
    kept = declared["motion"]
    parameters = _rebuild_parameters(kept["parameters"])
    states, outputs = [State(**s) for s in kept["states"]], [Output(**o) for o in kept["outputs"]]
    options = {name: kept[name] for name in ("integrator", "substeps", "hold")}
    if kept["kind"] == "equations":
        named = {"constants": kept["constants"], "define": kept["define"]}
        return Motion.from_equations(
            states, outputs, parameters, kept["inputs"], **named, **options
        )
    if given is None and "source" in kept:
        names = [o.name for o in outputs]
        given = source_kinds.rebuild(kept["source"], path.parent).build(kept["inputs"], names)
    if not isinstance(given, Motion) or given.functions is None:
        raise InputError(
            f"{path}: the motion was two Python functions; give them again, load(…, "
            "baseline=Motion…)."
        )
    if given.names_of_states != tuple(s.name for s in states) or given.names != tuple(
        p.name for p in parameters
    ):
        raise InputError(
            f"{path}: the saved motion has the states {', '.join(s.name for s in states)} and "
            f"the parameters {', '.join(p.name for p in parameters)}; give the same one."
        )
    if SAMPLING_TIME in kept["constants"]:
        given = given.sampled(kept["constants"][SAMPLING_TIME])
    return replace(
        given,
        parameters=tuple(parameters),
        constants=tuple(kept["constants"].items()),
        states=tuple(states),
        outputs=tuple(outputs),
        inputs=tuple(kept["inputs"]),
        **options,
    )


def _motion_fields(
    declared: dict[str, Any], arrays: dict[str, np.ndarray], motion: Motion, bound: Bound
) -> dict[str, Any]:
    form = MotionDynamics(
        motion=motion,
        features=tuple(
            parse_named(text, motion.known, "learner input") for text in declared["features"]
        ),
        bound=bound,
        sampling_time=float(declared["sampling_time"]),
        substeps=int(declared["substeps"]),
    )
    kept, trained = declared["trained"], None
    if kept is not None:
        own: dict[str, Any] = {key: int(kept[key]) for key in _SEGMENTATION}
        own |= {key: arrays.get(f"trained.{key}") for key in _ON_SEGMENTS}
        trained = TrainedSegments(**own)
    noise = None
    if declared.get("noise") == "innovations":
        noise = InnovationsModel(arrays["noise.gain"], arrays.get("noise.covariance"))
    return {
        "form": form,
        "starts": EstimatedStates(int(declared["window"]), arrays["loose"]),
        "trained": trained,
        "seen": arrays.get("seen"),
        "noise": noise,
    }


_FIRST = "lagged"  # a file of this kind does not name it: once there was no other
_PHYSICS = {
    _FIRST: _Physics(
        LaggedDynamics, _declare_lagged, _rebuild_baseline, _lagged_fields, True, False
    ),
    "motion": _Physics(
        MotionDynamics, _declare_motion, _rebuild_motion, _motion_fields, False, True
    ),
}


def _declare_bound(bound: Bound) -> dict[str, Any] | None:
    """Return the declaration of a learner; None without one."""
    if not bound.learns:
        return None
    return _declare_learner(bound.learner) | {"nz": bound.nz, "ny": bound.ny}


def _declare_learner(learner: Learner) -> dict[str, Any]:
    """Return kind and fields of a learner."""
    kind = LEARNERS.kind_of(learner)
    if kind is None:
        return {"kind": "callable"}
    return {"kind": kind} | {name: getattr(learner, name) for name in _field_names(type(learner))}


def _rebuild_learner(kept: dict[str, Any], given: Learner | None, path: Path) -> Learner:
    """Return the learner that a file declares.

    For a callable it is the given one.
    """
    kind = kept["kind"]
    if kind in LEARNERS or (given is None and kind != "callable" and kind in LEARNERS.discover()):
        learner = LEARNERS[kind]
        return learner(
            **{name: freeze(kept[name]) for name in _field_names(learner) if name in kept}
        )
    if given is not None:
        return given
    if kind != "callable":
        raise InputError(
            f"{path}: its learner is of the kind '{kind}', which is not registered here; "
            "register it, or give the learner, load(…, learner=…)."
        )
    raise InputError(
        f"{path}: the learner was a Python callable; give it again, load(…, learner=…)."
    )


def _field_names(learner: type) -> list[str]:
    return [field.name for field in fields(learner) if field.init]


def _rebuild_bound(
    kept: dict[str, Any] | None,
    weights: np.ndarray,
    given: Learner | None,
    outputs: int,
    path: Path,
) -> Bound:
    """Return the learner that a file declares with its sizes.

    Args:
        outputs: to which nothing is added where the file declares no learner.

    Raises:
        InputError: a learner that is not known here, or has another number of weights.
    """
    if kept is None:
        return nothing_learned(outputs)
    bound = Bound(_rebuild_learner(kept, given, path), kept["nz"], kept["ny"])
    saved = weights.shape[-1]
    if bound.size != saved:
        raise InputError(
            f"{path}: the learner has {bound.size} weights, the saved one {saved}; give the "
            "same one."
        )
    return bound


def check_loaded(model: Model, path: Path) -> None:
    """Refuse a model whose numbers have other sizes than its form, or are not finite.

    Raises:
        InputError: the first part that does not fit.
    """
    if not is_number(model.sampling_time) or model.sampling_time <= 0:
        raise InputError(
            f"{path}: its sampling time is {show(model.sampling_time)}; expected a positive number."
        )
    for name in ("structure", "measure", "time_column", "experiment_column"):
        if not isinstance(getattr(model, name), str | None):
            raise InputError(
                f"{path}: its {name} is {show(getattr(model, name))}; expected a word."
            )
    for name, value, shape in _expected_arrays(model):
        if value is None:
            raise InputError(f"{path}: the model has no {name}; it was not written by orthaug.")
        array = np.asarray(value)
        if shape is not None and array.shape != shape:
            raise InputError(
                f"{path}: {name} has the shape {array.shape}; the model's form needs {shape}."
            )
        if not np.isfinite(array).all():
            raise InputError(
                f"{path}: {name} holds a number that is not finite; fit again, or copy the "
                "model again."
            )
    for name, value in (("deviation", model.deviation), ("halfwidth", model.numbers.halfwidth)):
        if (np.asarray(value) < 0).any():
            raise InputError(f"{path}: {name} is negative; it was not written by orthaug.")
    for entry in model.form.entries:
        if not isinstance(entry.text, str):
            raise InputError(
                f"{path}: a learner's input is {show(entry.text)}; expected an expression."
            )
    for lag in getattr(model.form, "layout", ()):
        if type(lag.lag) is not int or not 0 <= lag.lag <= _LONGEST_LAG:
            raise InputError(
                f"{path}: its layout has a lag of {show(lag.lag)}; expected 0 to "
                f"{_LONGEST_LAG} rows."
            )
    if model.form.differentiable:
        _check_step(model, path)


def _check_step(model: Model, path: Path) -> None:
    """Trace one step, which computes nothing, to check the shapes.

    Expressions, layout and learner must fit the channels and the state.
    """
    state, row = np.zeros(len(model.state_names)), np.zeros(len(model.step_inputs))
    following, outputs = jax.eval_shape(model.step, state, row)
    shapes = tuple(following.shape), tuple(outputs.shape)
    if shapes != (state.shape, (len(model.outputs),)):
        raise InputError(
            f"{path}: a step of the model makes {shapes}; its state and outputs need other shapes."
        )


def _expected_arrays(model: Model) -> Iterator[tuple[str, Any, tuple[int, ...] | None]]:
    """Return names, values and shapes of all arrays that a model computes with.

    The shape is None where something else has checked it.
    """
    form, numbers, kept = model.form, model.numbers, model.statistics
    outputs, parameters = len(model.outputs), len(model.estimated[0])
    yield "theta", numbers.theta, (parameters,)
    yield "theta_aux", numbers.theta_aux, (parameters,)
    yield "largest_output", model.largest_output, (outputs,)
    yield "deviation", model.deviation, (outputs,)
    yield "output_weight", model.weight, (outputs, outputs)
    yield "centre", numbers.centre, (form.bound.nz,)
    yield "halfwidth", numbers.halfwidth, (form.bound.nz,)
    yield "gain", numbers.gain, (form.bound.ny,)
    yield "weights", numbers.weights, None
    for name in ("tilt", "pull"):
        if getattr(numbers, name) is not None:
            yield name, getattr(numbers, name), None
    noise = getattr(model, "noise", None)
    if isinstance(noise, NoiseModel):
        yield "noise model", noise.values, (sum(map(sum, noise.orders)),)
    if isinstance(noise, InnovationsModel):
        yield "gain of the predictor", noise.gain, (form.states, outputs)
    square = (outputs, outputs)
    for name, value, shape in (
        ("noise", kept.noise, square),
        ("gram", kept.gram, None),
        ("middle", kept.middle, None if kept.gram is None else np.shape(kept.gram)),
        ("disturbance", kept.disturbance, None),
        ("sensor", kept.sensor, square),
    ):
        if value is not None:
            yield name, value, shape
