"""A function of JAX as a program of scalars, with what is known folded away.

Algorithms for trees of bodies work on small arrays that are mostly constant: turns about fixed
axes, offsets that are zero, masks. The function is traced once, its arrays are taken apart, and
what is constant, zero or computed twice is gone. Of a cart with a pole, 4,062 operations on arrays
become 129 on numbers, and programs made of them compile ten times as fast.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from orthaug._base.jax import jax, jnp
from orthaug.physics.array_moves import MOVES, filling, fills, scattered

_LARGEST_RULE = 3  # rows of a system that is solved by determinants, which need no pivots
_LARGEST_INVERSE = 8  # rows of a matrix whose factorization is written out

# By the names of `jax.lax`, their counterparts in NumPy
_ELEMENTWISE = {
    "abs": "abs",
    "acos": "arccos",
    "add": "add",
    "and": "logical_and",
    "asin": "arcsin",
    "atan2": "arctan2",
    "ceil": "ceil",
    "cos": "cos",
    "div": "divide",
    "eq": "equal",
    "exp": "exp",
    "floor": "floor",
    "ge": "greater_equal",
    "gt": "greater",
    "le": "less_equal",
    "log": "log",
    "lt": "less",
    "max": "maximum",
    "min": "minimum",
    "mul": "multiply",
    "ne": "not_equal",
    "neg": "negative",
    "not": "logical_not",
    "or": "logical_or",
    "pow": "power",
    "sign": "sign",
    "sin": "sin",
    "sqrt": "sqrt",
    "sub": "subtract",
    "tan": "tan",
    "tanh": "tanh",
}
_OF_LAX = {"and": "bitwise_and", "not": "bitwise_not", "or": "bitwise_or"}
_CONDITIONS = ("and", "eq", "ge", "gt", "le", "lt", "ne", "not", "or")
_WITH_RULES = ("custom_jvp_call", "custom_vjp_call")
_CALLS = ("jit", "pjit", "closed_call", "core_call", "remat")


@dataclass(frozen=True)
class Operation:
    """One operation of a program: its name and the numbers of the operations it reads.

    `name` is that of JAX, or one of these: "input" reads a place among all inputs, "constant" a
    value and whether it is a condition, "select" a condition and the values if true and if false,
    "call" the number of what could not be taken apart and what that reads, and "part" a call, one
    of its outputs and an element.
    """

    name: str
    reads: tuple[Any, ...]

    @property
    def sources(self) -> tuple[int, ...]:
        """Operations whose results it reads."""
        if self.name in ("input", "constant"):
            return ()
        if self.name == "call":
            return self.reads[1:]
        return self.reads[:1] if self.name == "part" else self.reads

    def value(self, read: Sequence[Any]) -> Any:
        """Return the result for numbers in place of `sources`, by NumPy."""
        if self.name == "select":
            return read[1] if read[0] else read[2]
        with np.errstate(all="ignore"):
            return getattr(np, _ELEMENTWISE[self.name])(*read).item()


@dataclass(frozen=True, eq=False)
class Call:
    """What stays an operation of JAX: loops, and what has derivatives of its own."""

    equation: Any = field(repr=False)
    arguments: tuple[Any, ...] = field(repr=False)  # known arrays, or their shapes of scalars


@dataclass(frozen=True, eq=False)
class ScalarProgram:
    """Operations in their order, and which of them are the outputs.

    Call it with arrays of the shapes that it was made for.
    """

    operations: tuple[Operation, ...]
    calls: tuple[Call, ...]
    outputs: tuple[np.ndarray, ...] = field(repr=False)  # numbers of operations
    single: bool

    def __len__(self) -> int:
        """Count operations other than inputs and constants."""
        return sum(1 for each in self.operations if each.name not in ("input", "constant"))

    def __call__(self, *arguments: Any) -> Any:
        """Return what the function returns, by JAX."""
        flat = [array[at] for array in arguments for at in np.ndindex(array.shape)]
        values: list[Any] = []
        for each in self.operations:
            values.append(self._value(each, flat, values))
        found = [
            jnp.stack([jnp.asarray(values[i], float) for i in numbers.ravel()]).reshape(
                numbers.shape
            )
            for numbers in self.outputs
        ]
        return found[0] if self.single else tuple(found)

    def _value(self, each: Operation, flat: Sequence[Any], values: Sequence[Any]) -> Any:
        if each.name == "constant":
            return each.reads[0]
        if each.name == "input":
            return flat[each.reads[0]]
        if each.name == "call":
            return self._called(self.calls[each.reads[0]], [values[i] for i in each.reads[1:]])
        if each.name == "part":
            source, output, element = each.reads
            return values[source][output].ravel()[element]
        read = [values[i] for i in each.reads]
        if each.name == "select":
            return jnp.where(*read)
        return getattr(jax.lax, _OF_LAX.get(each.name, each.name))(*read)

    @staticmethod
    def _called(call: Call, scalars: Sequence[Any]) -> Sequence[Any]:
        given, taken = [], 0
        for known, variable in zip(call.arguments, call.equation.invars, strict=True):
            if isinstance(known, np.ndarray):
                given.append(jnp.asarray(known, variable.aval.dtype))
                continue
            count = math.prod(known)
            parts = [jnp.asarray(x, variable.aval.dtype) for x in scalars[taken : taken + count]]
            given.append(jnp.stack(parts).reshape(known))
            taken += count
        return _bound(call.equation, given)


def scalar_program(
    function: Callable[..., Any], *shapes: tuple[int, ...], slopes: bool = True
) -> ScalarProgram:
    """Return `function` of arrays of these shapes as a program of scalars.

    Args:
        function: Of JAX arrays in double precision, to one array or several.
        shapes: Shape of each argument.
        slopes: Whether the program must have the function's derivatives, its own rules included;
            without them more can be taken apart.
    """
    inputs = [jax.ShapeDtypeStruct(shape, float) for shape in shapes]
    traced, form = jax.make_jaxpr(function, return_shape=True)(*inputs)
    making = _Making(slopes)
    taken, arguments = 0, []
    for shape in shapes:
        count = math.prod(shape)
        numbers = [making.number("input", taken + i) for i in range(count)]
        arguments.append(_Scalars(np.array(numbers, np.int64).reshape(shape)))
        taken += count
    with jax.ensure_compile_time_eval():  # what is known is a number, within a program, too
        outputs = making.run(traced.jaxpr, traced.consts, arguments)
    found = [making.lifted(each) for each in outputs]
    return making.program(found, single=not isinstance(form, list | tuple))


@dataclass(frozen=True)
class _Scalars:
    """An array whose elements are results of operations."""

    numbers: np.ndarray


class _Making:
    """Operations found so far; the same operation on the same results is kept once."""

    def __init__(self, slopes: bool) -> None:
        self.slopes = slopes
        self.operations: list[Operation] = []
        self.calls: list[Call] = []
        self._known: dict[Operation, int] = {}

    def number(self, name: str, *reads: Any) -> int:
        """Return the number of an operation, which is added where it is new."""
        each = Operation(name, reads)
        if each not in self._known:
            self._known[each] = len(self.operations)
            self.operations.append(each)
        return self._known[each]

    def constant(self, value: Any) -> int:
        is_condition = value.dtype == bool  # True equals 1.0, so that it is kept beside the value
        return self.number("constant", value.item() if is_condition else float(value), is_condition)

    def lifted(self, array: Any) -> np.ndarray:
        """Return numbers of operations for all elements of an array, known or not."""
        if isinstance(array, _Scalars):
            return array.numbers
        array = np.asarray(array)
        numbers = [self.constant(value) for value in array.ravel()]
        return np.array(numbers, np.int64).reshape(array.shape)

    def program(self, found: list[np.ndarray], single: bool) -> ScalarProgram:
        """Return the operations that the outputs need, numbered anew."""
        needed: set[int] = set()
        waiting = [int(i) for each in found for i in each.ravel()]
        while waiting:
            i = waiting.pop()
            if i not in needed:
                needed.add(i)
                waiting += self.operations[i].sources
        order = {old: new for new, old in enumerate(sorted(needed))}
        operations = tuple(_renumbered(self.operations[old], order) for old in order)
        outputs = tuple(np.vectorize(order.__getitem__, otypes=[int])(each) for each in found)
        return ScalarProgram(operations, tuple(self.calls), outputs, single)

    def run(self, jaxpr: Any, constants: Sequence[Any], arguments: Sequence[Any]) -> list[Any]:
        """Return the outputs of a traced function, known arrays or `_Scalars`."""
        values: dict[Any, Any] = dict(zip(jaxpr.constvars, map(_known, constants), strict=True))
        values.update(zip(jaxpr.invars, arguments, strict=True))

        def read(variable: Any) -> Any:
            return _known(variable.val) if hasattr(variable, "val") else values[variable]

        for equation in jaxpr.eqns:
            found = self._step(equation, [read(each) for each in equation.invars])
            values.update(zip(equation.outvars, found, strict=True))
        return [read(each) for each in jaxpr.outvars]

    def _step(self, equation: Any, arguments: list[Any]) -> Sequence[Any]:
        name, parameters = equation.primitive.name, equation.params
        unknown = [isinstance(each, _Scalars) for each in arguments]
        if name == "stop_gradient" and not self.slopes:
            return arguments
        if name in _CALLS or (name in _WITH_RULES and not self.slopes):
            inner = parameters.get("jaxpr") or parameters["call_jaxpr"]
            return self.run(inner.jaxpr, inner.consts, arguments)
        if name == "cond" and not unknown[0]:
            inner = parameters["branches"][int(arguments[0])]
            return self.run(inner.jaxpr, inner.consts, arguments[1:])
        if name in MOVES and not any(unknown[k] for k in MOVES[name].places if k < len(unknown)):
            if not any(unknown):
                return _several(MOVES[name].move(parameters, *arguments))
            lifted = [
                each if k in MOVES[name].places else self.lifted(each)
                for k, each in enumerate(arguments)
            ]
            if fills(parameters):
                parameters = {**parameters, "fill_value": self.constant(filling(parameters))}
            return [_Scalars(each) for each in _several(MOVES[name].move(parameters, *lifted))]
        if not any(unknown):
            return _known_step(equation, arguments)
        if name == "custom_linear_solve":
            solution = self._linear_solution(parameters, arguments)
            return self._called(equation, arguments) if solution is None else [_Scalars(solution)]
        read = [
            each for each, is_unknown in zip(equation.invars, unknown, strict=True) if is_unknown
        ]
        if not all(each.aval.dtype in (float, bool) for each in (*read, *equation.outvars)):
            return self._called(equation, arguments)
        if name == "scatter-add" and not unknown[1]:
            operand, updates = self.lifted(arguments[0]), self.lifted(arguments[2])
            return [_Scalars(self._added(parameters, operand, arguments[1], updates))]
        shape = equation.outvars[0].aval.shape
        if name in _ELEMENTWISE or (name in _WRITTEN and len(arguments) <= 3):
            lifted = [np.broadcast_to(self.lifted(each), shape) for each in arguments]
            apply = _WRITTEN.get(name)
            found = np.empty(shape, np.int64)
            for at in np.ndindex(shape):
                read = [int(each[at]) for each in lifted]
                found[at] = apply(self, parameters, *read) if apply else self.apply(name, *read)
            return [_Scalars(found)]
        if name in _SUMS:
            found = _SUMS[name](self, parameters, *(self.lifted(each) for each in arguments))
            if found is not None:
                return [_Scalars(found)]
        return self._called(equation, arguments)

    def _called(self, equation: Any, arguments: list[Any]) -> list[Any]:
        """Return the outputs of what stays one operation."""
        given = tuple(
            each.numbers.shape if isinstance(each, _Scalars) else np.asarray(each)
            for each in arguments
        )
        read = [int(i) for a in arguments if isinstance(a, _Scalars) for i in a.numbers.ravel()]
        self.calls.append(Call(equation, given))
        source = self.number("call", len(self.calls) - 1, *read)
        found = []
        for output, variable in enumerate(equation.outvars):
            shape = variable.aval.shape
            parts = [self.number("part", source, output, i) for i in range(math.prod(shape))]
            found.append(_Scalars(np.array(parts, np.int64).reshape(shape)))
        return found

    def _added(
        self, parameters: Any, operand: np.ndarray, indices: np.ndarray, updates: np.ndarray
    ) -> np.ndarray:
        found = operand.copy()
        for place, at in scattered(parameters, operand.shape, indices, updates.shape):
            found[place] = self.apply("add", int(found[place]), int(updates[at]))
        return found

    def _linear_solution(self, parameters: Any, arguments: list[Any]) -> np.ndarray | None:
        """Return x of A x = b by Cramer's rule; None of a large A, or of several b."""
        lengths, product = parameters["const_lengths"], parameters["jaxprs"].matvec
        *held, right = arguments
        b = self.lifted(right)
        if len(held) != sum(lengths) or b.ndim != 1 or len(b) > _LARGEST_RULE:
            return None
        units = [[*held[: lengths.matvec], unit] for unit in np.eye(len(b))]
        columns = [self.lifted(self.run(product.jaxpr, product.consts, e)[0]) for e in units]
        whole = self._determinant(np.array(columns))
        parts = [
            self._determinant(np.array([*columns[:i], b, *columns[i + 1 :]])) for i in range(len(b))
        ]
        return np.array([self.apply("div", part, whole) for part in parts], np.int64)

    def _determinant(self, rows: np.ndarray) -> int:
        """Return the determinant, along the first row."""
        if not len(rows):
            return self.constant(np.array(1.0))
        found = self.constant(np.array(0.0))
        for i, entry in enumerate(rows[0]):
            rest = self._determinant(np.delete(rows[1:], i, axis=1))
            sign = "sub" if i % 2 else "add"
            found = self.apply(sign, found, self.apply("mul", int(entry), rest))
        return found

    def value(self, number: int) -> float | bool | None:
        """Return the value of an operation, None where it is not known."""
        each = self.operations[number]
        return each.reads[0] if each.name == "constant" else None

    def apply(self, name: str, *reads: int) -> int:
        """Return the number of an operation on scalars, simplified."""
        values = [self.value(i) for i in reads]
        if all(value is not None for value in values):
            return self.constant(np.asarray(Operation(name, reads).value(values)))
        if name in ("add", "mul", "max", "min"):  # the order does not matter
            reads = tuple(sorted(reads, key=lambda i: (self.value(i) is None, i)))
            values = [self.value(i) for i in reads]
        simpler = self._simpler(name, reads, values)
        return self.number(name, *reads) if simpler is None else simpler

    def _simpler(self, name: str, reads: Sequence[int], values: Sequence[Any]) -> int | None:
        """Return what the operation comes to, None where it stays."""
        first, second = reads[0], reads[-1]
        match name, *values:
            case ("add", 0.0, _) | ("mul", 1.0, _):
                return second
            case ("max", low, _) if low == -math.inf:
                return second
            case ("min", high, _) if high == math.inf:
                return second
            case ("sub", _, 0.0) | ("div", _, 1.0):
                return first
            case ("mul", 0.0, _) | ("div", 0.0, _):
                return self.constant(np.array(0.0))
            case ("mul", -1.0, _) | ("sub", 0.0, _):
                return self.apply("neg", second)
            case ("sub", _, _) if first == second:
                return self.constant(np.array(0.0))
            case ("neg", _) if self.operations[first].name == "neg":
                return self.operations[first].reads[0]
        return None

    def is_condition(self, number: int) -> bool:
        """Return whether an operation is true or false, and not a number."""
        each = self.operations[number]
        if each.name == "select":
            return self.is_condition(each.reads[1])
        if each.name == "part":
            call = self.calls[self.operations[each.reads[0]].reads[0]]
            return call.equation.outvars[each.reads[1]].aval.dtype == bool
        return isinstance(self.value(number), bool) or each.name in _CONDITIONS

    def select(self, condition: int, true: int, false: int) -> int:
        known = self.value(condition)
        if known is not None:
            return true if known else false
        return true if true == false else self.number("select", condition, true, false)

    def power(self, base: int, exponent: int) -> int:
        """Return a whole power by multiplications."""
        found = base
        for _ in range(abs(exponent) - 1):
            found = self.apply("mul", found, base)
        one = self.constant(np.array(1.0))
        if exponent == 0:
            return one
        return found if exponent > 0 else self.apply("div", one, found)

    def sum(self, terms: Iterable[int]) -> int:
        found = self.constant(np.array(0.0))
        for each in terms:
            found = self.apply("add", found, int(each))
        return found


