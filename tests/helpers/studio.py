"""A studio with a tiny model, in this process, and somebody who was let in."""

import dataclasses
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from helpers.scripts import loaded
from helpers.tiny_model import Hashes, tiny
from starlette.testclient import TestClient

import stmc
from stmc.io.files import write_whole
from stmc.run import VOCABULARY, bundled
from stmc.text.vocabulary import read_vocabulary
from stmc.viewing.studio import Sessions, application, connections, program_token

PORT = 8686
ADDRESS = f"http://127.0.0.1:{PORT}"
WALK = {"name": "A walk", "prompts": [{"text": "walk", "start": 0, "end": 2, "parts": ["legs"]}]}


def knowing() -> stmc.Model:
    """The tiny model with the bundled model's vocabulary."""
    return dataclasses.replace(tiny(), vocabulary=read_vocabulary(bundled() / VOCABULARY), text_encoder=Hashes())


def draw_nothing(motion: stmc.Motion, path: Path, timeline: stmc.Timeline | None, progress) -> None:
    """In place of `stmc.render_film`: counts the pictures, and writes a file without any."""
    pictures = progress(range(motion.frames), total=motion.frames)
    write_whole(path, lambda temporary: temporary.write_bytes(b"film" if list(pictures) else b""))


def entered(client: TestClient, token: str):
    """The answer to whoever opens the page with a token."""
    return client.post("/api/session", json={"token": token})


def bearer(key: str | bytes) -> dict[str, bytes]:
    """The header of somebody with a key."""
    return {"Authorization": b"Bearer " + (key if isinstance(key, bytes) else key.encode())}


@contextmanager
def studio(model: stmc.Model, folder: Path) -> Iterator[TestClient]:
    """A client with a key, whose server's own errors are answers."""
    sessions = Sessions()
    app = application(model, folder, sessions, PORT, steps=4)
    with TestClient(app, base_url=ADDRESS, raise_server_exceptions=False) as client:
        client.headers.update(bearer(entered(client, sessions.invite()).json()["key"]))
        yield client


@dataclass
class Served:
    """A studio that programs reach."""

    address: str
    folder: Path
    before: set[str] = field(default_factory=set)
    """Names of the motions that were there when `remember` was called."""

    @property
    def token_file(self) -> Path:
        return self.folder / "api_token"

    @property
    def motions(self) -> Path:
        return self.folder / "motions"

    def remember(self) -> None:
        self.before = {path.stem for path in self.motions.glob("*.npz")}

    def new_motion(self) -> stmc.Motion:
        """The one motion that was made since `remember` was called."""
        [path] = [path for path in self.motions.glob("*.npz") if path.stem not in self.before]
        return stmc.read(path)


@contextmanager
def served(folder: Path, model: stmc.Model | None = None) -> Iterator[Served]:
    """A studio on a port of its own, in a thread."""
    sessions = Sessions()
    sessions.allow(program_token(folder))
    with loaded("studio").listen(0) as listening:
        port = listening.getsockname()[1]
        server = connections.server_of(application(model or knowing(), folder, sessions, port, steps=4))
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]})
        thread.start()
        try:
            while not server.started:
                assert thread.is_alive()
                time.sleep(0.02)
            yield Served(f"http://127.0.0.1:{port}", folder)
        finally:
            server.should_exit = True
            thread.join(timeout=60)
