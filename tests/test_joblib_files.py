"""joblib's files: the honest are read, plain or packed; the broken or hostile end in a sentence and run nothing."""

import gzip
import pickle
import sys
import zlib

import numpy as np
import pytest
from helpers.joblib_files import Opcodes, joblib_bytes, wrapped
from helpers.smpl_pickles import run_code
from hypothesis import given
from hypothesis import strategies as st

from stmc.io.arrays import ArraysError, read_joblib

NAMES = ["poses", "trans", "fps"]


def entries() -> list[dict]:
    rng = np.random.default_rng(0)
    return [
        {
            "poses": rng.standard_normal((frames, 6)),
            "trans": np.asfortranarray(rng.standard_normal((frames, 3)).astype(np.float32)),
            "fps": 30,
            "fname": f"KIT/KIT/{frames}/gehört_poses.npz",
            "joint_positions": np.zeros((frames, 4, 3), dtype=">f4"),
            "more": {"nested": [None, True, 2.5]},
        }
        for frames in (5, 0, 2)
    ]


def same(found: list[dict], expected: list[dict]) -> None:
    assert [list(each) for each in found] == [[*NAMES, "fname"]] * len(expected)
    for each, other in zip(found, expected, strict=True):
        assert each["fname"] == other["fname"]
        for name in NAMES:
            np.testing.assert_array_equal(each[name], np.asarray(other[name]), strict=True)


def written(folder, content: bytes):
    path = folder / "a.pth.tar"
    path.write_bytes(content)
    return path


# The honest -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("alignment", [16, None], ids=["today's", "before 1.2"])
@pytest.mark.parametrize("pack", [bytes, zlib.compress, gzip.compress], ids=["plain", "zlib", "gzip"])
def test_the_named_arrays_and_texts_of_every_dict_come_back(alignment, pack, tmp_path):
    path = written(tmp_path, pack(joblib_bytes(entries(), alignment)))
    same(read_joblib(path, NAMES, ["fname"]), entries())


@pytest.mark.parametrize("protocol", range(6))
@pytest.mark.parametrize("compress", [0, ("zlib", 3), ("gzip", 3)])
def test_what_joblib_itself_writes_is_read(protocol, compress, tmp_path):
    joblib = pytest.importorskip("joblib")
    path = tmp_path / "a.pth.tar"
    joblib.dump(entries(), path, compress=compress, protocol=protocol)
    same(read_joblib(path, NAMES, ["fname"]), entries())


@pytest.mark.parametrize("alignment", [16, None])
def test_the_files_of_these_tests_are_as_joblib_would_read_them(alignment, tmp_path):
    joblib = pytest.importorskip("joblib")
    same(
        [
            {name: np.asarray(each[name]) for name in NAMES} | {"fname": each["fname"]}
            for each in joblib.load(written(tmp_path, joblib_bytes(entries(), alignment)))
        ],
        entries(),
    )


def test_arrays_of_a_plain_file_stay_on_the_disk_and_cannot_be_written(tmp_path):
    [first, *_] = read_joblib(written(tmp_path, joblib_bytes(entries())), NAMES)
    assert not first["poses"].flags.owndata and not first["poses"].flags.writeable


# The broken -----------------------------------------------------------------------------------------------------------

WHOLE = joblib_bytes(entries())
BROKEN = {
    "empty": (b"", "it is empty"),
    "a text": (b"hello", "not a joblib file, or is damaged"),
    "cut off": (WHOLE[:400], "extends beyond the end of the file"),
    "cut off, packed": (zlib.compress(WHOLE)[:500], "it is truncated"),
    "damaged, packed": (zlib.compress(WHOLE)[:300] + b"\0" * 300, "not a joblib file, or is damaged"),
    "bz2": (b"BZh91AY&SY", "its compression, bz2, is not supported"),
    "xz": (b"\xfd7zXZ\x00", "its compression, xz, is not supported"),
    "lzma": (b"]\x00\x00\x80\x00", "its compression, lzma, is not supported"),
    "lz4": (b'\x04"M\x18', "its compression, lz4, is not supported"),
    "one dict": (joblib_bytes({"poses": np.eye(2)}), "not a list of dicts"),
    "a list of arrays": (joblib_bytes([np.eye(2)]), "not a list of dicts"),
    "without fps": (
        joblib_bytes([entries()[0], {"poses": np.eye(2), "trans": np.eye(2)}]),
        "entry 1 has no fps, fname",
    ),
    "a name in numbers": (joblib_bytes([entries()[0] | {"fname": 3}]), "fname of entry 0 is a int, not a text"),
    "poses in a text": (joblib_bytes([entries()[0] | {"poses": "x"}]), "poses of entry 0 is a str, not an array"),
}


@pytest.mark.parametrize(("content", "message"), BROKEN.values(), ids=BROKEN)
def test_a_broken_file_is_named(content, message, tmp_path):
    with pytest.raises(ArraysError, match=rf"a\.pth\.tar.*{message}"):
        read_joblib(written(tmp_path, content), NAMES, ["fname"])


def test_a_small_file_that_would_become_more_than_any_memory_is_not_unpacked(tmp_path, monkeypatch):
    monkeypatch.setattr("stmc.io.arrays.joblib_files.LARGEST", 2**26)
    path = written(tmp_path, zlib.compress(bytes(2**27)))
    assert path.stat().st_size < 2**18
    with pytest.raises(ArraysError, match="its content exceeds 67108864 bytes"):
        read_joblib(path, NAMES)