def _converted(making: _Making, parameters: Any, x: int) -> int:
    """Return a condition as 1 or 0, a number as a condition where that is asked for."""
    is_condition = making.is_condition(x)
    if np.issubdtype(parameters["new_dtype"], bool):
        return x if is_condition else making.apply("ne", x, making.constant(np.array(0.0)))
    if not is_condition:
        return x
    return making.select(x, making.constant(np.array(1.0)), making.constant(np.array(0.0)))


_WRITTEN: dict[str, Callable[..., int]] = {
    "convert_element_type": _converted,
    "select_n": lambda making, _, which, *cases: making.select(which, cases[1], cases[0]),
    "square": lambda making, _, x: making.power(x, 2),
    "integer_pow": lambda making, parameters, x: making.power(x, parameters["y"]),
    "rsqrt": lambda making, _, x: making.power(making.apply("sqrt", x), -1),
}


def _summed(making: _Making, parameters: Any, array: np.ndarray) -> np.ndarray:
    axes = parameters["axes"]
    kept = [axis for axis in range(array.ndim) if axis not in axes]
    shape = [array.shape[axis] for axis in kept]
    count = math.prod(array.shape[axis] for axis in axes)
    rows = array.transpose(*kept, *axes).reshape(math.prod(shape), count)
    return np.array([making.sum(row) for row in rows], np.int64).reshape(shape)


