"""Reading BVH: small files written by hand, closed forms by scipy, and what is said about files that are broken."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from stmc.formats.bvh_parser import LONGEST_HIERARCHY, BvhError, parse_bvh

HEADER = """HIERARCHY
ROOT Hips
{
  OFFSET 1.0 2.0 3.0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  JOINT Knee
  {
    OFFSET 0.0 -4.0 0.5
    CHANNELS 3 Yrotation Xrotation Zrotation
    JOINT Toe
    {
      OFFSET 0.0 -3.0 1.0
      End Site
      {
        OFFSET 0.0 0.0 2.0
      }
    }
  }
  JOINT Tail
  {
    OFFSET 0.0 0.0 -1.0
    CHANNELS 2 Zposition Xrotation
    End Site
    {
      OFFSET 0.0 0.0 -1.0
    }
  }
}
"""
FIRST = "10 20 30  40 50 60  15 25 35  7 90"
SECOND = "11 21 31  41 51 61  16 26 36  8 91"
MOTION = f"MOTION\nFrames: 2\nFrame Time: 0.0333333\n{FIRST}\n{SECOND}\n"
TEXT = HEADER + MOTION


def close(actual: torch.Tensor, expected) -> None:
    torch.testing.assert_close(actual, torch.as_tensor(np.asarray(expected, dtype=np.float64)), atol=1e-12, rtol=0)


def test_a_file_s_joints_come_with_their_names_parents_and_frame_rate():
    bvh = parse_bvh(TEXT)
    assert bvh.names == ("Hips", "Knee", "Toe", "Tail")
    assert bvh.parents == (-1, 0, 1, 0)
    assert bvh.fps == 30.0
    assert bvh.positions.shape == (2, 4, 3)


def test_a_position_is_the_channels_where_there_are_any_and_else_the_offset():
    bvh = parse_bvh(TEXT)
    close(bvh.positions[:, 0], [[10, 20, 30], [11, 21, 31]])
    close(bvh.positions[:, 1], [[0, -4, 0.5]] * 2)
    close(bvh.positions[:, 2], [[0, -3, 1]] * 2)
    close(bvh.positions[:, 3], [[0, 0, 7], [0, 0, 8]])  # one axis from a channel, two from the OFFSET


def test_angles_are_intrinsic_in_the_order_of_the_channels():
    bvh = parse_bvh(TEXT)

    def turn(axis: str, degrees: float) -> np.ndarray:
        return Rotation.from_euler(axis.lower(), degrees, degrees=True).as_matrix()

    close(bvh.rotations[0, 0], turn("Z", 40) @ turn("X", 50) @ turn("Y", 60))
    close(bvh.rotations[1, 1], turn("Y", 16) @ turn("X", 26) @ turn("Z", 36))
    close(bvh.rotations[0, 2], np.eye(3))
    close(bvh.rotations[1, 3], turn("X", 91))


def test_the_world_places_each_joint_by_all_rotations_above_it():
    bvh = parse_bvh(TEXT)
    rotations, positions = bvh.world()
    hips, knee, toe, tail = range(4)
    turned = bvh.rotations[0]
    close(positions[0, hips], [10, 20, 30])
    at_knee = np.array([10, 20, 30]) + turned[hips].numpy() @ [0, -4, 0.5]
    close(positions[0, knee], at_knee)
    close(positions[0, toe], at_knee + (turned[hips] @ turned[knee]).numpy() @ [0, -3, 1])
    close(positions[0, tail], np.array([10, 20, 30]) + turned[hips].numpy() @ [0, 0, 7])
    close(rotations[0, toe], (turned[hips] @ turned[knee]).numpy())


def test_an_end_site_s_offset_is_that_of_the_joint_before_it():
    assert parse_bvh(TEXT).ends == {2: (0.0, 0.0, 2.0), 3: (0.0, 0.0, -1.0)}
    twice = TEXT.replace(
        "      End Site\n", "      End Site\n      {\n        OFFSET 5 6 7\n      }\n      End Site\n", 1
    )
    assert parse_bvh(twice).ends[2] == (5.0, 6.0, 7.0)


def test_line_ends_tabs_and_numbers_in_one_line_do_not_matter():
    expected = parse_bvh(TEXT)
    one_line = TEXT.replace(f"{FIRST}\n", f"{FIRST} ")
    for text in (TEXT.replace("\n", "\r\n"), TEXT.replace("  ", "\t"), one_line, TEXT.rstrip()):
        assert torch.equal(parse_bvh(text).rotations, expected.rotations)


@pytest.mark.parametrize(
    ("time", "fps"), [("0.0333333", 30), ("0.008333", 120), ("0.016667", 60), ("0.0333667", 29.97), ("0.05", 20)]
)
def test_the_frame_rate_is_the_one_the_rounded_frame_time_means(time, fps):
    assert parse_bvh(TEXT.replace("0.0333333", time)).fps == fps


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        (MOTION, "", "no MOTION section"),
        (TEXT, "", "no MOTION section"),
        ("Frames: 2\nFrame Time: 0.0333333\n", "", "expected 'Frames: N Frame Time: S'"),
        ("Frames: 2", "Frames: two", "expected a number, found 'two'"),
        ("Frames: 2", "Frames: 0", "at least one frame"),
        ("0.0333333", "-0.03", "frame of 0.001 to 1 s"),
        ("0.0333333", "nan", "frame of 0.001 to 1 s"),
        ("Frames: 2", "Frames: 3", "22 numbers for 3 frames of 11 channels (33 expected)"),
        (f"{SECOND}\n", "11 21 31 41", "15 numbers for 2 frames of 11 channels (22 expected)"),
        (f"{FIRST}\n{SECOND}\n", "", "0 numbers for 2 frames"),
        (f"{SECOND}\n", f"{SECOND} 7\n", "more numbers than expected for 2 frames of 11 channels (22 expected)"),
        ("11 21 31", "11 2l 31", "not a number: could not convert string to float: '2l'"),
        ("16 26 36", "16 nan 36", "Xrotation of 'Knee' is nan in frame 1"),
        ("7 90", "-inf 90", "Zposition of 'Tail' is -inf in frame 0"),
        ("CHANNELS 3 Yrotation Xrotation Zrotation", "CHANNELS 3 Yrotation Xrotation Wrotation", "'Wrotation'"),
        ("CHANNELS 3 Yrotation", "CHANNELS 4 Yrotation", "line 9: 'CHANNELS 4 Yrotation Xrotation Zrotation'"),
        ("CHANNELS 3 Yrotation", "CHANNELS three Yrotation", "line 9"),
        ("CHANNELS 3 Yrotation Xrotation", "CHANNELS 3 Xrotation Xrotation", "joint 'Knee' are X, X, Z"),
        ("OFFSET 0.0 -4.0 0.5", "OFFSET 0.0 -4.0", "line 8: 'OFFSET 0.0 -4.0'"),
        ("OFFSET 0.0 -4.0 0.5", "OFFSET 0.0 -4.0 half", "line 8"),
        ("    OFFSET 0.0 -4.0 0.5\n", "", "without an OFFSET: Knee"),
        ("JOINT Toe", "JOIN Toe", "line 10: 'JOIN Toe': not a line of a BVH hierarchy"),
        ("}\n}\n", "}\n", "1 braces that are never closed"),
        ("}\n}\n", "}\n}\n}\n", "line 29: '}': no brace is open here"),
        ("HIERARCHY", "OFFSET 0 0 0", "line 1: 'OFFSET 0 0 0'"),
        (HEADER, "HIERARCHY\n", "0 joints"),
    ],
)
def test_a_broken_file_is_refused_with_what_is_wrong_and_where(old, new, named):
    assert old in TEXT
    with pytest.raises(BvhError) as error:
        parse_bvh(TEXT.replace(old, new, 1))
    assert named in str(error.value)


def test_a_file_cut_anywhere_is_refused_and_not_misread():
    whole = parse_bvh(TEXT)
    for end in range(0, len(TEXT.rstrip()), 7):
        try:
            bvh = parse_bvh(TEXT[:end])
        except BvhError:
            continue
        assert end >= len(TEXT.rstrip()) - 1, "only within the last number can a cut go unnoticed"
        assert bvh.positions.shape == whole.positions.shape


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ("7 90", "1e300 90", "Zposition of 'Tail' is 1e+300 in frame 0: values must be finite, in float32 too"),
        ("OFFSET 0.0 -4.0 0.5", "OFFSET 0.0 -1e39 0.5", "line 8: 'OFFSET 0.0 -1e39 0.5': -1e+39 is not finite"),
        ("OFFSET 0.0 -4.0 0.5", "OFFSET 0.0 nan 0.5", "line 8"),
        ("0.0333333", "9.9", "2 frames of 9.9 s: must be at least one frame of 0.001 to 1 s"),
        ("0.0333333", "1e-300", "of 0.001 to 1 s"),
        ("Frames: 2", "Frames: 500001", "500001 frames of 4 joints are more than 2,000,000, the limit"),
        ("Frames: 2", f"Frames: {'9' * 4000}", "an integer of 13288 bits frames of 4 joints are more than"),
        ("Frames: 2", f"Frames: {'9' * 5000}", "expected a number, found '999"),
        ("11 21 31", f"11 {'2l' * 100_000} 31", "not a number: could not convert string to float: '2l"),
        ("JOINT Toe", f"JOIN {'Toe' * 100_000}", "line 10: 'JOIN Toe"),
        ("CHANNELS 2", f"CHANNELS 100002 {'Xrotation ' * 100_000}", "not a line of a BVH hierarchy"),
        ("JOINT Toe", "\n" * LONGEST_HIERARCHY, "characters, more than 4,194,304, the limit"),
        ("Yrotation Xrotation Zrotation", f"Yrotation Xrotation {'W' * 100_000}", "unknown channel 'WWW"),
    ],
    ids=range(13),
)
def test_numbers_and_words_that_are_too_large_are_refused_in_a_sentence(old, new, named):
    assert old in TEXT
    with pytest.raises(BvhError) as error:
        parse_bvh(TEXT.replace(old, new, 1))
    assert named in str(error.value)
    assert len(str(error.value)) < 500


def test_deeply_nested_joints_are_read_once_each():
    deep = 20_000
    header = "HIERARCHY\n" + "ROOT a\n{\nOFFSET 0 0 0\n" * deep + "CHANNELS 1 Xposition\n" + "}\n" * deep
    bvh = parse_bvh(f"{header}MOTION\nFrames: 1\nFrame Time: 0.05\n1\n")
    assert bvh.parents == tuple(range(-1, deep - 1))
