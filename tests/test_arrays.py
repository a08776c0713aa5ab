"""Files of arrays from others: the honest are read, the broken or hostile end in a sentence and run nothing."""

import io
import os
import pickle
import subprocess
import sys
import zipfile

import numpy as np
import pytest
from helpers.smpl_pickles import Foreign, python_2_pickle, run_code
from numpy.core.multiarray import _reconstruct
from scipy import sparse

from stmc.io.arrays import ArraysError, npz_headers, read_npy, read_npz, read_pickle


def test_required_and_optional_arrays_come_back_and_nothing_else(tmp_path):
    np.savez_compressed(tmp_path / "a.npz", one=np.arange(3), two=np.eye(2), three=np.zeros(1))
    assert tuple(npz_headers(tmp_path / "a.npz")) == ("one", "two", "three")
    arrays = read_npz(tmp_path / "a.npz", ["one"], ["two", "four"])
    assert list(arrays) == ["one", "two"]
    assert arrays["one"].tolist() == [0, 1, 2]
    with pytest.raises(ArraysError, match=r"a\.npz has no array four; it has one, two, three"):
        read_npz(tmp_path / "a.npz", ["one", "four"])


def saved(**arrays) -> bytes:
    file = io.BytesIO()
    np.savez_compressed(file, **arrays)
    return file.getvalue()


def flipped(content: bytes) -> bytes:
    middle = len(content) // 3
    return content[:middle] + bytes([content[middle] ^ 255]) + content[middle + 1 :]


