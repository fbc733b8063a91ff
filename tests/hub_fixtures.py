"""Fixtures of the tests that speak to a hub: `pytest_plugins = ["tests.hub_fixtures"]`.

`published` needs the model's `source`. A module may define `token` or `source` itself.
"""

from collections.abc import Iterator
from copy import deepcopy
from pathlib import Path

import pytest

from tests.hub_server import Hub, connect, serve
from tests.hub_state import REPO, TOKEN


@pytest.fixture
def token() -> str:
    return TOKEN


@pytest.fixture
def server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, token: str) -> Iterator[Hub]:
    """A hub without repositories, which this process's client speaks to."""
    from huggingface_hub.utils import close_session

    with serve() as made:
        made.tokens = {token: "write"}
        connect(monkeypatch, made, tmp_path / "cache", token)
        yield made
        close_session()


_pushed: dict[Path, tuple] = {}  # a checkpoint -> what a hub holds after its push; pushed once in a session


@pytest.fixture
def published(server: Hub, source: Path) -> Hub:
    from hma_model.hub import publish as hub

    if source not in _pushed:
        hub.push(source, REPO)
        _pushed[source] = deepcopy((server.repositories, server.objects))
    server.repositories, server.objects = deepcopy(_pushed[source])
    server.log.clear()
    return server