def _multiplied(
    making: _Making, parameters: Any, left: np.ndarray, right: np.ndarray
) -> np.ndarray:
    """Return a product of arrays, rows by columns (`dot_general`)."""
    (along_left, along_right), (batch_left, batch_right) = parameters["dimension_numbers"]

    def rows(array: np.ndarray, along: Any, batch: Any) -> tuple[np.ndarray, tuple[int, ...]]:
        free = [axis for axis in range(array.ndim) if axis not in (*along, *batch)]
        array = array.transpose(*batch, *free, *along)
        outer, inner = array.shape[: len(batch)], array.shape[len(batch) : len(batch) + len(free)]
        count = math.prod(array.shape[len(batch) + len(free) :])
        return array.reshape(math.prod(outer), math.prod(inner), count), inner

    a, of_left = rows(left, along_left, batch_left)
    b, of_right = rows(right, along_right, batch_right)
    found = np.empty((len(a), a.shape[1], b.shape[1]), np.int64)
    for k, i, j in np.ndindex(found.shape):
        pairs = zip(a[k, i], b[k, j], strict=True)
        found[k, i, j] = making.sum([making.apply("mul", int(x), int(y)) for x, y in pairs])
    outer = [left.shape[axis] for axis in batch_left]
    return found.reshape((*outer, *of_left, *of_right))


