"""Mutated files for every reader of files that others made: `python tests/fuzz.py 20000 [seed]`.

Each reader gets files that were valid before bytes were flipped, cut, doubled, moved or replaced by hostile numbers. It
may read them, or refuse them with an error of this library in a short sentence, within a second of processor time and a
gigabyte of memory. Prints what went wrong, and a summary; ends with 1 where anything did.
"""

import io
import json
import logging
import pickle
import random
import sys
import tempfile
import time
import warnings
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
import torch
from helpers import characters as made_characters
from helpers import guo_files, toy_data
from helpers import robots as made_robots
from helpers.acclaim_files import Actor, moving
from helpers.joblib_files import joblib_bytes
from helpers.memory import peak
from helpers.smpl_pickles import python_2_pickle
from helpers.source_folders import humanml3d, published, recorded, smplh_arrays
from helpers.tiny_model import tiny
from scipy import sparse

import stmc
from stmc.data.cache import Cache
from stmc.data.sources.amass.amass_recordings import read_recording
from stmc.data.sources.amass.annotations import read_annotations
from stmc.data.sources.babel.composition_lists import read_compositions
from stmc.data.sources.cmu import catalogue as cmu
from stmc.data.sources.cmu.asf import parse_amc, parse_asf
from stmc.data.sources.humanml3d.humanml3d_texts import read_captions, read_index
from stmc.evaluation.benchmarks.atomic_prompts import read_atomic_prompts
from stmc.evaluation.results import read_results
from stmc.formats.bvh_parser import parse_bvh
from stmc.io.arrays import npz_headers, read_joblib, read_npy, read_npz, read_pickle, read_places
from stmc.motion.body_model import Skeleton
from stmc.run.configs import read_config
from stmc.run.published.torch_checkpoint import read_checkpoint
from stmc.run.weights import read_specs
from stmc.text.vocabulary.vocabulary_files import read_vocabulary

MOST_SECONDS, MOST_KILOBYTES, LONGEST = 1.0, 2**20, 1000
"""Of processor time for a file, of memory in all, and characters of a message."""

NUMBERS = (
    b"1e308",
    b"-1e308",
    b"nan",
    b"inf",
    b"0",
    b"-1",
    b"1" * 400,
    b"99999999999",
    b"1e-308",
    b"0.5",
    b"[]",
    b"null",
)
"""What is put in the place of a number in a text."""

BYTES = (b"\x00", b"\xff", b"\xff\xff\xff\x7f", b"\x80\x04\x95", b"}", b"{", b"[", b'"', b"#", b"\n", b",")


def corpus(folder: Path) -> Iterator[tuple[str, Path, Callable[[Path], object]]]:
    """A name, a valid file and its reader, each; readers of folders read the file's."""
    motion, skeleton = recorded(seconds=0.5), Skeleton.default()
    for kind in ("npz", "bvh"):
        stmc.write(motion, folder / f"motion.{kind}")
        yield f"read {kind}", folder / f"motion.{kind}", stmc.read
    np.savez(folder / "amass.npz", **smplh_arrays(motion))
    yield "recording", folder / "amass.npz", lambda path: read_recording(path, skeleton)
    np.savez_compressed(folder / "arrays.npz", a=np.eye(3), b=np.arange(9, dtype=">i2"), c=np.array("text"))
    yield "headers", folder / "arrays.npz", npz_headers
    yield "arrays", folder / "arrays.npz", lambda path: read_npz(path, ["a", "b", "c"])
    np.save(folder / "array.npy", np.eye(9))
    yield "array", folder / "array.npy", read_npy
    rig = made_characters.lanky()
    yield "character glb", written(folder / "hero.glb", made_characters.glb(rig)), stmc.read_character
    yield "character bvh", written(folder / "hero.bvh", made_characters.bvh(rig).encode()), stmc.read_character
    yield "robot xml", written(folder / "robot.xml", made_robots.mjcf().encode()), stmc.read_character
    yield "robot urdf", written(folder / "robot.urdf", made_robots.urdf().encode()), stmc.read_character
    yield from pickles(folder)
    yield from texts(folder)
    yield from folders(folder)


