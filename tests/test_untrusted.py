"""Files of strangers: only regular ones of bounded size are read, and messages stay short whatever the file holds."""

import os
import re
import sys

import pytest

from stmc.data.sources.humanml3d.humanml3d_clips import read_captioned_clips
from stmc.data.sources.humanml3d.humanml3d_texts import read_captions, read_index
from stmc.evaluation.benchmarks.atomic_prompts import _fields
from stmc.io.untrusted import UnreadableError, load_json, quote, read_bytes, read_text, truncate

posix = pytest.mark.skipif(sys.platform == "win32", reason="links and pipes")


@pytest.mark.parametrize(
    ("value", "text"),
    [
        ("sit", "'sit'"),
        ("it's", '"it\'s"'),
        ("\x00\u202e\ud800\n", r"'\x00\u202e\ud800\n'"),
        (True, "true"),
        (None, "null"),
        (1e300, "1e+300"),
        (float("nan"), "nan"),
        ({"a": [1, "\u202e"]}, r'{"a": [1, "\u202e"]}'),
        (10**5000, "an integer of 16610 bits"),
    ],
    ids=lambda value: type(value).__name__,
)
def test_a_value_is_shown_on_one_line_in_characters_that_can_be_seen(value, text):
    assert quote(value) == text


def nested(depth: int) -> list:
    value: list = []
    for _ in range(depth):
        value = [value]
    return value


@pytest.mark.parametrize(
    "value",
    ["a" * 10**6, "\x00" * 10**6, ["a" * 1000] * 1000, nested(900), {"\u202e" * 1000: 1}, 10**4000],
    ids=lambda value: type(value).__name__,
)
def test_a_value_is_shown_in_few_characters(value):
    assert len(quote(value)) <= 62
    assert len(truncate(str("\x00" * 1000), 60)) == 60


def test_a_key_that_an_object_has_twice_is_refused():
    assert load_json('[{"a": 1}, {"a": 2}]') == [{"a": 1}, {"a": 2}]
    with pytest.raises(UnreadableError, match="the key 'a' is duplicated"):
        load_json('{"b": {"a": 1, "a": 1}}')


@pytest.mark.parametrize(
    "document", ["[" * 100_000, "1" * 5000, "", "{'a': 1}", '{"' + "a" * 10**5 + '": 1, "b"}'], ids=range(5)
)
def test_what_is_no_json_is_said_in_a_few_words(document):
    with pytest.raises(UnreadableError, match="not JSON") as caught:
        load_json(document)
    assert len(str(caught.value)) < 200


def test_text_is_read_with_one_kind_of_line_end(tmp_path):
    (tmp_path / "t").write_bytes("ä\r\nb\rc\n".encode())
    assert read_text(tmp_path / "t", 100) == "ä\nb\nc\n"
    (tmp_path / "t").write_bytes(b"a\xff")
    with pytest.raises(UnreadableError, match=r"not UTF-8 text \(.* at byte 1\)"):
        read_text(tmp_path / "t", 100)


def test_a_file_beyond_the_limit_is_not_read(tmp_path):
    (tmp_path / "t").write_bytes(b"abc")
    assert read_bytes(tmp_path / "t", 3) == b"abc"
    with pytest.raises(UnreadableError, match=r"larger than 1\.90735e-06 MiB"):
        read_bytes(tmp_path / "t", 2)
    with (tmp_path / "holes").open("wb") as file:
        file.truncate(2**40)
    with pytest.raises(UnreadableError, match="larger than 8 MiB"):
        read_bytes(tmp_path / "holes", 2**23)


@posix
def test_what_is_no_regular_file_is_refused_without_waiting(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "zeros").symlink_to("/dev/zero")
    for name, words in {
        "pipe": "a pipe or a device, not a file",
        "zeros": "a pipe or a device, not a file",
        ".": "a directory, not a file",
        "loop": "not a path to a file",
        "a\0b": "not a path to a file",
        "\ud800": "not a path|No such file",
        "a" * 5000: "not a path to a file",
    }.items():
        with pytest.raises((UnreadableError, FileNotFoundError), match=words):
            read_bytes(tmp_path / name, 100)
    with pytest.raises(FileNotFoundError):
        read_bytes(tmp_path / "none", 100)


@pytest.mark.parametrize(
    "read",
    [read_captions, read_index, lambda path: list(_fields(path)), lambda path: read_captioned_clips(path.parent, "a")],
    ids=["captions", "index", "prompts", "clips"],
)
def test_a_data_set_s_file_that_is_not_text_is_named(read, tmp_path):
    (tmp_path / "a.txt").write_bytes(b"walk\xff\xfe#\x00")
    with pytest.raises(UnreadableError, match=r"a\.txt: not UTF-8 text"):
        read(tmp_path / "a.txt")


@pytest.mark.parametrize(
    "row", ["./pose_data/a.npy,1" + "0" * 400 + ",-1,x.npy", "a.npy,0,1" + "0" * 400 + ",x.npy", "a.npy", "a" * 200_000]
)
def test_a_row_of_an_index_that_is_mad_is_malformed(row, tmp_path):
    (tmp_path / "index.csv").write_text(f"source_path,start_frame,end_frame,new_name\n{row}\n")
    try:
        [found] = read_index(tmp_path / "index.csv").values()
    except ValueError as error:
        found = str(error)
    assert isinstance(found, str)
    assert re.search(r"malformed index|index\.csv: not a table", found)
    assert len(found) < 200 + len(str(tmp_path))
