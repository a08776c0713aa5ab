"""File names that every file system takes."""

import pytest

from stmc.io.filenames import MOST, distinct_names, name_of_texts, safe_name


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("walk and wave", "walk_and_wave"),
        ("b/../c", "b_.._c"),
        ("../../etc", "etc"),
        ("-rf", "rf"),
        (".hidden", "hidden"),
        ("…", ""),
        ("CON", "CON_"),
        ("aux.x", "aux_.x"),
        ("console", "console"),
        ("走る", "走る"),
        ("cafe\u0301", "caf\u00e9"),
        ("a\ud800b\x00c", "a_b_c"),
        ("dots...", "dots"),
    ],
)
def test_a_name_becomes_one_that_all_systems_take(name, expected):
    assert safe_name(name) == expected


@pytest.mark.parametrize("letter", ["n", "走", "\U0001f9cd"])
def test_a_long_name_is_cut_and_stays_its_own(letter):
    first, second = safe_name(letter * 240 + "a"), safe_name(letter * 240 + "b")
    assert len(first.encode()) <= MOST
    assert first != second or letter == "\U0001f9cd"  # which is no letter, so nothing of it is left
    assert safe_name(first) == first


def test_no_two_names_differ_in_case_alone():
    names = ["a", "A", "", "a", "a_0001", "ß", "SS", "CON"]
    found = list(distinct_names(names, "file"))
    assert found == ["a", "A_0001", "file_0002", "a_0003", "a_0001_0004", "ß", "SS_0006", "CON_"]
    assert len({name.casefold() for name in found}) == len(names)


def test_a_name_says_texts_and_other_texts_have_another():
    assert name_of_texts(["walk"]) == "walk"
    assert name_of_texts(["walk", "raise the right arm"]) == "walk_raise-the-right-arm"
    texts = (
        ["walk run"],
        ["walk-run"],
        ["walk", "run"],
        ["walk_run"],
        ["Walk run"],
        ["walk  run"],
        ["!"],
        ["?"],
        ["走る"],
    )
    assert len({name_of_texts(each) for each in texts}) == len(texts)
    assert all(safe_name(name_of_texts(each)) == name_of_texts(each) != "" for each in texts)