WHOLE = saved(one=np.random.default_rng(0).random(2000))
BROKEN = {
    "empty": (b"", "cannot be read"),
    "cut off": (WHOLE[: len(WHOLE) // 2], "cannot be read"),
    "damaged inside": (flipped(WHOLE), "cannot be read"),
    "a text": (b"hello, this is a text and no archive", "cannot be read"),
    "a bare pickle": (pickle.dumps({"one": 1}), "pickled Python objects, which could run code"),
    "objects": (saved(one=np.array([Foreign()], dtype=object)), "pickled Python objects, which could run code"),
}


@pytest.mark.parametrize(("content", "message"), BROKEN.values(), ids=BROKEN)
def test_a_broken_npz_is_named(content, message, tmp_path):
    (tmp_path / "a.npz").write_bytes(content)
    with pytest.raises(ArraysError, match=rf"a\.npz.*{message}"):
        read_npz(tmp_path / "a.npz", ["one"])


@pytest.mark.parametrize("name", ["../one.npy", "/etc/one.npy", "a/../../one.npy", "..\\one.npy"])
def test_a_zip_that_names_places_outside_of_itself_is_refused(name, tmp_path):
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        for inside in ("one.npy", name):
            file = io.BytesIO()
            np.save(file, np.zeros(3))
            archive.writestr(inside, file.getvalue())
    with pytest.raises(ArraysError, match="a path outside of the archive"):
        read_npz(tmp_path / "a.npz", ["one"])
    assert os.listdir(tmp_path) == ["a.npz"]


def test_a_small_zip_that_would_become_more_than_any_memory_is_refused_before_it_is_unpacked(tmp_path, monkeypatch):
    monkeypatch.setattr("stmc.io.arrays.numpy_files.LARGEST", 10**6)
    np.savez_compressed(tmp_path / "a.npz", small=np.zeros(10), one=np.zeros(200_000))
    assert (tmp_path / "a.npz").stat().st_size < 10_000
    assert list(read_npz(tmp_path / "a.npz", ["small"])) == ["small"]
    with pytest.raises(ArraysError, match="one has 1600128 bytes; the limit is"):
        read_npz(tmp_path / "a.npz", ["one"])


def test_one_array_and_a_zip_of_arrays_are_not_taken_for_one_another(tmp_path):
    np.save(tmp_path / "a.npy", np.arange(4))
    assert read_npy(tmp_path / "a.npy").tolist() == [0, 1, 2, 3]
    (tmp_path / "a.npy").rename(tmp_path / "a.npz")
    with pytest.raises(ArraysError, match=r"one array \(\.npy\)"):
        read_npz(tmp_path / "a.npz", ["one"])
    (tmp_path / "a.npy").write_bytes(WHOLE)
    with pytest.raises(ArraysError, match=r"a zip of arrays \(\.npz\)"):
        read_npy(tmp_path / "a.npy")


@pytest.mark.parametrize("content", [b"", b"text", pickle.dumps([1]), b"\x93NUMPY\x01\x00"])
def test_a_broken_npy_is_named(content, tmp_path):
    (tmp_path / "a.npy").write_bytes(content)
    with pytest.raises(ArraysError, match=r"a\.npy cannot be read as \.npy"):
        read_npy(tmp_path / "a.npy")


def written(folder, content) -> object:
    path = folder / "a.pkl"
    path.write_bytes(content if isinstance(content, bytes) else pickle.dumps(content))
    return path


@pytest.mark.parametrize("protocol", range(6))
def test_pickled_arrays_matrices_and_numbers_are_read_in_every_protocol(protocol, tmp_path):
    rng = np.random.default_rng(0)
    dense = rng.standard_normal((4, 6)) * (rng.random((4, 6)) < 0.4)
    content = {
        "plain": dense,
        "fortran": np.asfortranarray(dense.astype(">f4")),
        "whole": rng.integers(0, 9, (3, 2)).astype(np.uint32),
        "number": np.float64(2.5),
        "csc": sparse.csc_matrix(dense),
        "csr": sparse.csr_matrix(dense),
        "coo": sparse.coo_matrix(dense),
        "style": "lbs",
        "info": {"nested": [1, None, {"a": {2}}]},
    }
    names = [name for name in content if name not in ("style", "info")]
    arrays = read_pickle(written(tmp_path, pickle.dumps(content, protocol)), names, ["absent"])
    assert list(arrays) == names
    for name, array in arrays.items():
        expected = content[name].toarray() if sparse.issparse(content[name]) else content[name]
        np.testing.assert_array_equal(array, expected)
    assert np.dtype("f4").byteorder == "=", "a file's byte order is its own"


@pytest.mark.parametrize("protocol", [0, 1, 2])
def test_chumpy_s_objects_in_python_2_s_pickles_are_their_arrays(protocol, tmp_path):
    values = np.random.default_rng(1).standard_normal((5, 3))
    content = python_2_pickle(
        {"constant": ("Ch", values), "chosen": ("Select", values, [3, 0, 14, 2], (2, 2))}, protocol
    )
    assert b"copy_reg" in content or protocol == 2
    assert b"chumpy" in content
    arrays = read_pickle(written(tmp_path, content), ["constant", "chosen"])
    np.testing.assert_array_equal(arrays["constant"], values)
    np.testing.assert_array_equal(arrays["chosen"], values.ravel()[[3, 0, 14, 2]].reshape(2, 2))


def test_a_formula_of_chumpy_s_is_named_only_where_it_is_asked_for(tmp_path):
    content = python_2_pickle({"sum": ("add", np.eye(2)), "plain": ("Ch", np.eye(2))}, 2)
    assert read_pickle(written(tmp_path, content), ["plain"])["plain"].shape == (2, 2)
    with pytest.raises(ArraysError, match=r"a\.pkl: sum is a chumpy\.ch\.add, a formula that only chumpy can compute"):
        read_pickle(tmp_path / "a.pkl", ["sum"])


@pytest.mark.parametrize("protocol", range(6))
@pytest.mark.parametrize("call", ["os.system", "builtins.eval", "builtins.getattr", "numpy.load", "subprocess.Popen"])
def test_a_pickle_that_would_run_code_runs_nothing(call, protocol, tmp_path):
    mark = tmp_path / "it ran"
    content = run_code(call, f"touch '{mark}'", protocol)
    with pytest.raises(ArraysError, match=r"refused to run .*the file must hold arrays alone"):
        read_pickle(written(tmp_path, content), ["plain"])
    assert not mark.exists()


HOSTILE = {
    "a foreign subclass of arrays": b"cnumpy.core.multiarray\n_reconstruct\n(S'x'\n(I0\ntS'b'\ntR.",
    "an object of no class": b"ccopy_reg\n_reconstructor\n(cnumpy\ndtype\nc__builtin__\nobject\nNtR.",
    "another encoding": b"c_codecs\nencode\n(S'x'\nS'rot13'\ntR.",
    "attributes of ours": b"cnumpy.core.multiarray\nscalar\n(N}S'__defaults__'\nS'x'\nstb.",
    "cut off": pickle.dumps({"plain": np.zeros(1000)})[:500],
    "empty": b"",
    "a text": b"hello",
    "a persistent name": b"Psomething\n.",
}


@pytest.mark.parametrize("content", HOSTILE.values(), ids=HOSTILE)
def test_a_hostile_or_broken_pickle_is_named(content, tmp_path):
    with pytest.raises(ArraysError, match=r"a\.pkl"):
        read_pickle(written(tmp_path, content), ["plain"])


def matrix(**state):
    """A pickled sparse matrix whose state is what a broken file may hold."""
    made = sparse.csc_matrix(np.eye(3))
    made.__dict__.update(state)
    return made


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (np.array([{"a": 1}], dtype=object), "holds Python objects"),
        ([1, 2], "is a list, not an array"),
        (matrix(indices=np.array([0, 1, 99], dtype=np.int32)), "damaged scipy"),
        (matrix(_shape=(10**9, 10**9)), "1000000000 x 1000000000 numbers"),
        (matrix(_shape=(24, 10**6)), "24 x 1000000 numbers"),
        (matrix(_shape=(-1, 3)), "-1 x 3 numbers"),
        (matrix(indptr=None), "indptr is a NoneType, not an array"),
    ],
)
def test_what_is_no_array_is_named(value, message, tmp_path):
    with pytest.raises(ArraysError, match=message):
        read_pickle(written(tmp_path, {"plain": value}), ["plain"])
    with pytest.raises(ArraysError, match="holds a list, not a dict"):
        read_pickle(written(tmp_path, [value]), ["plain"])
    with pytest.raises(ArraysError, match="has no array plain; it has other"):
        read_pickle(written(tmp_path, {"other": value}), ["plain"])


