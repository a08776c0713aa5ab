"""Sample a timeline with a running `stmc studio`, and save the motion. Needs nothing but Python.

python client.py "walk forwards # 0 # 4" walk.glb
python client.py timeline.txt walk.npz --seed 3 --preview

A timeline has a prompt a line, `text # start # end # body part`, in seconds; the suffix of the second file is its
format. The studio documents all requests at http://127.0.0.1:8686/api.
"""

import argparse
import json
import sys
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

ADDRESS = "http://127.0.0.1:8686"
TOKEN_FILE = Path("~/.stmc/studio/api_token")
SILENCE = 600
"""Seconds without a word from the studio after which it counts as gone; other jobs may run first."""


class StudioError(Exception):
    """A request that the studio refused, or that it did not answer; the message says why."""


class Studio:
    """A running studio.

    Args:
        address: Address of the studio, on this machine.
        token: Its token; None: that of a studio in the default folder.
    """

    def __init__(self, address: str = ADDRESS, token: str | None = None) -> None:
        if urlsplit(address).hostname not in ("127.0.0.1", "localhost", "::1"):
            raise StudioError(f"{address} is not an address of this machine: the token is not sent elsewhere")
        self.address, self.token = address.rstrip("/"), token or read_token(TOKEN_FILE)
        self.opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))  # no proxy gets the token

    def check(self, timeline: str) -> dict:
        """Return what the studio says of a timeline: its body parts, advice and warnings."""
        return self._json("POST", "/api/check", {"timeline": timeline})

    def sample(self, timeline: str, seed: int = 0, preview: bool = False, **settings: object) -> Iterator[tuple]:
        """Sample a timeline and yield the events of the job: their names and their data.

        The last motion of the events is the result. A job whose events are read no further is cancelled.

        Args:
            timeline: Text of the timeline.
            seed: Seed of the motion.
            preview: Whether to sample the preview alone, in few steps.
            **settings: Further settings of a job, such as `constraints`.
        """
        steps = "preview" if preview else "full"
        job = self._json("POST", "/api/jobs", {"timeline": timeline, "seeds": [seed], "steps": steps, **settings})[
            "job"
        ]
        event = ""
        try:
            with self._open("GET", f"/api/jobs/{job}/events") as stream:
                for event, data in events(stream):
                    yield event, data
        finally:
            if event not in ("done", "failed", "cancelled"):
                self._json("DELETE", f"/api/jobs/{job}")
        if event == "failed":
            raise StudioError(data["error"])

    def download(self, motion: str, path: Path) -> None:
        """Save a motion in the format of the file's suffix."""
        with self._open("GET", f"/api/motions/{motion}{path.suffix.lower()}") as answer:
            content = answer.read()
        path.write_bytes(content)

    def _json(self, method: str, path: str, data: object = None) -> dict:
        with self._open(method, path, None if data is None else json.dumps(data).encode()) as answer:
            return json.load(answer)

    def _open(self, method: str, path: str, body: bytes | None = None):
        headers = {"Authorization": f"Bearer {self.token}", "Content-Type": "application/json"}
        request = urllib.request.Request(self.address + path, body, headers, method=method)
        try:
            return self.opener.open(request, timeout=SILENCE)
        except urllib.error.HTTPError as error:
            raise StudioError(sentence_of(error)) from None
        except urllib.error.URLError as error:
            raise StudioError(f"no studio answers at {self.address} ({error.reason}): start `stmc studio`") from None


def read_token(path: Path) -> str:
    """Return the token in a file of the studio's folder."""
    try:
        return path.expanduser().read_text().strip()
    except OSError as error:
        raise StudioError(f"{path}: {error.strerror}; `stmc studio` prints where its token is") from None


def sentence_of(error: urllib.error.HTTPError) -> str:
    """Return the sentence of a refusal."""
    try:
        return json.load(error)["error"]
    except (ValueError, KeyError, TypeError):
        return f"the server answered {error.code}: is it a studio?"


def events(stream) -> Iterator[tuple[str, dict]]:
    """Yield server-sent events: `event: NAME`, `data: JSON`, an empty line."""
    name = ""
    for line in stream:
        key, _, value = line.decode().rstrip("\n").partition(": ")
        if key == "event":
            name = value
        elif key == "data":
            yield name, json.loads(value)


def show(checked: dict) -> None:
    """Print what the studio says of a timeline."""
    for number, prompt in enumerate(checked["prompts"], start=1):
        print(f"prompt {number}: {', '.join(prompt['parts'])}{' (suggested)' if prompt['suggested'] else ''}")
        if prompt["advice"]:
            print(f"  {prompt['advice']['sentence']}")
    for warning in checked["warnings"]:
        print(f"warning: {warning}")


def run(arguments: argparse.Namespace) -> None:
    """Check, sample, wait and save."""
    studio = Studio(arguments.address, arguments.token_file and read_token(arguments.token_file))
    given = Path(arguments.timeline)
    timeline = given.read_text("utf-8") if given.suffix == ".txt" and given.is_file() else arguments.timeline
    show(studio.check(timeline))
    motion = None
    for event, data in studio.sample(timeline, arguments.seed, arguments.preview):
        if event == "progress":
            print(f"{data['stage']}: step {data['step']} of {data['steps']}" if data["steps"] else data["stage"])
        elif event == "motion":
            motion = data["motion"]
    if motion is None:
        raise StudioError("the job was cancelled")
    studio.download(motion["id"], arguments.file)
    print(f"{arguments.file}: {motion['frames']} frames at {motion['fps']:g} fps")


def main() -> int:
    """Run the command line; return its exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("timeline", help="a timeline, or a .txt file of one")
    parser.add_argument("file", type=Path, help="file to save: .glb, .npz, .bvh, …")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--preview", action="store_true", help="few steps: seconds instead of a minute")
    parser.add_argument("--address", default=ADDRESS)
    parser.add_argument("--token-file", type=Path, help=f"by default {TOKEN_FILE}")
    try:
        run(parser.parse_args())
    except (StudioError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("cancelled", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
