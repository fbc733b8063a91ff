"""A store that cannot be reached is given up on soon; one that was reached keeps all patience."""

import logging
import multiprocessing
import socket
from collections.abc import Iterator
from pathlib import Path

import fsspec
import pytest
import s3fs

from hma_data import reach, store
from hma_data.errors import StorageAwayError, StorageError
from hma_data.sources.base import open_source
from hma_data.store import place

KEYS = {"AWS_ACCESS_KEY_ID": "key", "AWS_SECRET_ACCESS_KEY": "secret", "AWS_DEFAULT_REGION": "us-east-1"}


class Asked:
    """What was tried: connections of ours, and requests of the driver."""

    def __init__(self) -> None:
        self.connections: list[tuple[str, int]] = []
        self.requests = 0


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> Iterator[Asked]:
    found, connect, call = Asked(), socket.create_connection, s3fs.S3FileSystem._call_s3

    def counted(address: tuple[str, int], timeout: float) -> socket.socket:
        found.connections.append(address)
        return connect(address, timeout=timeout)

    def request(self: object, *args: object, **options: object) -> object:
        found.requests += 1
        return call(self, *args, **options)

    for name, value in {**KEYS, "AWS_EC2_METADATA_DISABLED": "true", "AWS_MAX_ATTEMPTS": "1"}.items():
        monkeypatch.setenv(name, value)
    for name in ("http_proxy", "https_proxy", "all_proxy", "HTTP_PROXY", "HTTPS_PROXY", "ALL_PROXY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(reach.socket, "create_connection", counted)
    monkeypatch.setattr(s3fs.S3FileSystem, "_call_s3", request)
    monkeypatch.setattr(s3fs.S3FileSystem, "retries", 1)
    monkeypatch.setattr(reach, "WAITS_S", (0.0, 0.0))
    monkeypatch.setattr(reach, "_reached", set())
    monkeypatch.setattr(store, "WAITS_S", (0.0, 0.0, 0.0))
    s3fs.S3FileSystem.clear_instance_cache()
    yield found
    s3fs.S3FileSystem.clear_instance_cache()


@pytest.fixture
def closed() -> int:
    """A port of this machine that nobody listens at."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])


def test_a_store_at_a_closed_port_is_tried_three_times_and_nothing_is_asked_of_its_driver(
    asked: Asked, closed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{closed}")
    with pytest.raises(
        StorageAwayError, match=rf"s3://bucket/set: cannot be reached: 127.0.0.1:{closed}: .*ref"
    ):
        place("s3://bucket/set").exists()
    assert asked.connections == 3 * [("127.0.0.1", closed)] and asked.requests == 0


def test_a_recording_at_a_closed_port_is_tried_three_times(
    asked: Asked, closed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{closed}")
    with pytest.raises(StorageAwayError, match="AWS_ENDPOINT_URL"):
        open_source("rlds").index("s3://bucket/toy/1.0.0")
    assert len(asked.connections) == 3 and asked.requests == 0


def test_a_web_server_that_is_not_there_is_named(asked: Asked, closed: int) -> None:
    with pytest.raises(StorageAwayError, match="check the network, and the address$"):
        open_source("rlds").index(f"http://127.0.0.1:{closed}/toy/1.0.0")
    assert len(asked.connections) == 3


def test_a_name_that_is_of_no_host_is_told(asked: Asked, monkeypatch: pytest.MonkeyPatch) -> None:
    def unknown(*_: object, **__: object) -> None:
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setenv("AWS_ENDPOINT_URL", "https://store.invalid")
    monkeypatch.setattr(reach.socket, "getaddrinfo", unknown)
    with pytest.raises(StorageAwayError, match="store.invalid:443: Name or service not known"):
        place("s3://bucket/set").exists()
    assert not asked.requests


def test_a_store_that_was_reached_keeps_its_patience(
    asked: Asked, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{server.getsockname()[1]}")
        reach.reach(place("s3://bucket/set").files, "s3://bucket/set")  # type: ignore[attr-defined]
    with (
        caplog.at_level(logging.INFO, "hma_data.store"),
        pytest.raises(StorageAwayError, match="run the same"),
    ):
        place("s3://bucket/set").read_bytes()
    assert len(asked.connections) == 1 and caplog.text.count("trying again") == 3


def test_a_process_that_another_started_does_not_give_up_soon(
    asked: Asked, closed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{closed}")
    monkeypatch.setattr(multiprocessing, "parent_process", object)
    with pytest.raises(StorageAwayError, match="run the same command again"):
        place("s3://bucket/set").read_bytes()
    assert not asked.connections


def test_what_lies_behind_a_proxy_is_left_to_the_driver(
    asked: Asked, closed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("http_proxy", f"http://127.0.0.1:{closed}")
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://store.invalid")
    reach.reach(place("s3://bucket/set").files, "s3://bucket/set")  # type: ignore[attr-defined]
    assert not asked.connections


@pytest.mark.parametrize("url", ["localhost:9000", "http://[::1", "http://host:99999"])
def test_an_address_that_is_none_is_told_as_the_driver_does(
    url: str, asked: Asked, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("AWS_ENDPOINT_URL", url)
    with pytest.raises(StorageError, match="s3://bucket/set: cannot be read"):
        place("s3://bucket/set").exists()
    assert not asked.connections


def test_stores_without_an_address_are_used_as_they_are(tmp_path: Path) -> None:
    assert reach.address(fsspec.filesystem("memory"), "memory://set") == ""
    assert not place("memory://of-test-reach").exists()