class Forged:
    """An array whose type, shape and bytes are what a hostile file says, as NumPy's own pickles spell them."""

    def __init__(self, name="f8", state=(3, "<", None, None, None, -1, -1, 0), shape=(2,), content=b"x" * 16):
        self.type, self.shape, self.content = ForgedType(name, state), shape, content

    def __reduce__(self):
        return _reconstruct, (np.ndarray, (0,), b"b"), (1, self.shape, self.type, False, self.content)


class ForgedType:
    def __init__(self, name, state) -> None:
        self.name, self.state = name, state

    def __reduce__(self):
        return np.dtype, (self.name, False, True), self.state


def fields(inner, offset: int, flags: int = 0) -> tuple:
    return 3, "|", None, ("field",), {"field": (np.dtype(inner), offset)}, 8, 1, flags


FORGED = {
    "a field of objects that says it has none": Forged("V8", fields("O", 0)),
    "a field beyond its item": Forged("V8", fields("f8", 64)),
    "a field far beyond its item": Forged("V8", fields("f8", 10**11)),
    "fields in a plain type": Forged("f8", fields("O", 0)),
    "a size of its own": Forged("f8", (3, "<", None, None, None, 800, 8, 0)),
    "an item of texts larger than it": Forged("S8", (3, "|", None, None, None, 800, 1, 0)),
    "an array within each item": Forged("f8", (3, "<", (np.dtype("f8"), (9,)), None, None, -1, -1, 0)),
    "a state of another kind": Forged("f8", (3,)),
    "an order that is none": Forged("f8", (3, "?", None, None, None, -1, -1, 0)),
    "objects": Forged("O", (3, "|", None, None, None, -1, -1, 63)),
    "a type in a text": Forged("f8,O", (3, "|", None, None, None, -1, -1, 0)),
    "no such type": Forged("float7"),
    "empty items": Forged("S0", (3, "|", None, None, None, 0, 1, 0), (10**12,), b""),
    "dates": Forged("M8[s]"),
    "more numbers than bytes": Forged(shape=(3,)),
    "fewer numbers than bytes": Forged(shape=(1,)),
    "a shape that overflows": Forged(shape=(2**62, 4), content=b""),
    "a negative shape": Forged(shape=(-2, -1)),
    "a shape of floats": Forged(shape=(2.0,)),
    "no bytes": Forged(content=None),
}


