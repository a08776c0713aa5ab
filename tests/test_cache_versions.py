"""A prepared cache is of a version that is raised by hand; these tests say when it has to be.

`tests/helpers/caches.json` holds, for each source, its version and the cache of a made-up data set. Where a test fails
and the change is meant, raise that source's `CACHE_VERSION` and run `python tests/test_cache_versions.py`.
"""

import json
import sys
import tempfile
from pathlib import Path

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parent))

import numpy as np
import pytest
from helpers.bandai_files import bvh_text, tumbling
from helpers.source_folders import Serial, amass, humanml3d, published
from test_cmu import actor

from stmc.data import preparation
from stmc.data.cache import Cache
from stmc.data.sources.amass import annotated_amass
from stmc.data.sources.bandai import bandai_clips
from stmc.data.sources.cmu import cmu_clips
from stmc.data.sources.humanml3d import humanml3d_folder as processed
from stmc.motion.representation import SmplRepresentation

KNOWN = Path(__file__).parent / "helpers" / "caches.json"
MODULES = {"bandai": bandai_clips, "cmu": cmu_clips, "annotated_amass": annotated_amass, "humanml3d": processed}
APART = 2e-3
"""Of features, in metres or parts of rotation matrices: another processor's last bits are far below it."""


def source(name: str, folder: Path) -> preparation.Preparation:
    """A small made-up data set."""
    if name == "bandai":
        (folder / "data").mkdir()
        (folder / "data" / "dataset-1_walk_normal_001.bvh").write_text(bvh_text(tumbling(60)))
        return bandai_clips.BandaiClips(folder, 20)
    if name == "cmu":
        (folder / "16.asf").write_text(actor(frames=600).asf())
        (folder / "16_01.amc").write_text(actor(frames=600).amc())
        return cmu_clips.CmuClips(folder, 20)
    if name == "humanml3d":
        return processed.ProcessedHumanML3D(humanml3d(folder / "HumanML3D"))
    return annotated_amass.AnnotatedAmass(
        amass(folder / "amass"), published(folder / "texts"), 20, SmplRepresentation()
    )


def prepared(name: str, folder: Path) -> Cache:
    made = source(name, folder)
    made.check()
    return made.prepared(folder / "pieces", 1, lambda pieces, total: pieces)


def described(name: str, cache: Cache) -> dict:
    """All clips, every fiftieth row of the features, and texts, unless they are of a file that is itself an input."""
    clips = [[clip.name, clip.content, clip.split, *clip.parts, clip.start, clip.end] for clip in cache.clips]
    rows = cache.features[::50].double().numpy().round(4)
    listed = {} if name in ("bandai", "cmu") else cache.texts
    texts = {key: [list(each) for each in values] for key, values in sorted(listed.items())}
    return {
        "version": MODULES[name].CACHE_VERSION,
        "clips": sorted(clips),
        "texts": texts,
        "features": [" ".join(f"{value:.4f}" for value in row) for row in rows],
    }


@pytest.mark.parametrize("name", MODULES)
def test_a_cache_is_what_its_version_says(name, tmp_path, monkeypatch):
    monkeypatch.setattr(preparation, "ProcessPoolExecutor", Serial)
    known, made = json.loads(KNOWN.read_text("utf-8"))[name], described(name, prepared(name, tmp_path))
    change = f"the cache of {name} is another: raise its CACHE_VERSION and write {KNOWN.name} again"
    assert made["version"] == known["version"], f"python tests/{Path(__file__).name} writes {KNOWN.name} again"
    assert (made["clips"], made["texts"]) == (known["clips"], known["texts"]), change
    first, second = (np.array([row.split() for row in each["features"]], dtype=float) for each in (made, known))
    assert first.shape == second.shape, change
    assert np.abs(first - second).max() < APART, change


def main() -> None:
    preparation.ProcessPoolExecutor = Serial
    made = {}
    for name in MODULES:
        with tempfile.TemporaryDirectory() as folder:
            made[name] = described(name, prepared(name, Path(folder)))
    KNOWN.write_text(json.dumps(made, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
