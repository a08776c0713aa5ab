"""The studio's server: what it answers its page, what it refuses everybody else, and that nothing is lost."""

import json
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.scripts import loaded
from helpers.studio import PORT, WALK, bearer, draw_nothing, entered, knowing, studio
from helpers.tiny_model import tiny
from hypothesis import given
from hypothesis import strategies as st
from starlette.testclient import TestClient

import stmc
from stmc.data.sources.contents import CONTENTS
from stmc.evaluation.verification import Missed
from stmc.motion.body import JOINTS
from stmc.viewing.studio import Documents, Jobs, Motions, Sessions, application
from stmc.viewing.studio.auth import MOST_BYTES
from stmc.viewing.studio.job_queue import MOST_WAITING
from stmc.viewing.studio.jobs import PREVIEW, Stage, stages_by_quality
from stmc.viewing.studio.request_errors import RequestError
from stmc.viewing.studio.storage import ID

BOTH = {"prompts": [*WALK["prompts"], {"text": "wave with the right hand", "start": 0.5, "end": 1.5, "parts": []}]}


@pytest.fixture(scope="module")
def model() -> stmc.Model:
    return knowing()


@pytest.fixture(scope="module")
def client(model, tmp_path_factory) -> Iterator[TestClient]:
    with studio(model, tmp_path_factory.mktemp("studio")) as client:
        yield client


@pytest.fixture
def stranger(client) -> TestClient:
    """Somebody in the same network of addresses, without the token."""
    return TestClient(client.app, base_url=f"http://127.0.0.1:{PORT}")


def sampled(client: TestClient, **asked) -> list[tuple[str, dict]]:
    """What happens to a job, from its beginning to its end."""
    answer = client.post("/api/jobs", json={"timeline": WALK, "seeds": [0]} | asked)
    assert answer.status_code == 201, answer.text
    return events(client.get(f"/api/jobs/{answer.json()['job']}/events").text)


def events(stream: str) -> list[tuple[str, dict]]:
    blocks = [block.split("\n") for block in stream.strip().split("\n\n")]
    return [(kind.removeprefix("event: "), json.loads(data.removeprefix("data: "))) for kind, data in blocks]


def made(told: list[tuple[str, dict]]) -> list[dict]:
    return [details for kind, details in told if kind == "motion"]


def progress(told: list[tuple[str, dict]]) -> set[tuple[str, int]]:
    """The stages that were told, with their steps."""
    return {(details["stage"], details["steps"]) for kind, details in told if kind == "progress"}


def test_actions_have_plain_names_and_topics(client, model):
    actions = client.get("/api/model").json()["contents"]
    named = {action["title"]: action for action in actions}
    assert len(named) == len(actions) == len({CONTENTS[each.name].title for each in model.vocabulary.examples})
    assert named["cartwheel"]["topic"] == "sport" and named["walk backwards"]["parts"] == ["legs"]


# Who may talk to it


def test_an_address_opens_the_studio_once_and_leaves_no_cookie_that_other_ports_would_get(model, tmp_path):
    sessions = Sessions()
    with TestClient(application(model, tmp_path, sessions, PORT), base_url=f"http://127.0.0.1:{PORT}") as browser:
        page = browser.get("/")
        assert page.status_code == 200 and "default-src 'self'" in page.headers["content-security-policy"]
        token = sessions.invite()
        opened = entered(browser, token)
        assert opened.status_code == 201 and not browser.cookies and "set-cookie" not in opened.headers
        key = bearer(opened.json()["key"])
        assert browser.get("/api/documents", headers=key).status_code == 200
        assert entered(browser, token).status_code == 401 and "used before" in entered(browser, token).json()["error"]


@pytest.mark.parametrize("cookie", ['other={"a": 1}', "x=é", "=1", "novalue", "a b", "a[b]=1", "expires=1"])
def test_cookies_of_other_servers_on_this_machine_lock_nobody_out(client, cookie):
    assert client.get("/api/documents", headers={"Cookie": cookie.encode()}).status_code == 200