@pytest.mark.parametrize("forged", FORGED.values(), ids=FORGED)
@pytest.mark.parametrize("protocol", [0, 2, 5])
def test_an_array_that_would_read_memory_beyond_its_bytes_is_refused_where_it_is_asked_for(forged, protocol, tmp_path):
    path = written(tmp_path, pickle.dumps({"forged": forged, "plain": np.arange(3)}, protocol))
    with pytest.raises(ArraysError, match=r"a\.pkl: forged") as error:
        read_pickle(path, ["forged"])
    assert len(str(error.value)) < 400 + len(str(path))
    assert read_pickle(path, ["plain"])["plain"].tolist() == [0, 1, 2]


def test_forged_pickles_are_as_numpy_would_read_them():
    assert pickle.loads(pickle.dumps(Forged(content=np.array([1.0, 2.0]).tobytes()))).tolist() == [1, 2]


@pytest.mark.parametrize("values", [["a", "bc"], [b"a", b"bc"], [True, False], [1.5], np.zeros((0, 3)), np.int8(3)])
def test_plain_arrays_of_every_kind_come_back(values, tmp_path):
    for protocol in (0, 2, 4):
        back = read_pickle(written(tmp_path, pickle.dumps({"plain": np.array(values)}, protocol)), ["plain"])["plain"]
        np.testing.assert_array_equal(back, np.array(values), strict=True)


def test_a_pickle_of_six_bytes_takes_no_memory_and_sets_no_attribute(tmp_path):
    for content in (
        b"\x80\x02]r\xff\xff\xff\xff.",  # the four billionth thing to remember
        b"\x80\x04\x8e\xff\xff\xff\xff\xff\xff\xff\x00x.",  # bytes, more than any memory
        b"cnumpy.core.multiarray\nscalar\n}(S'__wrapped__'\nS'x'\nub.",
    ):
        with pytest.raises(ArraysError, match=r"a\.pkl"):
            read_pickle(written(tmp_path, content), ["plain"])


