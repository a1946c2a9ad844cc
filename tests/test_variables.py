"""Files of variables: MATLAB of both kinds, HDF5, npz and Excel fit from a spec as CSV does; the rest is refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import scipy.io
import scipy.sparse
from test_cli import run, signals

from orthaug import InputError
from orthaug.data.tables import has_column, read_table, read_titles
from orthaug.data.variables import read_variables

h5py = pytest.importorskip("h5py")

CLASSES = {
    "f8": "double",
    "f4": "single",
    "i4": "int32",
    "i2": "int16",
    "u1": "logical",
    "u2": "char",
}


# --- files as the programs write them


def put_v5(path: Path, **variables) -> Path:
    scipy.io.savemat(path, variables)
    return path


def put_v73(path: Path, **variables) -> Path:
    """As MATLAB's `save -v7.3`: a user block with the header's text, matrices transposed, classes as attributes."""
    with h5py.File(path, "w", userblock_size=512) as file:
        references = file.create_group("#refs#")
        references.create_dataset("a", data=np.zeros((2, 1)))
        for name, value in variables.items():
            _put_v73(file, references, name, value)
    header = b"MATLAB 7.3 MAT-file, Platform: GLNXA64, Created on: Mon Jan  1 00:00:00 2024 HDF5 schema 1.00 ."
    with path.open("r+b") as file:
        file.write(header.ljust(116) + bytes(8) + b"\x00\x02IM")
    return path


def _put_v73(group, references, name, value):
    if isinstance(value, dict):
        inner = group.create_group(name)
        inner.attrs["MATLAB_class"] = np.bytes_("struct")
        for key, item in value.items():
            _put_v73(inner, references, key, item)
    elif isinstance(value, list):
        held = [
            references.create_dataset(f"{name}{i}", data=np.atleast_2d(item)).ref
            for i, item in enumerate(value)
        ]
        made = group.create_dataset(
            name, data=np.array([held], dtype=h5py.ref_dtype), dtype=h5py.ref_dtype
        )
        made.attrs["MATLAB_class"] = np.bytes_("cell")
    elif isinstance(value, str):
        made = group.create_dataset(name, data=np.array([[ord(c)] for c in value], dtype="u2"))
        made.attrs["MATLAB_class"] = np.bytes_("char")
        made.attrs["MATLAB_int_decode"] = np.int32(2)
    elif scipy.sparse.issparse(value):
        inner = group.create_group(name)
        inner.attrs["MATLAB_class"], inner.attrs["MATLAB_sparse"] = (
            np.bytes_("double"),
            np.uint64(value.shape[0]),
        )
        inner.create_dataset("data", data=value.tocsc().data)
    else:
        array = np.atleast_2d(value)
        if np.iscomplexobj(array):
            pair = np.empty(array.shape, dtype=[("real", "f8"), ("imag", "f8")])
            pair["real"], pair["imag"] = array.real, array.imag
            array = pair
        logical = array.dtype == bool
        array = array.astype("u1") if logical else array
        made = group.create_dataset(name, data=array.T)
        kind = CLASSES.get(array.dtype.str[1:], "double")
        made.attrs["MATLAB_class"] = np.bytes_("logical" if logical else kind)
        if logical:
            made.attrs["MATLAB_int_decode"] = np.int32(1)


def put_hdf5(path: Path, **variables) -> Path:
    with h5py.File(path, "w") as file:
        for name, value in variables.items():
            file[name] = value
    return path


def put_npz(path: Path, **variables) -> Path:
    np.savez(path, **variables)
    return path


def put_excel(path: Path, **columns) -> Path:
    pd.DataFrame({name: np.ravel(values) for name, values in columns.items()}).to_excel(
        path, index=False
    )
    return path


WRITERS = {
    "v5": ("run.mat", put_v5),
    "v7.3": ("run.mat", put_v73),
    "hdf5": ("run.h5", put_hdf5),
    "npz": ("run.npz", put_npz),
}
EVERY = {**WRITERS, "excel": ("run.xlsx", put_excel)}
MATLAB = {key: WRITERS[key] for key in ("v5", "v7.3")}


def each(writers):
    return pytest.mark.parametrize("writer", writers.values(), ids=writers.keys())


def put(folder: Path, writer, **variables) -> Path:
    name, write = writer
    return write(folder / name, **variables)


# --- what a channel may be


@each(WRITERS)
@pytest.mark.parametrize("shape", [(1, 3), (3, 1)], ids=["1×N", "N×1"])
@pytest.mark.parametrize("kind", ["f8", "f4", "i2", "i4", "bool"])
def test_vectors(tmp_path, writer, shape, kind):
    values = np.array([1, 0, 1], dtype=kind)
    path = put(tmp_path, writer, u=values.reshape(shape), other=np.zeros((2, 2)))
    found = read_variables(path, ("u",))["u"]
    assert found.dtype == np.float64
    np.testing.assert_array_equal(found, [1.0, 0.0, 1.0])


@each(WRITERS)
def test_columns_of_a_matrix(tmp_path, writer):
    matrix = np.arange(12.0).reshape(4, 3)
    path = put(tmp_path, writer, U=matrix)
    found = read_variables(path, ("U[2]", "U[0]"))
    np.testing.assert_array_equal(found["U[2]"], matrix[:, 2])
    np.testing.assert_array_equal(found["U[0]"], matrix[:, 0])
    assert has_column(path, "U[1]") and not has_column(path, "V[1]")


@pytest.mark.parametrize("name", ["u", "run/u"])
def test_datasets_of_hdf5_by_their_path(tmp_path, name):
    path = put_hdf5(tmp_path / "run.h5", **{name: np.array([1, 2, 3])})
    np.testing.assert_array_equal(read_variables(path, (name,))[name], [1.0, 2.0, 3.0])


@pytest.mark.parametrize("kind", [float, int, bool])
def test_cells_of_excel(tmp_path, kind):
    path = put_excel(tmp_path / "run.xlsx", u=np.array([1, 0, 1], dtype=kind))
    found = read_table(path, ("u",)).columns["u"]
    assert found.dtype == np.float64 and found.tolist() == [1.0, 0.0, 1.0]


# --- fits from a spec

SPEC = """
[data]
sampling_time = 0.5
inputs = ["u"]
outputs = ["y"]
train = {{ files = ["{file}"] }}
[data.channels]
u = {{ column = "{u}" }}
y = {{ column = "{y}" }}
[[baseline.terms]]
parameter = "a"
regressor = "y[k-1]"
[[baseline.terms]]
parameter = "b"
regressor = "u[k-1]"
[learner]
kind = "none"
"""


pytestmark = pytest.mark.usefixtures("without_figures", "without_trials")


def fitted(folder: Path, spec: str) -> dict:
    """result.json of `orthaug fit`."""
    (folder / "plant.toml").write_text(spec)
    done = run("fit", folder / "plant.toml", "--out", folder / "out")
    assert done.code == 0, done.err
    return json.loads((folder / "out" / "result.json").read_text(encoding="utf-8"))


def theta(result: dict) -> list[float]:
    return [entry["value"] for entry in result["parameters"]]


def refused(folder: Path, spec: str, *words: str) -> str:
    """`orthaug fit` ends with exit code 2 and one line that has these words."""
    (folder / "plant.toml").write_text(spec)
    done = run("fit", folder / "plant.toml", "--out", folder / "out")
    assert done.code == 2 and done.err.count("\n") == 1, done
    for word in words:
        assert word in done.err, (word, done.err)
    assert not (folder / "out").exists()
    return done.err


@pytest.fixture(scope="module")
def from_csv(tmp_path_factory):
    folder = tmp_path_factory.mktemp("csv")
    u, y = signals(80, 1)
    np.savetxt(
        folder / "run.csv",
        np.stack([u, y], axis=1),
        delimiter=",",
        header="u,y",
        comments="",
        fmt="%.17g",
    )
    return theta(fitted(folder, SPEC.format(file="run.csv", u="u", y="y")))


@each(EVERY)
@pytest.mark.parametrize("shape", [(1, -1), (-1, 1)], ids=["1×N", "N×1"])
def test_a_fit_is_that_of_the_same_data_in_csv(tmp_path, writer, shape, from_csv):
    u, y = signals(80, 1)
    path = put(tmp_path, writer, u=u.reshape(shape), y=y.reshape(shape))
    found = theta(fitted(tmp_path, SPEC.format(file=path.name, u="u", y="y")))
    np.testing.assert_allclose(found, from_csv, rtol=1e-12)


@each(WRITERS)
def test_a_fit_of_matrix_columns(tmp_path, writer, from_csv):
    u, y = signals(80, 1)
    path = put(tmp_path, writer, U=np.stack([0 * u + 7, 2 * y, u], axis=1), y=y)
    found = theta(fitted(tmp_path, SPEC.format(file=path.name, u="U[2]", y="y")))
    np.testing.assert_allclose(found, from_csv, rtol=1e-12)


@each(EVERY)
def test_a_fit_of_integers_and_logicals(tmp_path, writer):
    rng = np.random.default_rng(0)
    u, y = rng.integers(0, 2, 80).astype(bool), rng.integers(-100, 100, 80).astype("i4")
    path = put(tmp_path, writer, u=u, y=y)
    found = theta(fitted(tmp_path, SPEC.format(file=path.name, u="u", y="y")))
    phi = np.stack([y[:-1], u[:-1]], axis=1).astype(float)
    np.testing.assert_allclose(
        found, np.linalg.lstsq(phi, y[1:].astype(float), rcond=None)[0], rtol=1e-10
    )


DAMPER = """
[data]
sampling_time = 0.005
inputs = ["v"]
outputs = ["F"]
train = {{ files = ["{file}"], rows = [0, 2000] }}
[data.channels]
v = {{ column = "X", unit = "cm/s" }}
F = {{ column = "y", unit = "N" }}
[data.tests.rest]
files = ["{file}"]
rows = [2000, 3499]
[learner]
kind = "none"
[training]
focus = "prediction"
"""


def test_the_mr_damper_fits_from_a_spec(tmp_path, data_folder):
    file = data_folder / "mr_damper" / "damper.mat"
    if not file.is_file():
        pytest.skip(f"no {file}; set ORTHAUG_DATA to the folder of the data sets")
    regressors = ("F[k-1]", "v[k]", "v[k-1]", "sign(v[k])", "1")
    terms = (
        f'[[baseline.terms]]\nparameter = "t{i}"\nregressor = "{r}"\n'
        for i, r in enumerate(regressors)
    )
    result = fitted(tmp_path, DAMPER.format(file=file) + "".join(terms))
    held = scipy.io.loadmat(file)
    v, force = held["X"].ravel()[:2000], held["y"].ravel()[:2000]
    phi = np.stack([force[:-1], v[1:], v[:-1], np.sign(v[1:]), np.ones(1999)], axis=1)
    np.testing.assert_allclose(
        theta(result), np.linalg.lstsq(phi, force[1:], rcond=None)[0], rtol=1e-8
    )
    free_run = result["scores"]["tests.rest"]["simulation"]
    assert free_run["fit"][0] == pytest.approx(65.3, abs=0.1)
    assert free_run["rmse"][0] == pytest.approx(19.2, abs=0.1)


TANKS = """
[data]
sampling_time = 4
inputs = ["u"]
outputs = ["y"]
train = {{ files = ["{file}"], columns = {{ u = "uEst", y = "yEst" }} }}
[data.tests.official]
files = ["{file}"]
columns = {{ u = "uVal", y = "yVal" }}
skip = 5
[[baseline.terms]]
parameter = "a"
regressor = "y[k-1]"
[[baseline.terms]]
parameter = "b"
regressor = "u[k-1]"
[learner]
kind = "none"
[training]
focus = "prediction"
"""


def test_the_cascaded_tanks_fit_from_a_spec(tmp_path, data_folder):
    file = data_folder / "cascaded_tanks" / "dataBenchmark.csv"
    if not file.is_file():
        pytest.skip(f"no {file}; set ORTHAUG_DATA to the folder of the data sets")
    result = fitted(tmp_path, TANKS.format(file=file))
    table = pd.read_csv(file)
    u, y = table["uEst"].to_numpy(), table["yEst"].to_numpy()
    expected = np.linalg.lstsq(np.stack([y[:-1], u[:-1]], axis=1), y[1:], rcond=None)[0]
    np.testing.assert_allclose(theta(result), expected, rtol=1e-9)
    u, y = table["uVal"].to_numpy(), table["yVal"].to_numpy()
    errors = (y[1:] - np.stack([y[:-1], u[:-1]], axis=1) @ expected)[4:]
    rmse = result["scores"]["tests.official"]["prediction"]["rmse"][0]
    assert rmse == pytest.approx(np.sqrt(np.mean(errors**2)), rel=1e-9)


# --- what is refused, in words that list what the file holds

U, Y = (values[None] for values in signals(20, 1))


@each(EVERY)
def test_a_missing_variable(tmp_path, writer):
    path = put(tmp_path, writer, force=U, speed=Y)
    refused(
        tmp_path,
        SPEC.format(file=path.name, u="forc", y="speed"),
        path.name,
        "'forc'",
        "'force'",
        "speed",
    )


@each(WRITERS)
@pytest.mark.parametrize("name", ["U[3]", "u[1]"])
def test_a_column_out_of_range(tmp_path, writer, name):
    path = put(tmp_path, writer, U=np.ones((20, 3)), u=np.ones((20, 1)), y=Y)
    refused(
        tmp_path, SPEC.format(file=path.name, u=name, y="y"), path.name, f"'{name}'", "U (20×3)"
    )


@each(WRITERS)
def test_a_column_that_is_no_number(tmp_path, writer):
    path = put(tmp_path, writer, U=np.ones((20, 3)), y=Y)
    refused(tmp_path, SPEC.format(file=path.name, u="U[-1]", y="y"), path.name, "'U[-1]'", "U[0]")


@each(WRITERS)
def test_a_matrix_without_a_column(tmp_path, writer):
    path = put(tmp_path, writer, U=np.ones((20, 3)), y=Y)
    refused(
        tmp_path, SPEC.format(file=path.name, u="U", y="y"), path.name, "'U'", "U[0]", "U (20×3)"
    )


@each(WRITERS)
def test_complex_numbers(tmp_path, writer):
    path = put(tmp_path, writer, u=U + 1j, y=Y)
    refused(tmp_path, SPEC.format(file=path.name, u="u", y="y"), path.name, "'u' is complex", "y (")


@each(WRITERS)
def test_lengths_that_differ(tmp_path, writer):
    path = put(tmp_path, writer, u=U[:, :15], y=Y)
    refused(tmp_path, SPEC.format(file=path.name, u="u", y="y"), path.name, "15", "20")


@each(WRITERS)
def test_a_cell_that_is_not_finite(tmp_path, writer):
    broken = Y.copy()
    broken[0, 7] = np.nan
    path = put(tmp_path, writer, u=U, y=broken)
    refused(tmp_path, SPEC.format(file=path.name, u="u", y="y"), path.name, "row 7", "'y'")


NO_NUMBERS = {
    "struct": ({"x": np.ones((1, 3))}, "struct"),
    "cell": ([np.ones(3), np.ones(2)], "cell"),
    "text": ("twelve", "text"),
    "sparse": (scipy.sparse.csc_matrix(np.eye(20)[:, :1]), "sparse"),
}


@each(MATLAB)
@pytest.mark.parametrize(("value", "word"), NO_NUMBERS.values(), ids=NO_NUMBERS.keys())
def test_what_holds_no_numbers(tmp_path, writer, value, word):
    if isinstance(value, list) and writer[1] is put_v5:
        value = np.array([*value, None], dtype=object)[:-1]
    path = put(tmp_path, writer, thing=value, y=Y)
    refused(
        tmp_path,
        SPEC.format(file=path.name, u="thing", y="y"),
        path.name,
        "'thing'",
        word,
        "y (1×20)",
    )


@each(MATLAB)
def test_a_struct_beside_vectors_does_not_disturb(tmp_path, writer, from_csv):
    u, y = signals(80, 1)
    path = put(
        tmp_path,
        writer,
        info={"x": np.ones((1, 3)), "note": "text"},
        title="run 1",
        u=u[None],
        y=y[None],
    )
    found = theta(fitted(tmp_path, SPEC.format(file=path.name, u="u", y="y")))
    np.testing.assert_allclose(found, from_csv, rtol=1e-12)


def test_an_array_of_structs(tmp_path):
    path = put_v5(tmp_path / "run.mat", thing=np.array([(1.0,), (2.0,)], dtype=[("x", "f8")]), y=Y)
    refused(
        tmp_path,
        SPEC.format(file=path.name, u="thing", y="y"),
        "run.mat",
        "'thing' is a struct",
        "y (1×20)",
    )


def test_text_in_hdf5(tmp_path):
    path = put_hdf5(tmp_path / "run.h5", u=np.array([b"a", b"b"]), y=Y)
    refused(
        tmp_path,
        SPEC.format(file=path.name, u="u", y="y"),
        "run.h5",
        "'u'",
        "no numbers",
        "y (1×20)",
    )


def test_paths_with_points_or_slashes(tmp_path):
    path = put_hdf5(tmp_path / "run.h5", **{"run/deep/u": U, "y": Y})
    matlab = put_v73(
        tmp_path / "run.mat", run={"deep": {"u": U}, "cell": [np.stack([np.ravel(U), np.ravel(Y)])]}
    )
    for file in (path, matlab):
        for name in ("run.deep.u", "run/deep/u", "/run/deep/u"):
            np.testing.assert_array_equal(read_variables(file, (name,))[name], np.ravel(U))
    np.testing.assert_array_equal(
        read_variables(matlab, ("run.cell[1]",))["run.cell[1]"], np.ravel(Y)
    )


def put_references(file, name: str, held: list, *, cell: bool) -> None:
    """Elements behind references, in a cell or in a field of an array of structs."""
    made = [file.require_group("#refs#").create_dataset(f"{name[-1]}{i}", data=np.atleast_2d(v).T).ref
            for i, v in enumerate(held)]  # fmt: skip
    data = file.create_dataset(
        name, data=np.array([made], dtype=h5py.ref_dtype), dtype=h5py.ref_dtype
    )
    if cell:
        data.attrs["MATLAB_class"] = np.bytes_("cell")


def test_cells_and_arrays_of_structs_of_v73(tmp_path):
    u, path = np.arange(6.0), tmp_path / "run.mat"
    with h5py.File(path, "w") as file:
        put_references(file, "c", [u, 3 * u], cell=True)
        put_references(file, "runs/u", [u, 5 * u], cell=False)
        put_references(file, "runs/w", [2 * u, np.zeros((0, 0))], cell=False)
        struct = file["#refs#"].create_group("struct")
        struct.create_dataset("y", data=7 * u[:, None])
        reference = np.array([[struct.ref, file["c"].ref]], dtype=h5py.ref_dtype)
        file.create_dataset("deep", data=reference, dtype=h5py.ref_dtype).attrs["MATLAB_class"] = (
            np.bytes_("cell")
        )
    wanted = {
        "c[0]": 1,
        "c[1]": 3,
        "runs[0].u": 1,
        "runs[1].u": 5,
        "runs[0].w": 2,
        "deep[0].y": 7,
        "deep[1][1]": 3,
    }
    for name, values in read_variables(path, tuple(wanted)).items():
        np.testing.assert_array_equal(values, wanted[name] * u, err_msg=name)
    with pytest.raises(InputError, match="'c' is a cell, no numbers"):
        read_variables(path, ("c",))


def test_cells_that_hold_themselves_end(tmp_path):
    path = tmp_path / "run.mat"
    with h5py.File(path, "w") as file:
        data = file.create_dataset("c", shape=(1, 50), dtype=h5py.ref_dtype)
        data[:] = np.array([[data.ref] * 49 + [h5py.Reference()]], dtype=h5py.ref_dtype)
        data.attrs["MATLAB_class"] = np.bytes_("cell")
        file.create_dataset("y", data=np.ones((9, 1)))
    np.testing.assert_array_equal(read_variables(path, ("y",))["y"], np.ones(9))


def test_signals_that_a_file_names(tmp_path):
    u = np.arange(6.0)
    signals_ = np.array([("Force", u), ("", 2 * u)], dtype=[("Name", object), ("Data", object)])
    scope = {"time": u, "signals": {"label": "Speed", "values": 3 * u}}
    scipy.io.savemat(tmp_path / "run.mat", {"run": {"Y": signals_}, "scope": scope})
    assert read_titles(tmp_path / "run.mat").names == [
        "Force",
        "run.Y[1].Data",
        "scope.time",
        "Speed",
    ]
    wanted = {
        "Force": 1,
        "run.Y[0].Data": 1,
        "run.Y[1].Data": 2,
        "Speed": 3,
        "scope.signals.values": 3,
    }
    for name, factor in wanted.items():
        np.testing.assert_array_equal(
            read_variables(tmp_path / "run.mat", (name,))[name], factor * u
        )


def test_a_group_of_hdf5(tmp_path):
    path = put_hdf5(tmp_path / "run.h5", **{"run/u": U, "y": Y})
    refused(
        tmp_path,
        SPEC.format(file=path.name, u="run", y="y"),
        "run.h5",
        "'run' is a group",
        "run/u (1×20)",
    )


@each(EVERY)
@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_a_file_that_is_cut(tmp_path, writer, share):
    path = put(
        tmp_path, writer, u=np.random.default_rng(0).normal(size=(1, 900)), y=np.ones((1, 900))
    )
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    refused(tmp_path, SPEC.format(file=path.name, u="u", y="y"), path.name)


@each(EVERY)
@pytest.mark.parametrize("size", [1, 128, 5000])
def test_garbage(tmp_path, writer, size):
    path = tmp_path / writer[0]
    path.write_bytes(np.random.default_rng(size).integers(0, 256, size, dtype="u1").tobytes())
    refused(tmp_path, SPEC.format(file=path.name, u="u", y="y"), path.name)


@each(MATLAB)
def test_bytes_that_are_wrong_in_the_middle(tmp_path, writer):
    path = put(tmp_path, writer, u=U, y=Y)
    content = bytearray(path.read_bytes())
    middle = len(content) // 2
    for start in (130, middle):
        broken = content.copy()
        broken[start : start + 40] = b"\xff" * 40
        path.write_bytes(broken)
        try:
            read_variables(path, ("u", "y"))
        except InputError as error:
            assert "run.mat" in str(error)


def test_no_variables_at_all(tmp_path):
    path = put_hdf5(tmp_path / "run.h5")
    refused(tmp_path, SPEC.format(file=path.name, u="u", y="y"), "run.h5", "nothing")