def pickles(folder: Path) -> Iterator[tuple[str, Path, Callable[[Path], object]]]:
    body = {"a": np.eye(4), "b": sparse.csc_matrix(np.eye(5)), "c": 3, "d": {"e": {1, 2}, "f": [None, "x"]}}
    for protocol in (0, 2, 4):
        path = written(folder / f"body_{protocol}.pkl", pickle.dumps(body, protocol))
        yield f"pickle {protocol}", path, lambda path: read_pickle(path, ["a", "b", "c"])
    chumpy = python_2_pickle({"a": ("Ch", np.eye(3)), "b": ("Select", np.eye(3), [3, 0, 4, 2], (2, 2))}, 2)
    yield "chumpy", written(folder / "chumpy.pkl", chumpy), lambda path: read_pickle(path, ["a", "b"])
    places = pickle.dumps({f"word{number}": number for number in range(20)})
    yield "places", written(folder / "places.pkl", places), read_places
    entries = joblib_bytes([{"poses": np.zeros((4, 156)), "fps": np.array(30.0), "fname": "a/b.npz"}] * 2)
    read = partial(read_joblib, arrays=["poses", "fps"], texts=["fname"])
    yield "joblib", written(folder / "a.pth.tar", entries), read
    yield "joblib, packed", written(folder / "b.pth.tar", zlib.compress(entries)), read
    buffer = io.BytesIO()
    torch.save({"weight": torch.eye(4), "epoch": 3, "args": {"lr": 1e-3}}, buffer)
    yield "checkpoint", written(folder / "model.pt", buffer.getvalue()), read_checkpoint


def texts(folder: Path) -> Iterator[tuple[str, Path, Callable[[Path], object]]]:
    timeline = stmc.Timeline.parse("walk # 0 # 4 # legs\nwave # 1 # 2.5 # right arm\n")
    yield "timeline json", written(folder / "t.json", timeline.to_json().encode()), stmc.Timeline.read_all
    lines = b"walk # 0 # 4 # legs\nwave # 1 # 2.5 # right arm\n\nsit # 0 # 3\n"
    yield "timeline txt", written(folder / "t.txt", lines), stmc.Timeline.read_all
    demands = [{"path": {"points": [[0, 0], [0, -3]], "end": 4}}, {"heading": {"angle": 1, "start": 2}},
               {"target": {"joint": "left_hand", "point": [0, 0.3, 1]}}, {"hold": {"joint": "left_foot"}}]  # fmt: skip
    yield "constraints", written(folder / "c.json", json.dumps(demands).encode()), stmc.read_constraints
    captions = b"a person walks.#a/DET person/NOUN walk/VERB#0.0#0.0\nhe waves#he/PRON wave/VERB#1.5#3.0\n"
    yield "captions", written(folder / "captions.txt", captions), read_captions
    index = b"source_path,start_frame,end_frame,new_name\n./pose_data/KIT/3/a.npy,0,117,000000.npy\n"
    yield "index", written(folder / "index.csv", index + b"./pose_data/CMU/1/b.npy,3,-1,000001.npy\n"), read_index
    compositions = [{"id": 1, "text": ["walk", "run"], "lengths": [60, 90], "scenario": "short"}]
    yield "compositions", written(folder / "l.json", json.dumps(compositions).encode()), read_compositions
    prompts = Path(stmc.__file__).parent / "assets" / "open_mtt" / "prompts.json"
    some = json.dumps(json.loads(prompts.read_text("utf-8"))[:5]).encode()
    yield "prompts", written(folder / "p.json", some), read_atomic_prompts
    path = written(folder / "sentences.txt", b"walk # legs\nwave # right arm\n")
    motions = written(folder / "motions.txt", b"a # 0 # 3\nb # 1 # 4\n")
    yield "sentences", path, lambda path: read_atomic_prompts(path, motions)
    assets = Path(stmc.__file__).parent / "assets"
    rows = (assets / "published_results" / "stmc_table_1.jsonl").read_bytes()
    yield "results", written(folder / "r.jsonl", rows), read_results
    config = (assets / "mdm_smpl_wide" / "config.yaml").read_bytes()
    yield "config", written(folder / "config.yaml", config), read_config
    text = (folder / "motion.bvh").read_bytes()
    actor = Actor(dict(cmu.FORMATS[0]), *moving(8))
    amc = written(folder / "b.amc", actor.amc().encode())
    yield "asf", written(folder / "a.asf", actor.asf().encode()), lambda path: parse_asf(path.read_text("latin1"))
    skeleton = parse_asf(actor.asf())
    yield "amc", amc, lambda path: parse_amc(path.read_text("latin1"), skeleton, 120)
    yield "bvh text", written(folder / "other.bvh", text), lambda path: parse_bvh(path.read_text("latin1"))


def folders(folder: Path) -> Iterator[tuple[str, Path, Callable[[Path], object]]]:
    toy_data.cache().write(folder / "cache")
    for path in sorted((folder / "cache").iterdir()):
        yield f"cache {path.name}", path, lambda path: Cache.read(path.parent)
    published(folder / "annotations")
    yield "annotations", folder / "annotations" / "annotations.json", lambda path: read_annotations(path.parent)
    whole = humanml3d(folder / "humanml3d")
    for name in ("index.csv", "train.txt"):
        found = next(iter(folder.glob(f"humanml3d/**/{name}")), None)
        if found:
            yield f"HumanML3D {name}", found, lambda path, whole=whole: read_annotations(whole)
    run = stmc.save(tiny(), folder / "run", "")
    for path in sorted(each for each in run.iterdir() if each.suffix in (".yaml", ".safetensors")):
        yield f"run {path.name}", path, lambda path: stmc.load(path.parent)
        if path.suffix == ".safetensors":
            yield f"specs {path.name}", path, read_specs
    if (run / "vocabulary.safetensors").exists():
        yield "vocabulary", run / "vocabulary.safetensors", read_vocabulary
    guo = guo_files.glove(folder / "glove")
    for path in sorted(guo.iterdir()):
        yield f"glove {path.name}", path, read_npy if path.suffix == ".npy" else read_places