@pytest.mark.parametrize("path", ["/api/model", "/api/documents", "/api/motions/x.glb", "/api/jobs/x/events"])
@pytest.mark.parametrize("key", [None, "", "1", "a guess", "é".encode()])
def test_whoever_has_no_key_is_told_where_it_is_and_nothing_else(stranger, path, key):
    answer = stranger.get(path, headers={} if key is None else bearer(key))
    assert answer.status_code == 401 and "stmc studio" in answer.json()["error"]


@pytest.mark.parametrize(
    "headers",
    [
        {"Host": "evil.example"},
        {"Host": f"evil.example:{PORT}"},
        {"Origin": "http://evil.example"},
        {"Origin": "null"},
        {"Origin": "http://127.0.0.1:9999"},
        {"Authorization": ""},
    ],
    ids=str,
)
def test_other_pages_in_the_same_browser_are_refused(client, headers):
    answer = client.post("/api/jobs", json={"timeline": WALK}, headers=headers)
    assert answer.status_code in (401, 403)


def test_a_name_that_leads_here_from_elsewhere_is_refused_for_reading_too(client):
    assert client.get("/api/documents", headers={"Host": "evil.example"}).status_code == 403


@pytest.mark.parametrize("length", [None, "7"], ids=["said", "not said"])
def test_requests_beyond_the_bound_are_refused_whatever_length_they_announce(client, length):
    body = b" " * (MOST_BYTES + 1)
    content = body if length is None else (body[:1000] for _ in range(len(body) // 1000 + 1))
    answer = client.post("/api/check", content=content)
    assert answer.status_code == 413


# Timelines


def test_a_check_says_who_owns_which_part_when_and_what_was_suggested(client):
    told = client.post("/api/check", json={"timeline": BOTH}).json()
    walk, wave = told["prompts"]
    assert (walk["parts"], walk["suggested"], walk["advice"]) == (["legs"], False, None)
    assert (wave["parts"], wave["suggested"], wave["row"]) == (["right arm"], True, 1)
    assert told["owners"]["right arm"] == [[0, 0.0, 0.5], [1, 0.5, 1.5], [0, 1.5, 2.0]]
    assert told["transitions"]["right arm"] == [[0.25, 0.75], [1.25, 1.75]]
    assert told["duration"] == 2 and told["rows"] == 2


def test_a_check_says_which_parts_an_action_needs_whatever_the_prompt_lists_unless_the_model_hardly_knows_it(client):
    listed = enumerate([("walk", ["right arm"]), ("walk", []), ("swim across the river", ["right arm"])])
    prompts = [{"text": text, "start": at, "end": at + 1, "parts": parts} for at, (text, parts) in listed]
    told = client.post("/api/check", json={"timeline": {"prompts": prompts}}).json()["prompts"]
    assert [(each["parts"], each["needs"]) for each in told] == [
        (["right arm"], ["legs"]),
        (["legs"], ["legs"]),
        (["right arm"], []),
    ]
    assert [each["suggested"] for each in told] == [False, True, False] and told[0]["confidence"] is None


@pytest.mark.parametrize(("text", "near"), [("tango", True), ("qwxz vvv kkk", False)])
def test_an_unknown_prompt_is_advised_with_the_known_ones_that_are_near(client, text, near):
    prompts = [{"text": text, "start": 0, "end": 1, "parts": []}]
    [told] = client.post("/api/check", json={"timeline": {"prompts": prompts}}).json()["prompts"]
    advice = told["advice"]
    assert "hardly knows" in advice["sentence"] and bool(advice["nearest"]) == near
    assert near or "it knows nothing near" in advice["sentence"]
    assert all(repr(known) in advice["sentence"] for known in advice["nearest"])


@pytest.mark.parametrize(
    ("prompts", "number", "message"),
    [
        ([], None, "empty"),
        ([{"text": "walk", "start": 0, "end": 301}], 0, "300 at most"),
        ([*WALK["prompts"], {"text": "walk", "start": 2, "end": 1}], 1, "prompt 2"),
        ([{"text": "walk", "start": 0, "end": 1, "parts": ["tail"]}], 0, "tail"),
        ([{"text": "walk", "start": "0", "end": 1}], 0, "start"),
        ([{"text": "walk", "start": 0}], 0, "end is missing"),
        ([{"text": 7, "start": 0, "end": 1}], 0, "text=7"),
        ([{"text": "walk", "start": True, "end": 1}], 0, "start=true"),
        (["walk"], 0, "object"),
        ([{"text": "walk", "start": 0, "end": 1}] * 201, None, "200 at most"),
    ],
)
def test_what_a_timeline_cannot_mean_is_said_with_the_number_of_the_prompt(client, prompts, number, message):
    answer = client.post("/api/check", json={"timeline": {"prompts": prompts}})
    assert answer.status_code == 422
    assert answer.json()["prompt"] == number and message in answer.json()["error"]


def test_files_of_timelines_are_read_and_written_as_by_the_library(client):
    text = client.post("/api/write", json={"timeline": WALK, "format": "txt"})
    assert text.text == "walk # 0.0 # 2.0 # legs\n" and "attachment" in text.headers["content-disposition"]
    written = client.post("/api/write", json={"timeline": WALK, "format": "json"}).text
    for name, content in (("a.txt", text.text), ("a.JSON", written)):
        [timeline] = client.post("/api/read", json={"name": name, "text": content}).json()["timelines"]
        assert timeline["prompts"] == WALK["prompts"]
    for name, content, message in (
        ("a.txt", "walk # 0", "line 1: 'walk # 0' has no end"),
        ("a.json", '{"tracks": 1}', "tracks: 1 is not a list of tracks"),
        ("a.csv", text.text, "unknown kind of timeline file '.csv'; choose from .json, .txt"),
    ):
        answer = client.post("/api/read", json={"name": name, "text": content})
        assert answer.status_code == 422 and answer.json()["error"].startswith(message)
    assert client.post("/api/write", json={"timeline": WALK, "format": "exe"}).status_code == 422


KEYS = [
    "timeline", "prompts", "text", "start", "end", "parts", "name", "seeds", "steps", "keep", "change", "base",
    "constraints", "target", "keyframe", "path", "motion", "at", "content", "format", "clean_feet", "tab", "skeleton",
    "joints", "parent", "place", "joint_map", "fps", "seed", "edits", "frames", "add", "move", "remove",
]  # fmt: skip
ANY = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5) | st.just("walk"),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(KEYS), inner, max_size=6),
    max_leaves=12,
)
ADDRESSES = [("POST", "/api/check"), ("POST", "/api/read"), ("POST", "/api/write"), ("POST", "/api/motions"),
             ("PUT", "/api/documents/fuzz"), ("PUT", "/api/characters/none/joint_map"), ("POST", "/api/jobs"),
             ("POST", "/api/map"), ("POST", "/api/retarget"), ("POST", "/api/films"), ("POST", "/api/streams"),
             ("POST", "/api/streams/none")]  # fmt: skip