def _cumulated(making: _Making, parameters: Any, array: np.ndarray) -> np.ndarray:
    step = -1 if parameters["reverse"] else 1
    found = np.moveaxis(array.copy(), parameters["axis"], 0)[::step]
    for i in range(1, len(found)):
        for at in np.ndindex(found.shape[1:]):
            here, before = (i, *at), (i - 1, *at)
            found[here] = making.apply("add", int(found[before]), int(found[here]))
    return np.moveaxis(found[::step], 0, parameters["axis"])


def _factorized(making: _Making, _: Any, matrices: np.ndarray) -> np.ndarray | None:
    """Return the lower factor L of A = LLᵀ, None of a large A."""
    size = matrices.shape[-1]
    if size > _LARGEST_INVERSE:
        return None
    found = np.full(matrices.shape, making.constant(np.array(0.0)))
    for batch in np.ndindex(matrices.shape[:-2]):
        a, lower = matrices[batch], found[batch]
        for i in range(size):
            for j in range(i + 1):
                rest = int(a[i, j])
                for k in range(j):
                    product = making.apply("mul", int(lower[i, k]), int(lower[j, k]))
                    rest = making.apply("sub", rest, product)
                on = i == j
                lower[i, j] = (
                    making.apply("sqrt", rest)
                    if on
                    else making.apply("div", rest, int(lower[j, j]))
                )
    return found


