"""Measured records of the collection that decides about defaults: what trains, what tests, and their physics.

Each record is cut to some 4000 rows of training and of test, and written as CSV: what is measured is the choice of a
model, and not a reader or the time of a long record. The records are read from ORTHAUG_DATA (default ../shared/data
beside the project). `defaults.py` runs the collection.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import h5py
import numpy as np
from machine import data_folder
from scipy.io import loadmat

MEASURED = "measured"
GENERATED = "generated"
AXIS = "axis"
ROWS = 4000


@dataclass(frozen=True, eq=False)
class Problem:
    """A record to fit, with the tests that judge its model."""

    name: str
    group: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    sampling_time: float
    train: list[np.ndarray]
    """Experiments: a row per sample, the inputs' columns before the outputs'."""
    tests: dict[str, np.ndarray]
    skip: int = 0
    """Leading rows of each test that are not scored."""
    motion: str = ""
    """TOML of [motion] and [learner]; without it `orthaug init` writes a lagged spec."""
    what: str = ""
    hidden: dict[str, np.ndarray] = field(default_factory=dict)
    """What no fit reads: known only to the benchmark."""

    def write(self, folder: Path) -> None:
        """Write train0.csv, … and NAME.csv of each test."""
        header = ",".join((*self.inputs, *self.outputs))
        parts = {f"train{i}": rows for i, rows in enumerate(self.train)} | self.tests
        for name, rows in parts.items():
            np.savetxt(
                folder / f"{name}.csv", rows, delimiter=",", header=header, comments="", fmt="%.9g"
            )

    @property
    def sections(self) -> dict[str, object]:
        """The parts of [data] that the benchmark gives: all of the training record, and the tests."""
        skip = {"skip": self.skip} if self.skip else {}
        return {
            "train": {"files": [f"train{i}.csv" for i in range(len(self.train))]},
            "tests": {name: {"files": [f"{name}.csv"], **skip} for name in self.tests},
        }


def _csv(path: str, columns: list[int], rows: slice = slice(None)) -> np.ndarray:
    return np.genfromtxt(data_folder() / path, delimiter=",", skip_header=1, usecols=columns)[rows]


def silverbox() -> Problem:
    rows = _csv("silverbox/SNLS80mV.csv", [0, 1])
    tests = {
        "multisine": rows[105712:107712],
        "inner_arrow": rows[30100:32100],
        "arrow": rows[38575:40575],
    }
    return Problem(
        "silverbox", MEASURED, ("V1",), ("V2",), 0.001638468, [rows[101712:105712]], tests, skip=50
    )


def cascaded_tanks() -> Problem:
    path = "cascaded_tanks/dataBenchmark.csv"
    train, test = _csv(path, [0, 2]), _csv(path, [1, 3])
    return Problem(
        "cascaded_tanks", MEASURED, ("pump",), ("level",), 4.0, [train], {"official": test}, skip=5
    )


def mr_damper() -> Problem:
    cells = loadmat(data_folder() / "mr_damper" / "damper.mat")
    rows = np.column_stack([cells["X"].ravel(), cells["y"].ravel()])
    return Problem(
        "mr_damper",
        MEASURED,
        ("velocity",),
        ("force",),
        0.005,
        [rows[:2000]],
        {"rest": rows[2000:]},
    )


def f16() -> Problem:
    rows = np.loadtxt(data_folder() / "f16" / "f-16.txt", delimiter=",")
    cut = len(rows) * 3 // 4
    channels = ("force", "voltage"), ("acceleration",)
    return Problem(
        "f16",
        MEASURED,
        *channels,
        1 / 400,
        [rows[cut - ROWS : cut]],
        {"last": rows[cut : cut + ROWS]},
    )


def ball_and_beam() -> Problem:
    """Thinned from 1 ms to 20 ms: the input, which switches within them, is the mean over the step that follows."""
    with h5py.File(data_folder() / "ball_and_beam" / "run.mat") as file:
        recording = file["aquisicao_02_mpc_modelo_NARX"]
        drive, position = (np.ravel(file[one[0]][()]) for one in recording["Y"]["Data"][:2])
    steps = len(drive) // 20
    rows = np.column_stack(
        [drive[: 20 * steps].reshape(steps, 20).mean(axis=1), position[: 20 * steps : 20]]
    )
    cut = steps * 3 // 4
    return Problem(
        "ball_and_beam",
        MEASURED,
        ("drive",),
        ("position",),
        0.02,
        [rows[:cut]],
        {"last": rows[cut:]},
    )


def servo() -> Problem:
    """Speeds over pulse widths in rising order, in the order of the file: no dynamics are in it."""
    cells = loadmat(
        data_folder() / "servo" / "Training_Set.mat", squeeze_me=True, struct_as_record=False
    )
    turns = [getattr(cells["Training_set"], name) for name in ("Anti_clock", "Clock")]
    rows = np.vstack([np.column_stack([turn.Unique_PW_Keys, turn.motor_rpm]) for turn in turns])
    cut = len(rows) * 3 // 4
    return Problem(
        "servo", MEASURED, ("pulse",), ("speed",), 1.0, [rows[:cut]], {"last": rows[cut:]}
    )


def wiener_hammerstein() -> Problem:
    rows = _csv("wiener_hammerstein/WienerHammerBenchmark.csv", [0, 1])
    train, test = rows[20_000 : 20_000 + ROWS], rows[100_000 : 100_000 + ROWS]
    return Problem(
        "wiener_hammerstein",
        MEASURED,
        ("u",),
        ("y",),
        1 / 51_200,
        [train],
        {"official": test},
        skip=1000,
    )


def wh_process_noise() -> Problem:
    train = _csv("wh_process_noise/WH_EstimationExample.csv", [10, 20], slice(ROWS))
    path = "wh_process_noise/WH_TestDataset.csv"
    tests = {
        "multisine": _csv(path, [2, 4], slice(ROWS // 2)),
        "sweep": _csv(path, [3, 5], slice(ROWS // 2)),
    }
    return Problem(
        "wh_process_noise", MEASURED, ("u",), ("y",), 1 / 78_125, [train], tests, skip=50
    )


def bouc_wen() -> Problem:
    parts = []
    for name in ("train", "test"):
        with h5py.File(data_folder() / "bouc_wen" / f"{name}.h5") as file:
            group = file["multisine"]
            parts.append(np.column_stack([np.ravel(group[key][:ROWS]) for key in ("u", "y")]))
    return Problem(
        "bouc_wen", MEASURED, ("u",), ("y",), 1 / 750, parts[:1], {"multisine": parts[1]}, skip=50
    )


def f1tenth() -> Problem:
    """Six runs train and six test, each cut to its first 650 rows."""
    folder, columns = data_folder() / "f1tenth", [1, 2, 3, 4, 5]
    train = ("circle_0.6", "eight_0.55", "eight_0.75", "circle_0.8", "eight_0.95", "circle_1.0")
    test = ("eight_0.6", "circle_0.65", "eight_0.8", "circle_0.85", "eight_1.0", "circle_0.55")
    runs = [_csv(str(folder / "train" / f"{name}.csv"), columns, slice(650)) for name in train]
    tests = {
        n.replace(".", "_"): _csv(str(folder / "test" / f"{n}.csv"), columns, slice(650))
        for n in test
    }
    return Problem(
        "f1tenth", MEASURED, ("delta", "d"), ("v_long", "v_lat", "yaw_rate"), 0.025, runs, tests
    )


LAGGED: dict[str, Callable[[], Problem]] = {
    one.__name__: one
    for one in (
        silverbox,
        cascaded_tanks,
        mr_damper,
        f16,
        ball_and_beam,
        servo,
        wiener_hammerstein,
        wh_process_noise,
        bouc_wen,
        f1tenth,
    )
}

MOTIONS = {
    "silverbox": """