@given(
    st.sampled_from(ADDRESSES), st.dictionaries(st.sampled_from(KEYS), ANY, max_size=6) | ANY | st.binary(max_size=40)
)
def test_whatever_is_sent_is_refused_with_a_sentence_or_met(client, address, data):
    content = data if isinstance(data, bytes) else json.dumps(data).encode()
    answer = client.request(*address, content=content)
    assert answer.status_code < 500
    assert answer.status_code < 300 or answer.json()["error"]


# Jobs


def test_a_job_tells_its_steps_a_preview_and_the_motion_of_every_seed(client):
    told = sampled(client, seeds=[3, 4])
    stages = ["preview", "preview", "full", "full"]
    assert [(each["seed"], each["stage"]) for each in made(told)] == list(zip([3, 4, 3, 4], stages, strict=True))
    assert told[-1] == ("done", {})
    assert progress(told) <= {("waiting", 0), ("preview", 10), ("full", 4)}
    motion = made(told)[0]["motion"]
    assert ID.fullmatch(motion["id"]) and (motion["frames"], motion["fps"]) == (40, 20)


def test_a_job_of_a_preview_alone_is_told_as_one(client):
    told = sampled(client, steps="preview")
    assert [each["stage"] for each in made(told)] == ["preview"]
    assert ("preview", 10) in progress(told) and progress(told) <= {("waiting", 0), ("preview", 10)}


