"""Fixtures of the data tests: a converted toy recording, bags of every kind, a server of S3."""

import multiprocessing
import threading
from collections.abc import Iterator
from pathlib import Path

import fsspec
import pytest

from hma_data.registry.embodiment import Embodiment
from hma_data.storage import remote as store
from hma_data.storage.remote import RemotePath, place
from tests.conftest import ARM_YAML, contents, convert_toy
from tests.data.bag_files import KINDS, Recording, make_recording
from tests.data.s3 import KEYS, Proxy


@pytest.fixture(scope="session", autouse=True)
def preloaded() -> None:
    """Let processes of a fork server fork from one that has torch and the loader already."""
    multiprocessing.set_forkserver_preload(["hma_data.loading.dataset"])


@pytest.fixture(scope="session")
def recording() -> Recording:
    return make_recording()


@pytest.fixture(scope="session")
def bags(tmp_path_factory: pytest.TempPathFactory, recording: Recording) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("bags")
    made = {}
    for kind, write in KINDS.items():
        (folder / kind).mkdir()
        made[kind] = write(folder / kind, recording)
    return made


@pytest.fixture(scope="session")
def toy_set(toy_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("toy") / "set"
    convert_toy(Embodiment.from_yaml(ARM_YAML), toy_file, out)
    return out


@pytest.fixture(scope="session")
def whole(toy_set: Path) -> dict[str, bytes]:
    """The files of an undisturbed conversion of `toy_file`: what every disturbed one must end with."""
    return contents(toy_set)


@pytest.fixture(scope="session")
def s3_server() -> Iterator[int]:
    import moto.server

    running = moto.server.ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    running.start()
    yield running.get_host_and_port()[1]
    running.stop()


@pytest.fixture
def proxy(s3_server: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Proxy]:
    """A way to the server; every store made in the test goes through it, and nothing is kept after."""
    running = Proxy(s3_server)
    threading.Thread(target=running.serve_forever, daemon=True).start()
    for name, value in KEYS.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setenv("AWS_ENDPOINT_URL", running.url)
    monkeypatch.setenv("AWS_EC2_METADATA_DISABLED", "true")
    monkeypatch.setenv("HMA_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("AWS_MAX_ATTEMPTS", "1")
    monkeypatch.setattr(store, "WAITS_S", (0.0, 0.05, 0.1))
    files = fsspec.get_filesystem_class("s3")
    monkeypatch.setattr(files, "retries", 1)  # the driver's own tries take long
    files.clear_instance_cache()
    yield running
    running.trouble = lambda *asked: None
    files.clear_instance_cache()
    running.shutdown()
    running.server_close()


@pytest.fixture
def s3_out(proxy: Proxy, request: pytest.FixtureRequest) -> RemotePath:
    bucket = f"bucket-{abs(hash(request.node.name)) % 10**9}"
    path = place(f"s3://{bucket}/some/set")
    assert isinstance(path, RemotePath)
    path.files.mkdir(bucket)
    return path
