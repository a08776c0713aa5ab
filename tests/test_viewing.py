import base64
import hashlib
import html
import json
import re
import sys
import types
import webbrowser
from itertools import combinations, pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.motions import walking
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_hex, to_rgb
from matplotlib.patches import FancyBboxPatch, Rectangle
from test_body_model import write_body

import stmc
from stmc.motion.body import JOINTS, BodyPart
from stmc.motion.body_model import Skeleton, load_body
from stmc.motion.geometry import rotation_z
from stmc.motion.motion import Motion
from stmc.motion.skins import PARTS, Skin, build_mannequin, skin_of
from stmc.timeline import Timeline
from stmc.timeline.planning import plan
from stmc.viewing import film_strip, plot_plan, plot_timeline, render_html, view
from stmc.viewing.colours import NEUTRAL, as_rgb, ink, owners, palette, part_colours, transitions

WALK, RAISE = "walk forwards", "raise the right arm"
RIGHT, LEGS = PARTS.index("right arm"), PARTS.index("legs")


@pytest.fixture(scope="module")
def motion() -> Motion:
    return walking(seconds=6.0)


@pytest.fixture(scope="module")
def timeline() -> Timeline:
    return Timeline.parse(f"{WALK} # 0 # 4.5 # legs # spine\n{RAISE} # 2 # 4 # right arm")


def standing() -> Motion:
    """The rest pose itself, turned upright: one frame with arms stretched sideways."""
    upright = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    rotations = torch.cat([upright[None], torch.eye(3).expand(21, 3, 3)])[None]
    return Motion.posed(rotations, torch.tensor([[0.0, 0.0, 0.95]]), 20.0, Skeleton.default())


def test_prompts_have_colours_of_their_own_on_which_text_is_legible():
    colours = palette(21)
    assert palette(3) == colours[:3]
    assert min(np.abs(as_rgb(one) - as_rgb(other)).max() for one, other in combinations([*colours, NEUTRAL], 2)) > 0.05
    for colour in colours:
        light, dark = sorted((_luminance(colour), _luminance(ink(colour))), reverse=True)
        assert (light + 0.05) / (dark + 0.05) > 2.6


def _luminance(colour: str) -> float:
    return float(np.array(to_rgb(colour)) ** 2.2 @ [0.2126, 0.7152, 0.0722])


def test_a_part_wears_its_prompt_s_colour_and_neutral_in_gaps_and_between_prompts(timeline):
    colours = part_colours(timeline, fps=20.0, frames=120, overlap=0.5)
    walk, lift = map(as_rgb, palette(2))
    assert colours.shape == (120, 5, 3)
    assert colours[20, RIGHT] == pytest.approx(walk)
    assert colours[60, RIGHT] == pytest.approx(lift)
    assert colours[60, LEGS] == pytest.approx(walk)
    assert colours[110] == pytest.approx(np.tile(as_rgb(NEUTRAL), (5, 1)))  # the timeline ended at frame 90
    handed_over = np.abs(colours[35:46, RIGHT] - as_rgb(NEUTRAL)).sum(axis=1)
    assert handed_over.argmin() in (4, 5)
    assert np.all(np.diff(handed_over)[:4] < 0) and np.all(np.diff(handed_over)[5:] > 0)


def test_owners_cover_the_motion_even_where_the_timeline_is_longer_or_shorter(timeline):
    for frames in (50, 90, 130):
        for spans in owners(timeline, 20.0, frames).values():
            assert spans[0][1] == 0 and spans[-1][2] == frames
            assert all(one[2] == other[1] for one, other in pairwise(spans))
    assert owners(timeline, 20.0, 130)[BodyPart.LEGS][-1] == (None, 90, 130)


def test_transitions_lie_around_hand_overs_and_within_the_motion():
    spans = ((0, 0, 4), (1, 4, 60), (None, 60, 80))
    assert transitions(spans, fps=20.0, overlap=0.5) == [(0.0, 9.0), (55.0, 65.0)]


def test_without_a_timeline_everything_has_one_colour_that_is_not_neutral():
    colours = part_colours(None, fps=20.0, frames=7)
    assert len(np.unique(colours.reshape(-1, 3), axis=0)) == 1
    assert colours[0, 0] == pytest.approx(as_rgb(palette(1)[0]))