def test_a_model_of_few_steps_has_these_and_no_preview_before_them():
    assert stages_by_quality(4, 4) == {"preview": (("preview", 4),), "full": (("full", 4),)}
    assert stages_by_quality(None, 50) == {"preview": (PREVIEW,), "full": (PREVIEW, ("full", 50))}


def test_a_motion_is_what_the_library_makes_of_the_timeline(client, model):
    [told] = made(sampled(client, steps="preview", seeds=[5]))
    content = client.get(f"/api/motions/{told['motion']['id']}.npz").content
    own = client.post("/api/motions", content=content).json()["motion"]
    assert own["frames"] == 40 and own["id"] != told["motion"]["id"]
    [expected] = model.generate("walk # 0 # 2 # legs", seed=5, steps=10, sampler="ddim")
    path = Path(client.app.state.folder) / "motions" / f"{told['motion']['id']}.npz"
    np.testing.assert_allclose(stmc.read(path).joints, expected.joints, atol=1e-5)


def test_motions_of_the_last_stage_are_judged_by_their_own_timelines(model, tmp_path):
    asked = []

    def find_missed(timeline, motion):
        asked.append((timeline.prompts[0].text, motion.frames))
        return [Missed(timeline.prompts[0].text, 0, 2, "walk")]

    jobs = Jobs(model.sample, Motions(tmp_path), find_missed=find_missed)
    request = stmc.GenerateRequest.read({"timelines": ["walk # 0 # 2", "wave # 0 # 1"], "seeds": [3, 4]})
    job = jobs.add(request, (Stage("preview", 2), Stage("full", 3)))
    jobs.wait()
    jobs.close()
    found = [(each["stage"], each["seed"], each["missed"]) for kind, each in job.events if kind == "motion"]
    assert [each[:2] for each in found] == [("preview", 3), ("preview", 4), ("full", 3), ("full", 4)]
    assert [each[2] for each in found[:2]] == [[], []]
    assert [missed["text"] for _, _, each in found[2:] for missed in each] == ["walk", "wave"]
    assert "does not show from 0 to 2 s" in found[2][2][0]["sentence"]
    assert asked == [("walk", 40), ("wave", 20)]


def test_what_is_kept_stays_and_only_the_change_is_made_anew(client):
    [first] = made(sampled(client, timeline=BOTH, steps="preview"))
    change = [{"start": 0.5, "end": 1.5, "parts": ["right arm"]}]
    asked = {"timeline": BOTH, "steps": "preview", "seeds": [9], "keep": first["motion"]["id"], "change": change}
    [second] = made(sampled(client, **asked))
    folder = Path(client.app.state.folder) / "motions"
    before, after = (stmc.read(folder / f"{each['motion']['id']}.npz") for each in (first, second))
    difference = (after.rotations - before.rotations).abs().amax(dim=(-1, -2))
    arm = [JOINTS.index(name) for name in stmc.BodyPart.RIGHT_ARM.joints if name != "right_hand"]
    others = [joint for joint in range(22) if joint not in arm]
    assert difference[:, others].max() < 1e-5 and difference[:10].max() < 1e-5 and difference[30:].max() < 1e-5
    assert difference[12:28][:, arm].max() > 1e-3


def test_constraints_are_met_and_their_errors_told(client):
    [walked] = made(sampled(client, steps="preview"))
    constraints = [
        {"target": {"joint": "right_hand", "point": [-0.2, -0.4, 1.2], "start": 0.5, "end": 0.6}},
        {"keyframe": {"motion": walked["motion"]["id"], "at": 1.0, "second": 0.5}},
    ]
    [told] = made(sampled(client, steps="preview", constraints=constraints))
    target, *of_keyframe = told["demands"]
    assert (target["name"], target["unit"]) == ("target", "cm") and target["error"] < 2
    assert {each["name"] for each in of_keyframe} == {"keyframe"}


def test_a_keyframe_at_a_second_that_its_motion_does_not_have_is_refused_in_a_sentence(client):
    [walked] = made(sampled(client, steps="preview"))
    keyframe = {"motion": walked["motion"]["id"], "at": 1.0, "second": 2.0}
    answer = client.post("/api/jobs", json={"timeline": WALK, "constraints": [{"keyframe": keyframe}]})
    assert answer.status_code == 422 and "no pose at 2 s: must be from 0 to below 2" in answer.json()["error"]