def written(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


def mutated(content: bytes, rng: random.Random) -> bytes:
    """A file that was damaged one to eight times."""
    for _ in range(rng.choice((1, 1, 2, 4, 8))):
        content = rng.choice(MUTATIONS)(content, rng)
    return content


def _flipped(content: bytes, rng: random.Random) -> bytes:
    if not content:
        return content
    place = rng.randrange(min(len(content), rng.choice((64, 512, len(content)))))
    return content[:place] + bytes([content[place] ^ 1 << rng.randrange(8)]) + content[place + 1 :]


def _cut(content: bytes, rng: random.Random) -> bytes:
    start = rng.randrange(len(content) + 1)
    return content[:start] if rng.random() < 0.5 else content[:start] + content[start + rng.randrange(64) :]


def _doubled(content: bytes, rng: random.Random) -> bytes:
    start = rng.randrange(len(content) + 1)
    piece = content[start : start + rng.randrange(1, 256)]
    place = rng.randrange(len(content) + 1)
    return content[:place] + piece * rng.choice((1, 2, 30)) + content[place:]


def _put(content: bytes, rng: random.Random) -> bytes:
    place = rng.randrange(len(content) + 1)
    return content[:place] + rng.choice(BYTES) + content[place + rng.choice((0, 1, 4)) :]


def _number(content: bytes, rng: random.Random) -> bytes:
    """Another number in the place of one."""
    digits = [place for place in range(len(content)) if content[place : place + 1].isdigit()][:10_000]
    if not digits:
        return _put(content, rng)
    place = rng.choice(digits)
    return content[:place] + rng.choice(NUMBERS) + content[place + 1 :]


MUTATIONS = (_flipped, _cut, _doubled, _put, _number)


def wrong(read: Callable[[Path], object], path: Path) -> tuple[str, float]:
    """What a reader should not have done, or nothing; and its seconds of processor time."""
    began, told = time.process_time(), ""
    try:
        read(path)
    except ValueError as error:
        if not is_ours(error):
            told = f"{type(error).__name__}: {error}"[:300]
        elif len(str(error)) > LONGEST + len(str(path)):
            told = f"a message of {len(str(error))} characters: {str(error)[:200]}"
    except FileNotFoundError:  # a name in a list, which was damaged
        pass
    except BaseException as error:
        told = f"{type(error).__name__}: {error}"[:300]
    spent = time.process_time() - began
    if not told and spent > MOST_SECONDS:
        told = f"{spent:.1f} s of processor time"
    return told, spent


def is_ours(error: BaseException) -> bool:
    """Whether an error is of this library, by its class or by who raised it."""
    trace = error.__traceback__
    while trace.tb_next is not None:
        trace = trace.tb_next
    home = str(Path(stmc.__file__).parent)
    return type(error).__module__.startswith("stmc.") or trace.tb_frame.f_code.co_filename.startswith(home)


def main(count: int, seed: int) -> int:
    logging.disable()
    warnings.simplefilter("ignore")
    failures: Counter[tuple[str, str]] = Counter()
    tried: Counter[str] = Counter()
    rng, slowest = random.Random(seed), (0.0, "")
    with tempfile.TemporaryDirectory() as place:
        files = [(name, path, read, path.read_bytes()) for name, path, read in corpus(Path(place))]
        for name, path, read, _ in files:
            told, _ = wrong(read, path)
            assert not told, (name, told)
        before = peak()
        for number in range(count):
            name, path, read, content = files[number % len(files)]
            path.write_bytes(mutated(content, rng))
            told, spent = wrong(read, path)
            if told:
                failures[name, told.replace(place, "")] += 1
            tried[name] += 1
            slowest = max(slowest, (spent, name))
            path.write_bytes(content)
    for (name, told), times in failures.most_common(40):
        print(f"{name}: {told} ({times} times)")
    memory = f"{peak() / 1024:.0f} MiB at most, {before / 1024:.0f} before"
    print(f"{count} files, {len(tried)} readers, seed {seed}: {sum(failures.values())} failures")
    print(f"slowest {slowest[0]:.2f} s ({slowest[1]}); {memory}")
    return int(bool(failures) or peak() > MOST_KILOBYTES)


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]) if len(sys.argv) > 1 else 1000, int(sys.argv[2]) if len(sys.argv) > 2 else 0))
