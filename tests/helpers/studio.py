"""A studio with a tiny model, in this process, and somebody who was let in."""

import dataclasses
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from helpers.tiny_model import Hashes, tiny
from starlette.testclient import TestClient

import stmc
from stmc.run import VOCABULARY, bundled
from stmc.text.vocabulary import read_vocabulary
from stmc.viewing.studio import Sessions, application

PORT = 8686
ADDRESS = f"http://127.0.0.1:{PORT}"
WALK = {"name": "A walk", "prompts": [{"text": "walk", "start": 0, "end": 2, "parts": ["legs"]}]}


def knowing() -> stmc.Model:
    """The tiny model with the bundled model's vocabulary."""
    return dataclasses.replace(tiny(), vocabulary=read_vocabulary(bundled() / VOCABULARY), text_encoder=Hashes())


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