def test_whatever_a_request_can_have_is_taken_from_the_page_and_decides_the_motion(client):
    default = made(sampled(client, steps="preview"))[0]["motion"]["id"]
    motions = client.app.state.jobs.motions
    for settings in ({"guidance": 0.0}, {"method": "stmc_paper", "overlap": 0}, {"sampler": "ddpm"}):
        [told] = made(sampled(client, steps="preview", **settings))
        expected = client.app.state.jobs.sample(
            stmc.GenerateRequest.read(
                {"timelines": "walk # 0 # 2 # legs", "steps": 10} | {"sampler": "ddim"} | settings
            )
        )[0]
        torch.testing.assert_close(motions.get(told["motion"]["id"]).joints, expected.joints, atol=1e-4, rtol=0)
        if "guidance" in settings:
            assert not torch.equal(motions.get(default).joints, expected.joints)


@pytest.mark.parametrize(
    ("asked", "status"),
    [
        ({"seeds": []}, 422),
        ({"seeds": [1] * 9}, 422),
        ({"seeds": [True]}, 422),
        ({"seeds": [-1]}, 422),
        ({"steps": "all"}, 422),
        ({"keep": "not-there"}, 404),
        ({"keep": "../../etc/passwd"}, 404),
        ({"change": [{"start": 5, "end": 1}]}, 422),
        ({"change": ["all"]}, 422),
        ({"constraints": [{"keyframe": {"motion": "/etc/passwd", "at": 0}}]}, 404),
        ({"constraints": [{"keyframe": {"at": 0}}]}, 422),
        ({"constraints": [{"keyframe": {"motion": 7, "at": 0}}]}, 422),
        ({"constraints": [{"fly": {}}]}, 422),
        ({"constraints": [{}] * 101}, 422),
        ({"clean_feet": 1}, 422),
        ({"guidance": "much"}, 422),
        ({"method": "os.system", "trusted": ["os"]}, 422),
        ({"noise_scale": "std"}, 422),
    ],
    ids=str,
)
def test_jobs_that_make_no_sense_are_refused_before_they_wait(client, asked, status):
    answer = client.post("/api/jobs", json={"timeline": WALK} | asked)
    assert answer.status_code == status and answer.json()["error"]


def test_a_job_that_cannot_be_done_fails_with_a_sentence_and_the_next_one_is_done(client):
    [walked] = made(sampled(client, steps="preview"))
    told = sampled(client, keep=walked["motion"]["id"])
    assert told[-1][0] == "failed" and "nothing to generate" in told[-1][1]["error"]
    assert sampled(client)[-1][0] == "done"


class Held:
    """A model whose sampling waits behind each step until it may go on; counts the steps that it makes."""

    def __init__(self, model: stmc.Model) -> None:
        self.model, self.began, self.may, self.made = model, threading.Event(), threading.Event(), 0

    def sample(self, request, progress):
        def counted(steps):
            for step in steps:
                self.made += 1
                yield step

        def waiting(steps, total):
            for step in progress(counted(steps), total):
                self.began.set()
                assert self.may.wait(timeout=60)
                yield step

        return self.model.sample(request, waiting)


@pytest.fixture
def held(model, tmp_path) -> Iterator[tuple[Held, Jobs]]:
    slow = Held(model)
    jobs = Jobs(slow.sample, Motions(tmp_path))
    yield slow, jobs
    slow.may.set()
    jobs.close()


def ask() -> stmc.GenerateRequest:
    return stmc.GenerateRequest.read({"timelines": "walk # 0 # 1"})


def test_a_cancelled_job_ends_before_its_next_step_and_one_that_waits_at_once(held):
    slow, jobs = held
    running, waiting = jobs.add(ask()), jobs.add(ask())
    assert slow.began.wait(timeout=60)
    jobs.cancel(waiting.name)
    jobs.cancel(running.name)
    assert waiting.events[-1][0] == "cancelled" and not running.ended
    slow.may.set()
    jobs.wait()
    assert [job.events[-1][0] for job in (running, waiting)] == ["cancelled", "cancelled"]
    assert not any(kind == "motion" for kind, _ in running.events)
    assert slow.made == 1
    last = jobs.add(ask())
    jobs.wait()
    assert last.events[-1][0] == "done"


