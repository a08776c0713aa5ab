"""Embeddings ahead of time: texts are found in every format there is, encoded once, and found again by training."""

import json

import pytest
from helpers.scripts import configured, loaded, script
from hydra.utils import instantiate
from test_text import packaged

from stmc.text import Cached, MiniLM

MTT = """\
walk in a circle # 0.0 # 4.0 # legs
raise the right arm # 1.0 # 3.0 # right arm

walk in a circle # 0.0 # 2.0 # legs
"""
CAPTION = "a person walks.#a/DET person/NOUN walk/VERB#0.0#0.0\nsomeone strolls#someone/PRON stroll/VERB#1.0#2.5\n"
TIMELINE = {"name": "one", "tracks": [[{"text": "nod", "start": 0, "end": 1, "body_parts": ["head"]}]]}
ANNOTATIONS = {"000001": {"path": "a/b", "duration": 3.0, "annotations": [{"seg_id": "0", "text": "a person sits"}]}}


@pytest.fixture(scope="module")
def found():
    module = loaded("embed")
    return lambda path: list(module.texts_in(path))


@pytest.mark.parametrize(
    ("name", "content", "texts"),
    [
        ("mtt.txt", MTT, ["walk in a circle", "raise the right arm", "walk in a circle"]),
        ("lines.txt", "\ufeffwalk\n\n turn left \n", ["walk", "turn left"]),
        ("000001.txt", CAPTION, ["a person walks.", "someone strolls"]),
        ("one.json", json.dumps(TIMELINE), ["nod"]),
        ("many.json", json.dumps([TIMELINE, TIMELINE]), ["nod", "nod"]),
        ("annotations.json", json.dumps(ANNOTATIONS), ["a person sits"]),
    ],
)
def test_texts_are_found_in_every_format(found, tmp_path, name, content, texts):
    (tmp_path / name).write_text(content, encoding="utf-8")
    assert found(tmp_path / name) == texts


def test_a_folder_is_all_its_files(found, tmp_path):
    (tmp_path / "texts").mkdir()
    (tmp_path / "texts" / "000002.txt").write_text(CAPTION)
    (tmp_path / "one.json").write_text(json.dumps(TIMELINE))
    (tmp_path / "picture.png").write_bytes(b"\x89PNG")
    assert found(tmp_path) == ["nod", "a person walks.", "someone strolls"]


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("empty.txt", b"\n\n", "contains no text"),
        ("broken.json", b"{", r"broken\.json cannot be read"),
        ("latin.txt", b"caf\xe9", r"latin\.txt cannot be read"),
        ("other.json", b'{"texts": 3}', "contains no text"),
    ],
)
def test_what_holds_no_texts_is_an_error(found, tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=message):
        found(tmp_path / name)
    with pytest.raises(ValueError, match="does not exist"):
        found(tmp_path / "nowhere")


@pytest.mark.slow
@packaged
def test_the_script_fills_the_cache_that_training_reads_and_goes_on_where_it_was(tmp_path):
    (tmp_path / "mtt.txt").write_text(MTT)
    settings = (f"texts={tmp_path / 'mtt.txt'}", f"folder={tmp_path / 'cache'}")
    first = script("embed", *settings, folder=tmp_path / "here")
    assert "3 texts" in first.stdout and "3 of them new" in first.stdout
    cached = Cached(MiniLM(), tmp_path / "cache")
    assert list((tmp_path / "cache").iterdir()) == [cached.file]
    (tmp_path / "mtt.txt").write_text(MTT.replace("circle", "square"))
    again = script("embed", *settings, folder=tmp_path / "here").stdout
    assert "1 of them new" in again and "encoded 1 of 1 texts" in again
    cached.encoder.encode = lambda texts: pytest.fail(f"asked for {texts}")
    words, _ = cached.encode(["", "walk in a circle", "raise the right arm"])
    assert words.shape == (3, 1, 384)
    assert not list((tmp_path / "here").iterdir())


@pytest.mark.parametrize("name", ["train", "embed"])
@pytest.mark.parametrize("encoder", ["clip", "clip_tokens", "clip_mdm", "distilbert", "t5"])
def test_a_folder_of_weights_is_named_on_the_command_line(name, encoder):
    key = "encoder.source" if encoder == "clip_mdm" else "source"
    config = configured(name, f"text_encoder={encoder}", f"text_encoder.{key}=weights/mine")
    assert instantiate(config.text_encoder).name.startswith("weights/mine")


@pytest.mark.slow
def test_weights_that_are_not_there_are_named(tmp_path):
    (tmp_path / "lines.txt").write_text("walk\n")
    settings = (f"texts={tmp_path / 'lines.txt'}", f"folder={tmp_path / 'cache'}", "text_encoder=clip")
    done = script("embed", *settings, f"text_encoder.source={tmp_path}", folder=tmp_path / "here", check=False)
    assert done.returncode == 2 and "hf download openai/clip-vit-base-patch32" in done.stdout
    assert "Traceback" not in done.stdout
