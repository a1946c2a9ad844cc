"""MATLAB v5 files: what SciPy wrote is read to the last bit, and what is cut anywhere is refused."""

from __future__ import annotations

import struct
import zlib

import numpy as np
import pytest
import scipy.io

from orthaug import InputError
from orthaug.data.matlab import read_mat5
from orthaug.data.variables import read_variables

KINDS = ["f8", "f4", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "?"]


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_number(tmp_path, kind, compressed):
    rng = np.random.default_rng(0)
    values = (
        (100 * rng.normal(size=(40, 3))).astype(kind)
        if kind != "?"
        else rng.normal(size=(40, 3)) > 0
    )
    empty = {
        "text": "warm",
        "cell": np.array([1, "a"], object),
        "z": values * 1j,
        "e": np.zeros((0, 0)),
    }
    scipy.io.savemat(
        tmp_path / "run.mat", {"a": values, "s": {"b": values}, **empty}, do_compression=compressed
    )
    read = read_variables(tmp_path / "run.mat", ("a[1]", "a[7,:]", "s.b[2]"))
    expected = scipy.io.loadmat(tmp_path / "run.mat")["a"]
    for found, wanted in zip(
        read.values(), (expected[:, 1], expected[7], expected[:, 2]), strict=True
    ):
        np.testing.assert_array_equal(found, wanted.astype(float))
    for name, words in (("text", "text"), ("cell", "a cell"), ("z", "complex"), ("s", "a struct")):
        with pytest.raises(InputError, match=words):
            read_variables(tmp_path / "run.mat", (name,))


def test_paths_into_structs_and_cells(tmp_path):
    """An exported iddata has its signals in cells of one matrix, several runs are an array of structs."""
    u, path = np.arange(6.0), tmp_path / "run.mat"
    one, two = np.empty((1, 1), object), np.empty((1, 2), object)
    one[0, 0], two[0, 0], two[0, 1] = np.stack([u, 2 * u], 1), u[None], 3 * u
    runs = np.array(
        [(u, {"y": 4 * u}), (5 * u, {"y": 6 * u})], dtype=[("u", object), ("deep", object)]
    )
    scipy.io.savemat(path, {"z": {"InputData": one}, "c": two, "runs": runs})
    wanted = {
        "z.InputData[1]": 2,
        "z/InputData[0]": 1,
        "c[0]": 1,
        "c[1]": 3,
        "runs[1].u": 5,
        "runs[1].deep.y": 6,
    }
    for name, values in read_variables(path, tuple(wanted)).items():
        np.testing.assert_array_equal(values, wanted[name] * u, err_msg=name)
    for name, words in (
        ("z.InputData", 'no vector; write a column of a matrix as "z.InputData\\[0\\]"'),
        ("c{2}", 'elements are counted from 0 here, "c\\[1\\]"'),
        ("runs(1).u", 'counted from 0 here, "runs\\[0\\].u"'),
        ("z.InputData(:, 2)", '"z.InputData\\[1\\]"'),
        ("runs.u", "no variable 'runs.u', did you mean 'runs\\[1\\].u'"),
    ):
        with pytest.raises(InputError, match=words):
            read_variables(path, (name,))


def big_endian(values: np.ndarray) -> bytes:
    """A file of one vector as a machine of the other byte order writes it."""

    def element(kind: int, data: bytes) -> bytes:
        return struct.pack(">II", kind, len(data)) + data + bytes(-len(data) % 8)

    body = element(6, struct.pack(">II", 6, 0)) + element(5, struct.pack(">ii", 1, len(values)))
    body += struct.pack(">HH4s", 1, 1, b"u") + element(9, values.astype(">f8").tobytes())
    return b"MATLAB 5.0".ljust(124) + b"\x01\x00MI" + element(14, body)


def test_the_other_byte_order(tmp_path):
    values = np.random.default_rng(1).normal(size=9)
    (tmp_path / "run.mat").write_bytes(big_endian(values))
    np.testing.assert_array_equal(read_variables(tmp_path / "run.mat", ("u",))["u"], values)
    np.testing.assert_array_equal(scipy.io.loadmat(tmp_path / "run.mat")["u"].ravel(), values)


@pytest.mark.parametrize("compressed", [False, True])
def test_a_file_that_ends_anywhere_is_refused(tmp_path, compressed):
    path = tmp_path / "run.mat"
    scipy.io.savemat(path, {"u": np.arange(50.0) ** 0.5}, do_compression=compressed)
    content = path.read_bytes()
    for end in range(0, len(content) - 1, 3):
        path.write_bytes(content[:end])
        with pytest.raises(InputError, match="run.mat"):
            read_variables(path, ("u",))


def test_a_compressed_variable_that_swells_is_not_inflated(monkeypatch):
    monkeypatch.setattr("orthaug._base.memory.available", lambda: 1e6)
    data = struct.pack("<II", 14, 2**31 - 16) + struct.pack("<IIII", 6, 8, 6, 0)
    data += (
        struct.pack("<IIii", 5, 8, 1, 2**28 - 10)
        + struct.pack("<HH4s", 1, 1, b"u")
        + struct.pack("<II", 9, 2**31 - 80)
    )
    packed = zlib.compress(data + bytes(10**6))
    content = (
        b"MATLAB 5.0".ljust(124) + b"\x00\x01IM" + struct.pack("<II", 15, len(packed)) + packed
    )
    with pytest.raises(InputError, match="a compressed variable would take 6 GiB of memory"):
        read_mat5(content, "run.mat")["u"].numbers()