def test_the_mannequin_is_closed_faces_outwards_and_is_carried_by_its_joints():
    skin = build_mannequin(Skeleton.default())
    assert skin.weights.sum(axis=1) == pytest.approx(np.ones(len(skin.vertices)))
    assert skin.weights.min() >= 0
    assert set(skin.parts) == set(range(5))
    for part in BodyPart:
        corners = skin.vertices[skin.faces[skin.parts == PARTS.index(part)]]
        assert np.einsum("fa,fa->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) > 0
    assert len(skin.vertices) < 10_000
    left, right = (skin.vertices[:, 0] > 0.25), (skin.vertices[:, 0] < -0.25)
    assert skin.vertices[left].max(axis=0)[0] == pytest.approx(-skin.vertices[right].min(axis=0)[0], abs=0.01)


def test_every_joint_of_the_mannequin_is_inside_the_piece_that_bears_its_part_s_colour():
    skin = build_mannequin(Skeleton.default())
    for part in BodyPart:
        vertices = skin.vertices[np.unique(skin.faces[skin.parts == PARTS.index(part)])]
        for name in part.joints:
            joint = Skeleton.default().rest[JOINTS.index(name)].numpy()
            nearest = np.linalg.norm(vertices - joint, axis=1).min()
            assert nearest < 0.12, (part, name, nearest)


def test_a_skin_in_the_rest_pose_is_where_its_vertices_are():
    skin, motion = build_mannequin(Skeleton.default()), standing()
    upright = motion.rotations[0, 0].double().numpy()
    pelvis = Skeleton.default().rest[0].numpy()
    expected = (skin.vertices - pelvis) @ upright.T + motion.translation[0].numpy()
    assert np.abs(skin.posed(motion)[0] - expected).max() < 1e-5


def test_a_skin_turns_and_moves_with_its_motion(motion):
    turn = rotation_z(torch.tensor(0.7, dtype=torch.float64))
    rotations = torch.cat([turn @ motion.rotations[:, :1], motion.rotations[:, 1:]], dim=1)
    shift = torch.tensor([1.0, -2.0, 0.3], dtype=torch.float64)
    moved = Motion(rotations, motion.translation @ turn.T + shift, motion.joints @ turn.T + shift, motion.fps)
    before, after = (skin_of(one).posed(one.trimmed(10, 20)) for one in (motion, moved))
    assert np.abs(before @ turn.numpy().T + shift.numpy() - after).max() < 1e-4


def test_the_mannequin_s_hands_and_feet_are_where_the_motion_s_joints_are(motion):
    skin = skin_of(motion)
    vertices = skin.posed(motion.trimmed(30, 31))[0]
    for name in ("left_hand", "right_hand", "left_foot", "right_foot", "head"):
        joint = motion.joints[30, JOINTS.index(name)].numpy()
        assert np.linalg.norm(vertices - joint, axis=1).min() < 0.06


@pytest.mark.parametrize("kind", ["smpl", "smplh", "smplx"])
def test_the_user_s_own_body_is_posed_as_smpl_poses_it(kind, motion, tmp_path):
    # Without bulges and with straight fingers, which the skin leaves out, both are the same linear blend.
    flat = {} if kind == "smpl" else {"hands_meanl": np.zeros(45), "hands_meanr": np.zeros(45)}
    bones = {"smpl": 24, "smplh": 52, "smplx": 55}[kind]
    write_body(tmp_path, kind, posedirs=np.zeros((80, 3, 9 * (bones - 1))), **flat)
    body = load_body(tmp_path, kind)
    few = motion.trimmed(20, 24).to(dtype=torch.float32)
    expected = body.vertices(few.rotations, few.translation).numpy()
    assert np.abs(Skin.of_body(body).posed(few) - expected).max() < 1e-4


def test_a_face_of_the_user_s_body_belongs_to_the_part_that_moves_it(tmp_path):
    weights = np.zeros((80, 24))
    weights[np.arange(80), np.arange(80) % 24] = 1.0
    faces = np.array([[16, 18, 20], [22, 20, 44], [0, 1, 24], [15, 12, 3]])
    write_body(tmp_path, "smpl", weights=weights, f=faces)
    parts = [PARTS[index] for index in Skin.of_body(load_body(tmp_path)).parts]
    assert parts == [BodyPart.LEFT_ARM, BodyPart.LEFT_ARM, BodyPart.LEGS, BodyPart.HEAD]


def test_the_figure_shows_every_prompt_in_its_colour_at_its_seconds_and_all_five_parts(timeline):
    axes = plot_timeline(timeline, fps=20.0, overlap=0.5).axes[0]
    bars = [patch for patch in axes.patches if isinstance(patch, FancyBboxPatch)]
    assert [(bar.get_x(), bar.get_x() + bar.get_width()) for bar in bars] == [(0.0, 4.5), (2.0, 4.0)]
    assert tuple(to_hex(bar.get_facecolor()) for bar in bars) == palette(2)
    assert [text.get_text() for text in axes.texts] == [WALK, RAISE]
    assert [label.get_text() for label in axes.get_yticklabels()] == ["track 1", "track 2", *BodyPart]
    spans = [patch for patch in axes.patches if isinstance(patch, Rectangle) and not patch.get_hatch()]
    raised = [span for span in spans if to_hex(span.get_facecolor()) == palette(2)[1]]
    assert [(span.get_x(), span.get_width()) for span in raised] == [(2.0, 2.0)]
    assert sum(bool(patch.get_hatch()) for patch in axes.patches) == 2


def test_a_long_text_is_cut_where_its_bar_is_short():
    timeline = Timeline.parse("walk # 0 # 20 # legs\nturn around slowly and look at the ceiling # 3 # 4 # head")
    short = plot_timeline(timeline, fps=20.0).axes[0].texts[1].get_text()
    assert len(short) < 20


def test_pictures_show_as_many_moments_as_asked_for_with_their_times(motion, timeline):
    plot = film_strip(motion, timeline, frames=4, title="a walk")
    assert [axes.get_title() for axes in plot.axes[:4]] == ["0.0 s", "2.0 s", "4.0 s", "6.0 s"]
    assert "from above" in plot.axes[4].get_title()
    assert len(plot.axes) == 6
    assert plot.get_suptitle() == "a walk"


def test_pictures_wear_the_colours_of_the_prompts(motion, timeline):
    plot = film_strip(motion, timeline, frames=3)
    hues = [_hues(axes) for axes in plot.axes[:3]]
    walk, lift = ((as_rgb(colour) / as_rgb(colour).max()).round(1) for colour in palette(2))
    assert all(any(np.allclose(hue, walk, atol=0.15) for hue in seen) for seen in hues[:2])
    assert any(np.allclose(hue, lift, atol=0.15) for hue in hues[1])
    assert not any(np.allclose(hue, lift, atol=0.15) for hue in hues[0])


def _hues(axes) -> np.ndarray:
    """The distinct colours of the body's faces, at full brightness."""
    faces = max((item for item in axes.collections if isinstance(item, PolyCollection)), key=lambda item: item.zorder)
    colours = faces.get_facecolor()[:, :3]
    return np.unique((colours / colours.max(axis=1, keepdims=True)).round(1), axis=0)


def test_pictures_of_a_motion_of_one_frame_show_it_once():
    assert len(film_strip(standing(), frames=8).axes) == 2


def test_pictures_need_at_least_one_frame(motion):
    with pytest.raises(ValueError, match="at least 1, not 0"):
        film_strip(motion, frames=0)


def test_a_page_is_whole_small_quiet_and_refuses_to_load_anything(timeline, capsys):
    content = render_html(walking(seconds=60.0), timeline)
    assert len(content.encode()) <= 2_000_000
    assert capsys.readouterr() == ("", "")
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', content)
    assert policy and policy[1].startswith("default-src 'none'; script-src 'sha256-")
    assert not re.search(r"http|\*|self|unsafe-eval", policy[1])
    assert policy.start() < content.index("<script")
    assert set(re.findall(r"<[^<>]* (?:src|href)=\"([^\"#]*)", content)) == {"data:,", ""}


def test_a_page_runs_the_script_that_its_policy_names_and_no_other():
    content = render_html(standing())
    [script] = re.findall(r"<script>(.*?)</script>", content, re.S)
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert f"script-src 'sha256-{digest}';" in content


def test_a_page_has_the_constraints_and_shows_a_hold_where_the_motion_holds_it(motion):
    path, hold = stmc.Path([(0, 0), (0, -3)], end=4), stmc.Hold("left_hand", 1, 2)
    gaze, pose = stmc.Heading(0.5, start=1), stmc.Keyframe(motion.trimmed(3, 4), at=2)
    data = data_of(render_html(motion, constraints=[path, hold, gaze, pose]))
    assert [mark["kind"] for mark in data["marks"]] == ["path", "target", "heading", "keyframe"]
    assert data["marks"][0]["points"] == [[0, 0], [0, -3]]
    held = motion.joints[20:40, JOINTS.index("left_hand")].mean(dim=0)
    assert data["marks"][1]["point"] == pytest.approx(held.tolist())
    assert data["marks"][3]["at"] == 2 and "pose" not in data["marks"][3]


def test_a_page_names_a_row_for_each_constraint(motion):
    content = render_html(motion, constraints=[stmc.Heading(0.5, start=1, end=4), stmc.Hold("left_hand", 3)])
    spans = re.findall(r'name">([^<]*)</div><div class="row part demand"><div class="span" style="([^"]*)"', content)
    assert spans == [("heading", "left:16.667%;width:50.000%;"), ("hold left hand", "left:50.000%;width:50.000%;")]


def data_of(content: str) -> dict:
    """What a page's script reads."""
    return json.loads(re.search(r'<script type="application/json" id="motion">(.*?)</script>', content, re.S)[1])


def test_a_page_has_every_prompt_at_its_place_in_its_colour(motion, timeline):
    content = render_html(motion, timeline, title="an evening walk")
    assert "<title>an evening walk</title>" in content
    place = re.search(rf'<div class="bar"[^>]*title="{RAISE}" style="left:([\d.]+)%;width:([\d.]+)%;([^"]*)"', content)
    assert place and float(place[1]) == pytest.approx(100 / 3, abs=0.01)
    assert float(place[2]) == pytest.approx(100 / 3, abs=0.01)
    assert f"background:{palette(2)[1]}" in place[3]
    assert [name for name in re.findall(r'<div class="name">([^<]*)</div>', content) if name in set(BodyPart)] == [
        *BodyPart
    ]


def test_a_page_s_texts_stay_texts():
    nasty = '</script><script>alert("hi")</script> & \'"<b>'
    timeline = Timeline.parse(f"{nasty} # 0 # 2 # legs")
    content = render_html(standing(), timeline, title=nasty)
    assert nasty not in content
    assert html.escape(nasty) in content


def test_a_page_without_a_timeline_has_no_tracks():
    content = render_html(standing())
    assert '<section id="tracks"' not in content and "<title>motion</title>" in content


def test_a_page_of_one_frame_and_of_a_timeline_that_lasts_longer_is_made(timeline):
    assert "left:100.000%;width:0.000%" in render_html(standing(), timeline)


def test_view_opens_the_page_in_the_browser_outside_notebooks(timeline, monkeypatch):
    opened: list[str] = []
    monkeypatch.setattr(webbrowser, "open", opened.append)
    view(standing(), timeline)
    path = Path(opened[0].removeprefix("file://"))
    assert RAISE in path.read_text("utf-8")
    path.unlink()


def test_view_shows_the_page_within_a_notebook(timeline, monkeypatch):
    shown: list[str] = []
    ipython = types.ModuleType("IPython")
    ipython.get_ipython = lambda: types.SimpleNamespace(kernel=object())
    ipython.display = types.ModuleType("IPython.display")
    ipython.display.HTML, ipython.display.display = str, shown.append
    monkeypatch.setitem(sys.modules, "IPython", ipython)
    monkeypatch.setitem(sys.modules, "IPython.display", ipython.display)
    view(standing(), timeline, height=333)
    assert shown[0].startswith("<div><iframe srcdoc=") and "height:333px" in shown[0]
    assert html.escape("<!doctype html>") in shown[0].lower()


def test_a_plan_is_drawn_as_its_crops_and_as_the_weights_of_every_part_that_differs(timeline):
    drawn = plan(timeline, fps=20.0, overlap=10)
    crops, others, arm = plot_plan(drawn, 20.0).axes
    assert [text.get_text() for text in crops.texts] == [crop.text or "" for crop in drawn.crops]
    spans = [edge for bar in crops.patches for edge in (bar.get_x(), bar.get_x() + bar.get_width())]
    assert spans == pytest.approx([edge / 20 for crop in drawn.crops for edge in (crop.start, crop.end)])
    assert others.get_ylabel() == "left arm\nlegs\nhead\nspine"
    assert arm.get_ylabel() == "right arm"
    tops = [np.abs(steps.get_data().values).max() for steps in arm.patches]
    assert tops == [1, 2, 1, 1]  # the walk, the raise on top of it while both count, and the two transitions subtracted


def test_a_figure_is_shown_in_a_notebook_that_never_imported_pyplot():
    timeline = Timeline.parse("walk # 0 # 2")
    for figure in (
        plot_timeline(timeline),
        plot_plan(plan(timeline, fps=20, overlap=0), fps=20),
        film_strip(walking(1.0)),
    ):
        assert figure._repr_png_().startswith(b"\x89PNG")
