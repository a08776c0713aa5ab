"""Seconds from a key in the studio's page until the stage has drawn the new motion, in a headless Chromium.

`python tests/latency.py mdm_smpl_wide_fast --edits 20 --output latency.json`. The studio is the command that users
start; browser and studio share the machine, which should have no other work. An end is moved by 0.1 s, a text is typed
to its last key, or another text is entered with Enter, in turn. The page's own pauses are included.
"""

import argparse
import itertools
import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from statistics import median

from helpers import browser
from test_studio_page import SHIFT, press, ready

from stmc.evaluation.edit_profile import BASE
from stmc.viewing.studio.documents_json import as_data

TEXTS = ("raise the right arm", "punch with the right hand", "point at something", "wave with the right hand", "drink")
WATCH = """(() => {
  window.times = []; let pressed = 0, shown = null, arrived = false;
  const now = () => performance.now() / 1000;
  for (const kind of ['keydown', 'input']) addEventListener(kind, () => (pressed = now()), true);
  new MutationObserver(() => {
    if (document.body.dataset.shown !== shown) [shown, arrived] = [document.body.dataset.shown, true];
  }).observe(document.body, { attributeFilter: ['data-shown'] });
  new MutationObserver(() => {
    if (arrived) requestAnimationFrame(() => times.push(now() - pressed));
    arrived = false;
  }).observe(document.getElementById('stage'), { attributeFilter: ['data-pictures'], subtree: true });
})()"""
IDLE = "document.getElementById('progress').hidden && document.getElementById('stage').ariaBusy === 'false'"


@contextmanager
def studio(model: str, folder: Path) -> Iterator[str]:
    """The address of a studio of its own process."""
    command = [sys.executable, "-m", "stmc", "studio", f"model={model}", f"folder={folder}", "port=0", "open=false"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        yield next(word for line in process.stdout for word in line.split() if word.startswith("http://127.0.0.1"))
    finally:
        process.terminate()
        process.wait()


def begin(tab: browser.Tab) -> None:
    """Open the ten seconds of three prompts that are edited, and choose one of them."""
    content = f"state.documentOfTimeline({json.dumps(as_data(BASE) | {'name': 'latency'})})"
    made = tab.call(
        "Runtime.evaluate",
        expression=f"""Promise.all([import('/assets/state.js'), import('/assets/server.js')]).then(([state, server]) =>
            server.saveDocument('latency', 0, {{ document: {content} }})).then(() => (location.hash = 'latency'))""",
        awaitPromise=True,
    )
    assert "exceptionDetails" not in made, made
    tab.wait("document.querySelectorAll('.bar').length === 3 && document.body.dataset.shown")
    tab.wait(IDLE)
    tab.ask("[...document.querySelectorAll('.bar')].find((bar) => bar.textContent.includes('wave')).focus()")


def edits(tab: browser.Tab) -> Iterator[str]:
    """Make an edit at each turn, and tell its kind."""
    texts = itertools.cycle(TEXTS)
    while True:
        for back in (False, True):
            press(tab, "ArrowLeft" if back else "ArrowRight", SHIFT)
            yield "an end is moved"
        press(tab, "Enter")
        tab.wait("document.activeElement.matches('.bar input')")
        tab.call("Input.insertText", text=next(texts))
        yield "a text is typed"
        press(tab, "Escape")  # the motion of before comes back at once
        tab.wait("times.length")
        tab.ask("times.splice(0)")
        press(tab, "Enter")
        tab.wait("document.activeElement.matches('.bar input')")
        tab.call("Input.insertText", text=next(texts))
        press(tab, "Enter")
        yield "a text is entered"


def main() -> None:
    """Measure, and print the medians of each kind of edit."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("model")
    parser.add_argument("--edits", type=int, default=20)
    parser.add_argument("--output", type=Path)
    settings = parser.parse_args()
    measured: dict[str, list[list[float]]] = {}
    with (
        tempfile.TemporaryDirectory() as scratch,
        studio(settings.model, Path(scratch, "studio")) as address,
        browser.tab(Path(scratch, "profile"), 1280, 800) as tab,
    ):
        tab.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-reduced-motion", "value": "reduce"}])
        tab.open(address)
        ready(tab)
        begin(tab)
        tab.ask(WATCH)
        for kind in itertools.islice(edits(tab), settings.edits):
            tab.wait("times.length")
            tab.wait(IDLE)
            measured.setdefault(kind, []).append(tab.ask("times.splice(0)"))
    for kind, times in measured.items():
        first, last = (median(each[place] for each in times) for place in (0, -1))
        print(f"{kind}: {first:.2f} s to the first picture, {last:.2f} s to the motion (median of {len(times)})")
    if settings.output:
        settings.output.write_text(json.dumps(measured))


if __name__ == "__main__":
    main()