def test_a_cancelled_job_ends_within_a_step_before_the_next_operation_on_tensors(tmp_path):
    """A step of eight minutes of motion takes 16 s; its operations take one at most."""
    began, may, done = threading.Event(), threading.Event(), []

    def sample(request, progress):
        for _ in progress([0], total=1):
            numbers = torch.zeros(2)
            began.set()
            assert may.wait(timeout=60)
            done.append(numbers + 1)
        pytest.fail("the step was not ended")

    jobs = Jobs(sample, Motions(tmp_path))
    job = jobs.add(ask())
    assert began.wait(timeout=60)
    jobs.cancel(job.name)
    may.set()
    jobs.wait()
    jobs.close()
    assert job.events[-1] == ("cancelled", {}) and not done


def test_of_one_tab_only_the_last_job_waits_and_too_many_are_refused(held):
    slow, jobs = held
    jobs.add(ask())
    assert slow.began.wait(timeout=60)
    first, second = (jobs.add(ask(), tab="one") for _ in range(2))
    assert first.ended and not second.ended
    for _ in range(MOST_WAITING - 1):
        jobs.add(ask())
    with pytest.raises(RequestError, match="already waiting"):
        jobs.add(ask())
    jobs.add(ask(), tab="one")  # in the other's place


def test_a_closed_queue_ends_what_is_being_sampled_and_what_waits(held):
    slow, jobs = held
    running, waiting = jobs.add(ask()), jobs.add(ask())
    assert slow.began.wait(timeout=60)
    threading.Timer(0.2, slow.may.set).start()
    jobs.close()
    assert [running.events[-1][0], waiting.events[-1][0]] == ["cancelled", "cancelled"]


# What is kept


def test_a_motion_can_be_taken_away_in_every_format(client):
    [told] = made(sampled(client, steps="preview"))
    for kind, start in {
        "glb": b"glTF",
        "bvh": b"HIERARCHY",
        "npz": b"PK",
        "csv": b"",
        "xml": b"<",
        "html": b"<!",
    }.items():
        answer = client.get(f"/api/motions/{told['motion']['id']}.{kind}", params={"fps": "30"})
        assert answer.status_code == 200 and answer.content.lower().startswith(start.lower()), kind
        assert f"motion.{kind}" in answer.headers["content-disposition"]


def test_a_page_bears_the_constraints_that_are_sent_and_a_loop_does_not(client):
    [told] = made(sampled(client, steps="preview"))
    path = {"path": {"points": [[0, 0], [0, -2]], "start": 0, "end": 1}}

    def page(**settings) -> str:
        sent = {"constraints": json.dumps({"constraints": [path]})} | settings
        return client.get(f"/api/motions/{told['motion']['id']}.html", params=sent).text

    assert "row part demand" in page()
    assert "row part demand" not in page(loop="1")
    wrong = {"constraints": json.dumps({"constraints": [{"path": {"points": [[0, 0]]}}]})}
    assert client.get(f"/api/motions/{told['motion']['id']}.html", params=wrong).status_code == 422


def test_a_loop_goes_without_the_timeline_whose_times_are_not_its_own(client, tmp_path):
    [told] = made(sampled(client, steps="preview"))
    files = {}
    for loop in ("0", "1"):
        settings = {"timeline": json.dumps(WALK), "loop": loop}
        files[loop] = tmp_path / f"{loop}.npz"
        files[loop].write_bytes(client.get(f"/api/motions/{told['motion']['id']}.npz", params=settings).content)
    assert stmc.read(files["1"]).frames < stmc.read(files["0"]).frames == 40
    assert ["timeline" in np.load(files[loop]) for loop in ("0", "1")] == [True, False]


