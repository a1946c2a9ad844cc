"""Traced programs on disk: the next process reads what this one has traced, and gets the same numbers."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_export import moving

import orthaug as oa
from orthaug._base import kept_programs
from orthaug._base.kept_programs import (
    Call,
    KeptPrograms,
    NotKept,
    described,
    digest_of,
    rebuilt,
)
from orthaug.models.dynamics import Parts

ROOT = Path(__file__).resolve().parents[1]
FIT = """
import sys
import threading
import time
import numpy as np
import orthaug as oa
from orthaug._base.jax import jax
jax.jit(lambda x: x + 1)(1.0)  # a program that was compiled before
print(oa.keep_programs())
traced = []
jax.monitoring.register_event_duration_secs_listener(
    lambda event, seconds, **_: traced.append(seconds) if "trace_duration" in event else None
)
rng = np.random.default_rng(1)
u = np.repeat(rng.normal(size=20), 10)
v, y = 0.0, []
for force in u:
    y.append(v)
    v += 0.1 * (force - 0.5 * v - 0.3 * v * abs(v))
motion = oa.Motion.from_equations(
    [oa.State("v", "b*u - c*v", "y", True)],
    [oa.Output("y", "v")],
    [oa.PhysicalParameter("b", 0.9), oa.PhysicalParameter("c", 0.4)],
    ["u"],
)
record = oa.Record.from_arrays(u, np.array(y), sampling_time=0.1, inputs=["u"], outputs=["y"])
fit = oa.estimate(record, motion, learner=oa.MLP((3,), inputs=("v",)), blocks=0)
print(sum(traced))
print([float(value).hex() for value in (*fit.values, fit.status.loss)])
"""


class MemoryCache(dict[str, bytes]):
    """A cache as JAX has it."""

    def put(self, key: str, value: bytes) -> None:
        self[key] = value


def of_module(x: Any, scale: int, parts: Parts) -> Any:
    return Parts(scale * x, parts.baseline + 1, None), (x.sum(),)


def call_of(function: Any, static: tuple[str, ...], *args: Any) -> Call:
    import inspect

    return Call.of(inspect.signature(function), static, args, {})


def fitted(folder: Path, seed: str) -> tuple[float, str]:
    """Return the seconds of tracing [s] and the numbers of a fit in a process of its own."""
    made = subprocess.run(
        [sys.executable, "-c", FIT],
        env=os.environ | {"JAX_COMPILATION_CACHE_DIR": str(folder), "PYTHONHASHSEED": seed},
        capture_output=True,
        text=True,
        check=True,
    )
    kept, seconds, numbers = made.stdout.splitlines()
    assert kept == str(folder)
    return float(seconds), numbers


def test_the_next_process_traces_nothing_and_gets_the_same_numbers(tmp_path: Path) -> None:
    first, numbers = fitted(tmp_path, "1")
    kept = {path.name for path in tmp_path.glob("orthaug_*-cache")}
    again, same = fitted(tmp_path, "2")
    assert len(kept) > 5
    assert len({path.name for path in tmp_path.glob("*-cache")} - kept) > 5  # compiled ones
    assert {path.name for path in tmp_path.glob("orthaug_*-cache")} == kept
    assert same == numbers
    assert again < 0.3 * first
    for path in tmp_path.glob("orthaug_*-cache"):  # what was altered is traced again
        path.write_bytes(path.read_bytes()[:-40] + bytes(40))
    assert fitted(tmp_path, "3")[1] == numbers


def test_a_digest_is_of_the_content() -> None:
    motion = partial(
        oa.Motion.from_equations,
        outputs=[oa.Output("y", "v")],
        parameters=[oa.PhysicalParameter("c", 0.4)],
        inputs=["u"],
    )
    digests = {digest_of(motion([oa.State("v", text, "y")])) for text in ("u - c*v", "u - c*v**3")}
    assert len(digests) == 2
    assert digest_of(motion([oa.State("v", "u - c*v", "y")])) in digests
    different = [0, 0.0, -0.0, False, None, "0", b"0", (0,), [0], ((0,), 0), {"0": 0}, np.zeros(1)]
    assert len({digest_of(value) for value in different}) == len(different)
    assert digest_of({1, 2, 3}) == digest_of({3, 2, 1})


def test_initial_values_bounds_and_units_are_not_of_a_program() -> None:
    """Who changes them in a spec compiled every program of the fit anew."""

    def form_of(feature: str = "v", **changed: Any) -> Any:
        gain = oa.PhysicalParameter("b", **{"initial": 0.9, "unit": "1/s"} | changed)
        motion = oa.Motion.from_equations(
            [oa.State("v", "b*u - c*v", "y", learned=True)],
            [oa.Output("y", "v")],
            [gain, oa.PhysicalParameter("c", 0.4)],
            ["u"],
        )
        return moving(motion, (feature,), oa.MLP((3,))).form

    own = form_of()
    for other in (form_of(initial=2.0), form_of(unit="1/min"), form_of(max=9.0)):
        assert other == own and hash(other) == hash(own) and digest_of(other) == digest_of(own)
    assert form_of(min=0) != own  # a positive parameter is estimated as its logarithm
    assert form_of("b*v") != form_of("b*v", initial=2.0)  # the feature has its initial value


def test_what_is_not_known_by_content_is_refused() -> None:
    @dataclass(frozen=True)
    class Own:
        value: int

    for value in (lambda x: x, Own(1), object(), (1, of_module), {"a": Path}):
        with pytest.raises(NotKept):
            digest_of(value)


def test_results_are_rebuilt_as_they_were() -> None:
    result = (Parts(jnp.ones(2), jnp.zeros(3), jnp.ones(1)), [jnp.ones(2), (None, jnp.ones(1))])
    back = rebuilt(described(result))
    assert jax.tree.structure(back) == jax.tree.structure(result)
    assert type(back[0]) is Parts
    for description in (
        {"named": "os:system", "parts": []},
        {"named": "orthaug.models.model:Model"},
    ):
        with pytest.raises(NotKept):
            rebuilt({"parts": []} | description)
    with pytest.raises(NotKept):
        described({"a": jnp.ones(1)})


def test_a_program_is_kept_by_shapes_static_arguments_and_code(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(kept_programs, "_CODE_OF", (*kept_programs._CODE_OF, __name__))
    cache = MemoryCache()
    parts = Parts(np.ones(2), np.ones(2), np.ones(2))

    def result(*args: Any) -> Any:
        return KeptPrograms(cache).call(of_module, call_of(of_module, ("scale",), *args), None)

    made = result(np.arange(3.0), 2, parts)
    assert isinstance(made[0], Parts)
    assert made[0].baseline == pytest.approx([0.0, 2.0, 4.0])
    assert made[1][0] == 3.0
    assert len(cache) == 1
    assert result(np.arange(3.0) + 1, 2, parts)[0].baseline == pytest.approx([2.0, 4.0, 6.0])
    assert len(cache) == 1
    assert result(np.arange(3.0), 3, parts)[0].baseline == pytest.approx([0.0, 3.0, 6.0])
    assert result(np.arange(4.0), 3, parts)[0].baseline.shape == (4,)
    assert len(cache) == 3
    monkeypatch.setattr(kept_programs, "_code", lambda: b"other")
    result(np.arange(3.0), 2, parts)
    assert len(cache) == 4
    cache |= dict.fromkeys(cache, b"no program")
    assert result(np.arange(3.0), 2, parts) is NotImplemented


def test_a_function_of_the_host_is_not_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    class Host:
        calls_host = True

    cache = MemoryCache()
    call = call_of(of_module, ("scale",), np.ones(2), Host(), None)
    assert KeptPrograms(cache).call(of_module, call, None) is NotImplemented
    assert not cache


def test_runs_that_ask_together_share_one_program(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kept_programs, "_CODE_OF", (*kept_programs._CODE_OF, __name__))
    asked, both = [], threading.Barrier(2)

    class SlowCache(MemoryCache):
        def get(self, key: str, default: Any = None) -> Any:
            asked.append(key)
            time.sleep(0.2)  # so that the other one asks meanwhile
            return super().get(key, default)

    programs = KeptPrograms(SlowCache())
    parts = Parts(np.ones(2), np.ones(2), np.ones(2))

    def result(start: float) -> Any:
        both.wait()
        call = call_of(of_module, ("scale",), start + np.arange(3.0), 2, parts)
        return programs.call(of_module, call, None)[1][0]

    with ThreadPoolExecutor(2) as pool:
        assert [float(total) for total in pool.map(result, (0.0, 1.0))] == [3.0, 6.0]
    assert len(asked) == 1