def _solved(
    making: _Making, parameters: Any, matrices: np.ndarray, sides: np.ndarray
) -> np.ndarray | None:
    """Return X of AX = B with a triangular A, None of a large A."""
    size = matrices.shape[-1]
    if size > _LARGEST_INVERSE:
        return None
    if not parameters["left_side"]:  # X A = B, so Aᵀ Xᵀ = Bᵀ
        turned = {
            **parameters,
            "left_side": True,
            "transpose_a": not parameters["transpose_a"],
        }
        found = _solved(making, turned, matrices, np.swapaxes(sides, -1, -2))
        return None if found is None else np.swapaxes(found, -1, -2)
    lower = parameters["lower"] != parameters["transpose_a"]
    if parameters["transpose_a"]:
        matrices = np.swapaxes(matrices, -1, -2)
    found = np.empty(sides.shape, np.int64)
    for *batch, column in np.ndindex(*sides.shape[:-2], sides.shape[-1]):
        a, b, x = matrices[tuple(batch)], sides[tuple(batch)], found[tuple(batch)]
        for i in range(size) if lower else reversed(range(size)):
            rest = int(b[i, column])
            for k in range(i) if lower else range(i + 1, size):
                product = making.apply("mul", int(a[i, k]), int(x[k, column]))
                rest = making.apply("sub", rest, product)
            if not parameters["unit_diagonal"]:
                rest = making.apply("div", rest, int(a[i, i]))
            x[i, column] = rest
    return found