def test_a_film_that_needs_what_is_not_installed_is_refused_with_what_to_install(client, monkeypatch):
    def missing(*args):
        raise ModuleNotFoundError("videos need imageio-ffmpeg: pip install 'stmc[film]'; .webp does without")

    monkeypatch.setattr("stmc.viewing.film.render_film", missing)
    [told] = made(sampled(client, steps="preview"))
    answer = client.get(f"/api/motions/{told['motion']['id']}.mp4")
    assert answer.status_code == 501 and "pip install" in answer.json()["error"]


def test_a_film_is_a_job_that_counts_pictures_and_its_file_is_there_once_it_is_done(client, monkeypatch):
    drawn = []

    def render(motion, path, timeline, progress):
        drawn.append((motion.frames, timeline))
        draw_nothing(motion, path, timeline, progress)

    monkeypatch.setattr(client.app.state.films, "render", render)
    [told] = made(sampled(client, steps="preview"))
    asked = {"motion": told["motion"]["id"], "format": "gif", "fps": 10, "timeline": WALK}
    for loop in (False, True):
        job = client.post("/api/films", json=asked | {"loop": loop}).json()["job"]
        stages = events(client.get(f"/api/jobs/{job}/events").text)
        (frames, timeline), (kind, last) = drawn[-1], stages[-2]
        assert (kind, last) == ("progress", {"stage": "film", "step": frames, "steps": frames})
        assert stages[-1] == ("done", {}) and (timeline is None) == loop and (frames < 20 if loop else frames == 20)
        film = client.get(f"/api/films/{job}")
        assert film.status_code == 200 and film.content == b"film" and film.headers["content-type"] == "image/gif"
        assert "motion.gif" in film.headers["content-disposition"]
    assert client.get("/api/films/none").status_code == 404
    assert client.post("/api/films", json=asked | {"motion": "none"}).status_code == 404
    monkeypatch.setattr("stmc.io.bounds.MOST_PICTURES", 6)
    refusal = client.post("/api/films", json=asked)
    assert refusal.status_code == 422 and "a .gif film has at most 6 pictures" in refusal.json()["error"]
    monkeypatch.setattr("stmc.viewing.studio.storage.MOST_FILM_FRAMES", 5)
    assert "5 at most" in client.post("/api/films", json=asked).json()["error"]


def test_a_film_that_is_cancelled_by_its_job_has_no_file(client, monkeypatch):
    drawing, may = threading.Event(), threading.Event()

    def render(motion, path, timeline, progress):
        for _ in progress(range(motion.frames), total=motion.frames):
            drawing.set()
            assert may.wait(timeout=60)

    monkeypatch.setattr(client.app.state.films, "render", render)
    [told] = made(sampled(client, steps="preview"))
    job = client.post("/api/films", json={"motion": told["motion"]["id"]}).json()["job"]
    assert drawing.wait(timeout=60)
    assert client.delete(f"/api/jobs/{job}").status_code == 200
    may.set()
    assert events(client.get(f"/api/jobs/{job}/events").text)[-1] == ("cancelled", {})
    assert client.get(f"/api/films/{job}").status_code == 404


@pytest.mark.parametrize("path", ["none.glb", "..%2Fmodel.npz", "x" * 50 + ".bvh", "a.exe"])
def test_what_is_no_motion_is_not_found(client, path):
    assert client.get(f"/api/motions/{path}").status_code == 404


@pytest.mark.parametrize("fps", ["0", "1e9", "nan", "-3", "241"])
def test_frame_rates_are_bounded(client, fps):
    [told] = made(sampled(client, steps="preview"))
    assert client.get(f"/api/motions/{told['motion']['id']}.bvh", params={"fps": fps}).status_code == 422


@pytest.mark.parametrize("name", ["walk.bvh", "W%C3%A4lk.BVH", "walk.npz"])
def test_a_motion_that_is_brought_along_is_read_as_its_file_s_name_says(client, name):
    [told] = made(sampled(client, steps="preview"))
    content = client.get(f"/api/motions/{told['motion']['id']}.{name[-3:].lower()}").content
    answer = client.post("/api/motions", content=content, headers={"X-Filename": name})
    assert answer.status_code == 201
    own, folder = answer.json()["motion"], Path(client.app.state.folder) / "motions"
    assert (own["frames"], own["fps"]) == (40, 20)
    back, motion = (stmc.read(folder / f"{each['id']}.npz") for each in (own, told["motion"]))
    np.testing.assert_allclose(back.joints, motion.joints, atol=1e-4)