# The hostile ----------------------------------------------------------------------------------------------------------


def state(**changes: object) -> dict:
    plain = {"subclass": Opcodes(b"cnumpy\nndarray\n"), "shape": (2,), "order": "C", "dtype": np.dtype("f8")}
    return plain | changes


HOSTILE = {
    "objects behind an array": (wrapped(state(dtype=np.dtype("O")), run_code("os.getcwd", "", 2)), "Python objects"),
    "a foreign class of arrays": (wrapped(state(subclass=Opcodes(b"cnumpy\nmatrix\n")), bytes(16)), "refused to run"),
    "a class that is none": (wrapped(state(subclass="ndarrays"), bytes(16)), "an array of a foreign class"),
    "an order that is none": (wrapped(state(order="A"), bytes(16)), "an unknown order"),
    "a shape of a negative size": (wrapped(state(shape=(-2,)), bytes(16)), "without a shape or a type"),
    "a shape beyond the file": (wrapped(state(shape=(2**31, 2**31)), bytes(16)), "extends beyond the end of the file"),
    "a type with fields": (wrapped(state(dtype=np.dtype([("a", "f8")])), bytes(16)), "an unsupported dtype 'V8'"),
    "a type in a text": (wrapped(state(dtype="f8"), bytes(16)), "without a shape or a type"),
    "no state": (wrapped(None, bytes(16)), "an array of a foreign class"),
    "a padding beyond its unit": (
        wrapped(state(numpy_array_alignment_bytes=16), b"\xc8" + bytes(400)), "an array with 200 bytes of padding"
    ),
    "arrays in files of their own": (
        Opcodes(b"cjoblib.numpy_pickle\nNDArrayWrapper\n)\x81}b"), "refused to run joblib.numpy_pickle.NDArrayWrapper"
    ),
    "bytes, more than any memory": (Opcodes(b"\x96\xff\xff\xff\xff\xff\xff\xff\x0f"), "damaged"),
}  # fmt: skip


@pytest.mark.parametrize(("value", "message"), HOSTILE.values(), ids=HOSTILE)
def test_a_hostile_file_is_named(value, message, tmp_path):
    with pytest.raises(ArraysError, match=rf"a\.pth\.tar.*{message}"):
        read_joblib(written(tmp_path, joblib_bytes([{"poses": value}])), ["poses"])


@pytest.mark.parametrize("pack", [bytes, zlib.compress, gzip.compress], ids=["plain", "zlib", "gzip"])
@pytest.mark.parametrize("call", ["os.system", "builtins.eval", "builtins.getattr", "joblib.load", "numpy.load"])
def test_a_file_that_would_run_code_runs_nothing(call, pack, tmp_path):
    mark, (module, name) = tmp_path / "it ran", call.split(".")
    argument = pickle.dumps(f"touch '{mark}'", 2)[2:-1]
    called = Opcodes(f"c{module}\n{name}\n".encode() + argument + pickle.TUPLE1 + pickle.REDUCE)
    for hostile in ([entries()[0], called], [entries()[0] | {"more": called}], called):
        with pytest.raises(ArraysError, match=rf"refused to run {module}.{name}: the file must hold arrays alone"):
            read_joblib(written(tmp_path, pack(joblib_bytes(hostile))), NAMES, ["fname"])
    assert not mark.exists()


PIECES = [
    b"cos\nsystem\n", b"(S'true'\nios\nsystem\n", b"\x8c\x02os\x8c\x06system\x93",
    b"cnumpy\nndarray\n", b"cnumpy\ndtype\n", b"cjoblib.numpy_pickle\nNumpyArrayWrapper\n)\x81",
    b"R", b"b", b"o", b"\x81", b"\x92", b"0", b"1", b"2", b"(", b"t", b"d", b"e", b"h\x00", b"P1\n", b"Q", b"\x82\x01",
    b"r\xff\xff\xff\xff", b"\x95" + b"\xff" * 8, b"\x8e" + b"\xff" * 7,
]  # fmt: skip
"""Opcodes that call, build, repeat, or ask for more than there is."""

EDITS = st.lists(
    st.tuples(st.integers(0, len(WHOLE)), st.integers(0, 3), st.one_of(st.sampled_from(PIECES), st.binary(max_size=6))),
    min_size=1,
    max_size=6,
)


@given(edits=EDITS, cut=st.booleans())
def test_whatever_a_file_holds_it_is_read_or_named_and_nothing_is_imported(edits, cut, tmp_path_factory):
    """Python's own way from a name to what it means is closed, so that taking it would be seen."""
    content = WHOLE
    for place, removed, inserted in edits:
        content = content[:place] + inserted + content[place + removed :]
    content = content[: edits[0][0] + 1] if cut else content
    path = written(tmp_path_factory.getbasetemp(), content)
    before = set(sys.modules)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pickle._Unpickler, "find_class", lambda *asked: pytest.fail(f"imports {asked}"))
        try:
            found = read_joblib(path, NAMES, ["fname"])
        except ArraysError as error:
            assert "a.pth.tar" in str(error) and len(str(error)) < 600
        else:
            assert all(isinstance(each[name], np.ndarray) for each in found for name in NAMES)
    imported = {name for name in set(sys.modules) - before if not name.startswith("encodings.")}  # of old texts
    assert not imported
