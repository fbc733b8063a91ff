"""LeRobotDatasets fetched from a Hub (a server on loopback): which files, which revision, without network."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from hma_data.errors import EpisodeError, SourceError
from hma_data.sources.base import open_source
from hma_data.sources.detect import detect
from tests.data.sources.lerobot.test_lerobot import embodiment
from tests.data.videos import CAMERA, STILL, actions_of, make_v2, make_v3, number_of
from tests.hub_server import Hub, connect, serve

LENGTHS = (7, 5, 6)


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    made = {name: tmp_path_factory.mktemp(name) for name in ("v2", "v3", "old")}
    make_v2(made["v2"], LENGTHS)
    make_v3(made["v3"], LENGTHS)
    make_v2(made["old"], LENGTHS[:2])
    return made


@pytest.fixture
def hub(tmp_path: Path, folders: dict[str, Path], monkeypatch: pytest.MonkeyPatch) -> Iterator[Hub]:
    with serve() as server:
        server.add_folder("team/two", "main", folders["v2"])
        server.add_folder("team/two", "v0.9", folders["old"])
        server.add_folder("team/three", "main", folders["v3"])
        connect(monkeypatch, server, tmp_path / "cache", None)
        yield server


def test_only_metadata_is_fetched_to_list_episodes(hub: Hub) -> None:
    for name in ("two", "three"):
        refs = open_source("lerobot").index(f"hf://datasets/team/{name}", embodiment())
        assert [ref.frames for ref in refs] == list(LENGTHS)
    assert hub.served() and all(path.startswith("meta/") for path in hub.served())


def test_an_episode_fetches_its_own_files_alone(hub: Hub) -> None:
    source = open_source("lerobot")
    source.index("team/two", embodiment())
    hub.log.clear()
    episode = source.read("team/two", "episode_000001", embodiment())
    shown = [number_of(frame) for frame in episode.streams["cam"].frames(range(5))]
    assert shown == [10, 11, 12, 13, 14]
    np.testing.assert_array_equal(episode.actions[0].values, actions_of(1, 5))
    assert sorted(hub.served()) == [
        "data/chunk-000/episode_000001.parquet",
        f"videos/chunk-000/{CAMERA}/episode_000001.mp4",
    ]


def test_a_camera_not_asked_for_is_not_fetched(hub: Hub) -> None:
    still = embodiment(cameras=[{"name": "still", "key": STILL}])
    episode = open_source("lerobot").read("team/three", "episode_000002", still)
    assert number_of(episode.streams["still"].frames([3])[0]) == 23
    assert not any(path.endswith(".mp4") for path in hub.served())


def test_a_second_worker_fetches_nothing_again(hub: Hub) -> None:
    uri = "hf://datasets/team/three"
    open_source("lerobot").read(uri, "episode_000000", embodiment()).streams["cam"].frames([0])
    hub.log.clear()
    open_source("lerobot").read(uri, "episode_000002", embodiment()).streams["cam"].frames([0])
    assert hub.served() == []


def test_a_revision_is_the_one_named(hub: Hub) -> None:
    index = open_source("lerobot").index
    assert len(index("hf://datasets/team/two@v0.9")) == 2 and len(index("team/two@main")) == 3
    assert index("team/two@v0.9")[0].fingerprint != index("team/two@main")[0].fingerprint
    commit = hub.repositories["datasets/team/two"].refs["v0.9"]
    assert index(f"team/two@{commit}") == index("team/two@v0.9")


def test_what_was_fetched_is_read_without_network(hub: Hub, monkeypatch: pytest.MonkeyPatch) -> None:
    from huggingface_hub import constants

    before = open_source("lerobot").index("team/two", embodiment())
    open_source("lerobot").read("team/two", "episode_000000", embodiment())
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    hub.repositories.clear()
    source = open_source("lerobot")
    assert source.index("team/two", embodiment()) == before
    assert source.read("team/two", "episode_000000", embodiment()).streams["cam"].frames([2]).shape[0] == 1
    with pytest.raises((EpisodeError, SourceError), match=r"episode_000001|cannot be fetched"):
        source.read("team/two", "episode_000001", embodiment())


@pytest.mark.parametrize("uri", ["hf://datasets/team/none", "team/none", "team/two@v7"])
def test_what_the_hub_does_not_have_is_one_line(hub: Hub, uri: str) -> None:
    with pytest.raises(SourceError, match="cannot be fetched from the Hub") as found:
        open_source("lerobot").index(uri)
    assert "\n" not in str(found.value) and uri in str(found.value)
    assert ("no such revision" if "@" in uri else "no such repository, or no access") in str(found.value)


def test_a_file_the_hub_lacks_is_one_refused_episode(hub, folders, tmp_path) -> None:
    import shutil

    copy = Path(shutil.copytree(folders["v2"], tmp_path / "copy"))
    (copy / f"videos/chunk-000/{CAMERA}/episode_000001.mp4").unlink()
    hub.add_folder("team/holes", "main", copy)
    source = open_source("lerobot")
    assert len(source.index("team/holes", embodiment())) == 3
    with pytest.raises(EpisodeError, match=r"episode_000001\.mp4: no such video"):
        source.read("team/holes", "episode_000001", embodiment())
    assert source.read("team/holes", "episode_000002", embodiment()).id == "episode_000002"


def test_a_name_on_the_hub_is_known_as_a_lerobot_dataset() -> None:
    for uri in ("hf://datasets/team/two", "hf://datasets/team/two@v0.9", "team/two", "team/two@v0.9"):
        assert detect(uri) == "lerobot"
    for uri in ("./team/two", "team/two.h5", "/team/two", "team/two/three", "tests/none"):
        with pytest.raises(SourceError, match="does not exist"):
            detect(uri)