[motion]
hold = "spline"
[motion.states]
x = { derivative = "v", start = "V2" }
v = { derivative = "b*(V1 + u0) - d*v - k*x", start = "derivative of V2", learned = true }
[motion.outputs]
V2 = "x"
[motion.parameters]
b = { initial = 1e5, min = 0 }
d = { initial = 20.0, min = 0 }
k = { initial = 2e5, min = 0 }
u0 = { initial = 0.0 }
[learner]
hidden = [8]
inputs = ["x", "v"]
""",
    "cascaded_tanks": """
[motion.states]
x1 = { derivative = "k4*pump - k1*sqrt(max(x1, 0.01))", start = 5.0 }
x2 = { derivative = "k2*sqrt(max(x1, 0.01)) - k3*sqrt(max(x2, 0.01))", start = "level", learned = true }
[motion.outputs]
level = "x2"
[motion.parameters]
k1 = { initial = 0.05, min = 0 }
k2 = { initial = 0.05, min = 0 }
k3 = { initial = 0.05, min = 0 }
k4 = { initial = 0.04, min = 0 }
[learner]
hidden = [8]
inputs = ["x1", "x2"]
""",
    "ball_and_beam": """
[motion.states]
x = { derivative = "v", start = "position" }
v = { derivative = "g*(drive - centre) - c*v", start = "derivative of position", learned = true }
[motion.outputs]
position = "x"
[motion.parameters]
g = { initial = 20.0, min = 0 }
centre = { initial = 0.8 }
c = { initial = 0.5, min = 0 }
[learner]
hidden = [8]
inputs = ["x", "v", "drive"]
""",
    "servo": """
[motion.states]
w = { derivative = "(gain*(centre - pulse) - w)/lag", start = "speed", learned = true }
[motion.outputs]
speed = "w"
[motion.parameters]
gain = { initial = 0.1, min = 0 }
centre = { initial = 1450.0 }
lag = { initial = 2.0, min = 0 }
[learner]
hidden = [8]
inputs = ["pulse"]
""",
    "bouc_wen": """
[motion]
hold = "spline"
[motion.states]
x = { derivative = "v", start = "y" }
v = { derivative = "(u - c*v - k*x)/m", start = "derivative of y", learned = true }
[motion.outputs]
y = "x"
[motion.parameters]
m = { initial = 2.0, min = 0 }
c = { initial = 10.0, min = 0 }
k = { initial = 7e4, min = 0 }
[learner]
hidden = [8]
inputs = ["x", "v"]
""",
}
"""Physics of those records whose physics is known, as equations of motion; what they lack is left to the learner."""
