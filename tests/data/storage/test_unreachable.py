"""A store or server that cannot be reached is one clear error, soon: nothing but our own few tries."""

import socket
from collections.abc import Iterator

import fsspec
import pytest
import s3fs

from hma_data.errors import SourceError, StorageAwayError, StorageError
from hma_data.sources.base import open_source
from hma_data.sources.common.places import existing_path
from hma_data.storage import remote as store
from hma_data.storage.fetch import CONNECT_S, file_system
from hma_data.storage.remote import place

KEYS = {"AWS_ACCESS_KEY_ID": "key", "AWS_SECRET_ACCESS_KEY": "secret", "AWS_DEFAULT_REGION": "us-east-1"}


@pytest.fixture(autouse=True)
def requests(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    asked, call = [], s3fs.S3FileSystem._call_s3

    def request(self: object, method: str, *args: object, **options: object) -> object:
        asked.append(method)
        return call(self, method, *args, **options)

    for name, value in {**KEYS, "AWS_EC2_METADATA_DISABLED": "true"}.items():
        monkeypatch.setenv(name, value)
    for name in ("http_proxy", "https_proxy", "all_proxy", "HTTP_PROXY", "HTTPS_PROXY", "ALL_PROXY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(s3fs.S3FileSystem, "_call_s3", request)
    monkeypatch.setattr(store, "WAITS_S", (0.0, 0.0, 0.0))
    s3fs.S3FileSystem.clear_instance_cache()
    yield asked
    s3fs.S3FileSystem.clear_instance_cache()


@pytest.fixture
def closed() -> str:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return f"http://127.0.0.1:{server.getsockname()[1]}"


def test_the_driver_of_s3_tries_once_and_waits_for_seconds() -> None:
    config = place("s3://bucket/set").files.s3.meta.config  # type: ignore[attr-defined]
    assert config.connect_timeout == CONNECT_S and config.retries["total_max_attempts"] == 1


def test_what_the_user_configures_for_the_driver_wins(monkeypatch: pytest.MonkeyPatch) -> None:
    own = {"config_kwargs": {"connect_timeout": 77, "signature_version": "s3v4"}}
    monkeypatch.setitem(fsspec.config.conf, "s3", own)
    files, _ = file_system("s3://bucket/set")
    assert files.config_kwargs["connect_timeout"] == 77
    assert files.config_kwargs["signature_version"] == "s3v4"


def test_a_web_server_is_waited_for_for_seconds() -> None:
    files, _ = file_system("http://127.0.0.1:9/x")
    assert files.client_kwargs["timeout"].sock_connect == CONNECT_S


def test_a_recording_on_a_silent_web_server_may_exist() -> None:
    with pytest.raises(SourceError, match="does not exist, or its server does not answer — check the URI"):
        existing_path("http://127.0.0.1:9/run.mcap")


def test_a_store_at_a_closed_port_is_tried_four_times(closed, requests, monkeypatch) -> None:
    monkeypatch.setenv("AWS_ENDPOINT_URL", closed)
    said = rf"s3://bucket/set: cannot be read: .*{closed}.* — check the network, and the address .AWS_"
    with pytest.raises(StorageAwayError, match=said):
        place("s3://bucket/set").read_bytes()
    assert len(requests) == 4


def test_a_web_server_that_is_not_there_is_one_error(closed: str) -> None:
    with pytest.raises(StorageAwayError, match=f"{closed}/toy.*check the network, and the address"):
        open_source("rlds").index(f"{closed}/toy/1.0.0")


@pytest.mark.parametrize("url", ["localhost:9000", "http://[::1", "http://host:99999"])
def test_an_address_that_is_none_is_one_error(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AWS_ENDPOINT_URL", url)
    with pytest.raises(StorageError, match="s3://bucket/set: cannot be read"):
        place("s3://bucket/set").exists()