_SUMS: dict[str, Callable[..., np.ndarray | None]] = {
    "reduce_sum": _summed,
    "dot_general": _multiplied,
    "cumsum": _cumulated,
    "cholesky": _factorized,
    "triangular_solve": _solved,
}


def _known_step(equation: Any, arguments: Sequence[np.ndarray]) -> Sequence[np.ndarray]:
    """Return the outputs of a step on known arrays, by NumPy where that means the same."""
    name, parameters = equation.primitive.name, equation.params
    variable = equation.outvars[0].aval
    whole = any(np.issubdtype(each.dtype, np.integer) for each in arguments)
    if name in _ELEMENTWISE and not (whole and name in ("and", "div", "not", "or", "pow", "sign")):
        with np.errstate(all="ignore"):
            found = getattr(np, _ELEMENTWISE[name])(*arguments)
    elif name == "convert_element_type":
        with np.errstate(all="ignore"):
            found = arguments[0]
    elif name == "select_n" and arguments[0].dtype == bool:
        found = np.where(arguments[0], arguments[2], arguments[1])
    elif name == "iota":
        shape = [1] * len(variable.shape)
        shape[parameters["dimension"]] = -1
        found = np.arange(variable.shape[parameters["dimension"]]).reshape(shape)
    else:
        return [np.asarray(each) for each in _bound(equation, arguments)]
    return [np.broadcast_to(np.asarray(found, variable.dtype), variable.shape)]


def _bound(equation: Any, arguments: Sequence[Any]) -> Sequence[Any]:
    """Return the outputs of a step by JAX."""
    bound = equation.primitive.get_bind_params(equation.params)
    functions, options = bound if isinstance(bound, tuple) else ((), bound)  # JAX 0.8, and later
    found = equation.primitive.bind(*functions, *arguments, **options)
    return found if equation.primitive.multiple_results else [found]


def _known(value: Any) -> Any:
    return value if isinstance(value, _Scalars) else np.asarray(value)


def _several(found: Any) -> Sequence[np.ndarray]:
    return found if isinstance(found, list) else [found]


def _renumbered(each: Operation, order: dict[int, int]) -> Operation:
    if each.name in ("input", "constant"):
        return each
    if each.name == "call":
        return Operation("call", (each.reads[0], *(order[i] for i in each.reads[1:])))
    if each.name == "part":
        return Operation("part", (order[each.reads[0]], *each.reads[1:]))
    return Operation(each.name, tuple(order[i] for i in each.reads))