DOUBLED = b")" + b"2\x86" * 34
"""A tuple of itself twice, 34 levels deep: 2**34 steps of `hash`, `repr` or `==`."""
ENDLESS = {
    "a key": b"\x80\x02}" + DOUBLED + b"K\x01s.",
    "keys": b"\x80\x02}(" + DOUBLED + b"K\x01u.",
    "a dict of the first protocol": b"(" + DOUBLED + b"K\x01d.",
    "a member of a set": b"\x80\x04\x8f(" + DOUBLED + b"\x90.",
    "a member of a frozen set": b"\x80\x04(" + DOUBLED + b"\x91.",
    "a member of an older set": b"\x80\x02c__builtin__\nset\n]" + DOUBLED + b"a\x85R.",
    "a set of no list": b"\x80\x02c__builtin__\nset\n" + DOUBLED + b"\x85\x81.",
    "a key of an ordered dict": b"\x80\x02ccollections\nOrderedDict\n]((" + DOUBLED + b"K\x01le\x85R.",
    "a class": b"\x80\x02ccopy_reg\n_reconstructor\n" + DOUBLED + b"\x85R.",
    "an encoding": b"\x80\x02c_codecs\nencode\nX\x01\x00\x00\x00x" + DOUBLED + b"\x86R.",
    "a type": b"\x80\x02}X\x05\x00\x00\x00plaincnumpy.core.multiarray\nscalar\ncnumpy\ndtype\n"
    + DOUBLED
    + b"\x85RX\x01\x00\x00\x00x\x86Rs.",
    "a matrix's size": b"\x80\x02}X\x05\x00\x00\x00plaincscipy.sparse\ncsc_matrix\n)\x81}X\x06\x00\x00\x00_shape"
    + DOUBLED
    + b"K\x01\x86sbs.",
    "a selection of selections": b"\x80\x02}X\x05\x00\x00\x00plain"
    + b"cchumpy.ch\nCh\n)\x81q\x00}X\x01\x00\x00\x00xK\x00sb0"
    + b"".join(
        b"cchumpy.reordering\nSelect\n)\x81q%c}(X\x01\x00\x00\x00ah%cX\x04\x00\x00\x00idxsh%cub0" % (n, n - 1, n - 1)
        for n in range(1, 40)
    )
    + b"h%cs." % 39,
    "copies of a text": b"\x80\x02](X\x00\x00\x01\x00"
    + b"x" * 65536
    + b"q\x00"
    + b"c_codecs\nencode\nh\x00\x85R" * 9999
    + b"e.",
    "a shape of many axes": b"\x80\x02}X\x05\x00\x00\x00plain"
    + b"cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\n\x85R(K\x01("
    + b"J\xff\xff\xff\x7f" * 100_000
    + b"tcnumpy\ndtype\nX\x02\x00\x00\x00f8\x85R\x89X\x00\x00\x00\x00tbs.",
}


@pytest.mark.parametrize("content", ENDLESS.values(), ids=ENDLESS)
def test_a_pickle_that_would_never_end_is_refused_within_a_second(content, tmp_path):
    path = written(tmp_path, content)
    code = (
        "import sys, time; from pathlib import Path; from stmc.io.arrays import *\n"
        "began = time.process_time()\n"
        "for read in (lambda path: read_pickle(path, ['plain']), read_places, lambda path: read_joblib(path, ['x'])):\n"
        "    try: read(Path(sys.argv[1])); sys.exit('it was read')\n"
        "    except ArraysError as error: assert len(str(error)) < 600, error\n"
        "assert time.process_time() - began < 3\n"
    )
    subprocess.run([sys.executable, "-c", code, str(path)], check=True, timeout=60)


def test_keys_and_members_are_texts_and_numbers(tmp_path):
    content = {"plain": np.arange(3), "info": {"a": {1, 2.5, b"b", "c"}, 3: frozenset({"d"}), 2.5: None}}
    for protocol in range(6):
        path = written(tmp_path, pickle.dumps(content, protocol))
        assert read_pickle(path, ["plain"])["plain"].tolist() == [0, 1, 2]
    path = written(tmp_path, pickle.dumps({"plain": np.arange(3), (1, 2): 3}))
    with pytest.raises(ArraysError, match=r"a key that is a tuple; only texts and numbers are supported"):
        read_pickle(path, ["plain"])


def test_a_selection_of_itself_is_refused(tmp_path):
    content = python_2_pickle({"chosen": ("Select", np.eye(2), [0], (1,))}, 2)
    assert read_pickle(written(tmp_path, content), ["chosen"])["chosen"].tolist() == [1.0]
    itself = b"(dS'plain'\ncchumpy.reordering\nSelect\n)\x81p0\n(dS'a'\ng0\nS'idxs'\ng0\nsbs."
    with pytest.raises(ArraysError, match=r"a\.pkl"):
        read_pickle(written(tmp_path, itself), ["plain"])