@pytest.mark.parametrize("name", ["walk.glb", "walk", "", "..%2F..%2Fwalk.npz%00", "%FF.bvh", "a." + "x" * 3000])
def test_a_motion_of_another_kind_is_refused(client, name):
    answer = client.post("/api/motions", content=b"not a motion", headers={"X-Filename": name})
    assert answer.status_code == 422 and len(answer.json()["error"]) < 300


@pytest.mark.parametrize("content", [b"", b"PK", b"not a motion", np.zeros(3).tobytes()], ids=repr)
def test_a_file_that_is_no_motion_is_refused(client, content):
    assert client.post("/api/motions", content=content).status_code == 422


def test_motions_outlive_the_server_and_old_ones_go_unless_a_document_names_them(tmp_path, monkeypatch):
    monkeypatch.setattr("stmc.viewing.studio.storage.MOST_MOTIONS", 1)
    monkeypatch.setattr("stmc.viewing.studio.storage.REMEMBERED", 1)
    motion = tiny().generate("walk # 0 # 0.5", steps=1)[0]
    before = Motions(tmp_path)
    names = [before.add(motion) for _ in range(3)]
    after = Motions(tmp_path)
    for name in names:
        torch.testing.assert_close(after.get(name).joints, motion.joints)
    after.named = lambda: f'{{"favourite": "{names[0]}"}}'
    after.prune()
    assert names[0] in {path.stem for path in tmp_path.iterdir()} and len(list(tmp_path.iterdir())) == 2


def test_of_two_tabs_none_overwrites_the_other_unknowingly(client):
    address = "/api/documents/walk"
    assert client.put(address, json={"base": 0, "content": {"name": "mine"}}).json() == {"version": 1}
    refused = client.put(address, json={"base": 0, "content": {"name": "theirs"}})
    assert refused.status_code == 409 and refused.json()["content"] == {"name": "mine"}
    assert client.put(address, json={"base": 1, "content": {"name": "both"}}).json() == {"version": 2}
    assert client.get(address).json() == {"id": "walk", "version": 2, "content": {"name": "both"}}
    assert [each["name"] for each in client.get("/api/documents").json()["documents"] if each["id"] == "walk"] == [
        "both"
    ]
    assert client.delete(address).status_code == 200 and client.get(address).status_code == 404


def test_of_many_that_write_at_once_each_version_is_somebodys_whole_document(tmp_path):
    documents, won = Documents(tmp_path), []

    def write(number: int) -> None:
        for _ in range(20):
            try:
                now = documents.get("one")["version"]
            except RequestError:
                now = 0
            try:
                won.append(documents.put("one", now, {"who": number, "text": str(number) * 1000}))
            except RequestError as refused:
                assert refused.status == 409

    threads = [threading.Thread(target=write, args=(number,)) for number in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(won) == list(range(1, len(won) + 1))
    last = documents.get("one")
    assert last["version"] == len(won) and set(last["content"]["text"]) == {str(last["content"]["who"])}


def test_a_damaged_document_is_said_to_be_one_and_hides_no_other(client):
    folder = Path(client.app.state.folder) / "documents"
    (folder / "damaged.json").write_text('{"version": 1, "con')
    client.put("/api/documents/whole", json={"base": 0, "content": {}})
    assert client.get("/api/documents/damaged").status_code == 422
    assert "whole" in [each["id"] for each in client.get("/api/documents").json()["documents"]]


def test_bf16_is_not_tried_out_where_the_processor_imitates_it(monkeypatch):
    module, asked = loaded("studio"), []
    monkeypatch.setattr(stmc, "load", lambda model, precision, **settings: asked.append(precision) or tiny())
    monkeypatch.setattr(module, "imitates_bf16", lambda device: True)
    module.load_model(module.Settings())
    assert asked == ["fp32"]
    monkeypatch.setattr(module, "imitates_bf16", lambda device: False)
    module.load_model(module.Settings())
    assert asked == ["fp32", "fp32", "bf16"]
