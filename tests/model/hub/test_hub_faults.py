"""Hubs that differ, that are hostile, or that fail in the middle: the client's side of it."""

import json
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from huggingface_hub import constants

from hma_data.errors import HubError
from hma_model.checkpoint import io as checkpoint
from hma_model.checkpoint.io import PARTS
from hma_model.hub import publish as hub
from hma_model.hub.listing import list_embodiments
from tests.hub_server import Hub
from tests.hub_state import EVERY, REPO, sha256

pytest_plugins = ["tests.hub_fixtures"]
TOKEN = "secret-without-a-prefix"


@pytest.fixture
def token() -> str:
    return TOKEN


def kinds(server: Hub) -> list[str]:
    return [commit.message for commit in server.model(REPO).commits][1:]


@pytest.mark.parametrize(
    "habits",
    [
        {"lfs": "all", "page": 2}, {"lfs": "none", "tells_oids": False},
        {"redirects": False, "conflict": 409, "ranges": False},
    ],
    ids=str,
)  # fmt: skip
def test_hubs_of_other_habits_are_pushed_to_and_pulled_from(server, source, habits):
    vars(server.habits).update(habits)
    hub.push(source, REPO, ["arm"])
    hub.push(source, REPO, ["hand"])
    assert kinds(server) == ["Add arm", "Add hand"]
    server.fail("GET .*trunk", after=500)
    folder = hub.pull(REPO, ["hand"])
    assert list(checkpoint.load(folder).embodiments) == ["hand"]
    parts = {f"embodiments/hand/{part}" for part in PARTS}
    assert {name for name in server.sent() if name.startswith("embodiments/")} <= parts | {
        "embodiments/arm/card.json"
    }


def test_a_card_in_a_folder_of_an_embodiment_is_not_that_embodiments(published, source):
    published.model(REPO).commit({f"{place}embodiments/foot/old/card.json": b"{}" for place in ("", "x/")})
    assert [row["embodiment"] for row in list_embodiments(REPO)] == ["arm", "hand"]
    hub.push(source, REPO)


def test_a_failed_transfer_by_xet_goes_on_by_lfs(server, source, monkeypatch):
    from huggingface_hub import _commit_api

    def blocked(**asked):
        raise ConnectionError("Network error: blocked by the firewall")

    monkeypatch.setattr(constants, "HF_HUB_DISABLE_XET", False)
    monkeypatch.setattr(_commit_api, "_upload_xet_files", blocked)
    hub.push(source, REPO)
    assert len(kinds(server)) == 1 and not constants.HF_HUB_DISABLE_XET
    monkeypatch.setattr(constants, "HF_HUB_DISABLE_XET", True)
    assert checkpoint.load(hub.pull(REPO))


def test_a_repository_that_is_missing_without_a_code_is_made(server, source):
    server.habits.codes = False
    hub.push(source, REPO)
    assert kinds(server) == ["Add arm, hand"]
    with pytest.raises(HubError, match=r"answered 404.*check the name"):
        hub.pull("team/none")


def test_what_a_hub_says_is_shown_but_never_the_token(server, source):
    said = json.dumps({"error": f"no room\nfor you, {TOKEN}"}).encode()
    server.fail("POST /api/repos/create", 400, body=said, times=9)
    with pytest.raises(HubError, match="answered 400: no room for you, …") as found:
        hub.push(source, REPO)
    chain, fault = [], found.value
    while fault is not None:
        chain.append(f"{fault!r} {fault}")
        fault = fault.__cause__ or fault.__context__
    assert len(chain) > 1 and not any(TOKEN in text for text in chain)


@pytest.mark.parametrize("step", EVERY)
def test_a_push_cut_at_any_request_is_ended_by_the_same_command(server, source, step):
    for at in range(0, 200, step):
        server.repositories.clear()
        server.objects.clear()
        hub.push(source, REPO, ["arm"])
        before = dict(server.model(REPO).files)
        server.gone_after = len(server.log) + at
        try:
            hub.push(source, REPO, ["hand"])
            break
        except HubError as fault:
            assert fault.remedy
        finally:
            server.gone_after = None
        after = server.model(REPO).files
        assert after == before or kinds(server) == ["Add arm", "Add hand"]
        hub.push(source, REPO, ["hand"])
        assert kinds(server) == ["Add arm", "Add hand"]
        assert server.model(REPO).files["embodiments/hand/card.json"]
    assert 5 < at < 200 - step


@pytest.mark.slow
@pytest.mark.parametrize("step", EVERY)
def test_a_pull_cut_at_any_request_is_ended_by_the_same_command(
    published, source, tmp_path, monkeypatch, step
):
    for at in range(0, 200, step):
        monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / f"cache{at}"))
        published.gone_after = len(published.log) + at
        try:
            hub.pull(REPO, ["arm"], tmp_path / f"out{at}")
            break
        except HubError as fault:
            assert fault.remedy
        finally:
            published.gone_after = None
        out = hub.pull(REPO, ["arm"], tmp_path / f"out{at}")
        for name in ("trunk.safetensors", *(f"embodiments/arm/{part}" for part in PARTS)):
            assert (out / name).read_bytes() == (source / name).read_bytes()
    assert 10 < at < 200 - step


@pytest.mark.parametrize("name", ["stem.safetensors", "stats.json"])
def test_a_file_of_the_cache_that_was_damaged_comes_again(published, name):
    damaged = damage(hub.pull(REPO, ["arm"]) / "embodiments/arm" / name)
    published.log.clear()
    hub.pull(REPO, ["arm"])
    assert list(published.sent()) == [f"embodiments/arm/{name}"] and not damaged()


def damage(path: Path) -> Callable[[], bool]:
    """Change a byte of a file of the cache; whether it is still changed."""
    whole = path.read_bytes()
    at = next(at for at in range(len(whole) - 1, -1, -1) if whole[at : at + 1].isdigit())
    path.resolve().write_bytes(whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :])
    return lambda: path.read_bytes() != whole


def test_a_file_that_grows_beyond_its_size_is_not_kept(published, tmp_path):
    trunk = published.model(REPO).files["trunk.safetensors"]
    published.objects[sha256(trunk)] = trunk + bytes(5_000_000)
    with pytest.raises(HubError, match="was not transferred completely"):
        hub.pull(REPO, ["arm"])
    assert all(path.stat().st_size <= len(trunk) for path in tmp_path.rglob("*") if path.is_file())


ARM = ("config.json", "trunk.safetensors", *(f"embodiments/arm/{part}" for part in PARTS))


def test_pulls_at_once_fetch_every_byte_once(published, source):
    published.fail("GET /cdn/.*trunk", stall=60.0, late=True)  # for the one, while the others come to it
    with ThreadPoolExecutor(3) as pool:
        pulls = [pool.submit(hub.pull, REPO, ["arm"]) for _ in range(3)]
        published.await_count("HEAD .*trunk", 3)
        published.stalled.set()
        folders = {pull.result(60) for pull in pulls}
    assert len(folders) == 1 and published.sent() == {name: (source / name).stat().st_size for name in ARM}


@pytest.mark.parametrize("sha", ["../../escaped", "..", "a/b", "main", ""])
def test_a_commit_of_a_strange_name_is_refused(published, sha):
    facts = {"id": REPO, "sha": sha, "private": False, "siblings": []}
    published.fail("GET /api/models", 200, body=json.dumps(facts).encode())
    with pytest.raises(HubError, match="names a commit"):
        hub.pull(REPO)


def test_an_embodiment_that_is_not_whole_is_told_before_anything_is_fetched(published):
    published.model(REPO).commit({"embodiments/arm/head.safetensors": None})
    with pytest.raises(HubError, match=r"lacks head\.safetensors of embodiment 'arm'"):
        hub.pull(REPO)
    assert set(published.sent()) == {"config.json"}
    assert list(checkpoint.load(hub.pull(REPO, ["hand"])).embodiments) == ["hand"]


@pytest.mark.parametrize("address", ["s3://", "s3://bucket/hub", "nowhere://a/b"])
def test_a_store_that_refuses_is_one_line(source, address, monkeypatch, tmp_path):
    import s3fs

    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY", "AWS_PROFILE"):
        monkeypatch.delenv(name, raising=False)
    for name in ("AWS_CONFIG_FILE", "AWS_SHARED_CREDENTIALS_FILE"):
        monkeypatch.setenv(name, str(tmp_path / "none"))
    monkeypatch.setenv("AWS_EC2_METADATA_DISABLED", "true")
    s3fs.S3FileSystem.clear_instance_cache()
    for act in (lambda: hub.push(source, address), lambda: list_embodiments(address)):
        with pytest.raises(HubError) as found:
            act()
        assert found.value.remedy and "\n" not in str(found.value)
    s3fs.S3FileSystem.clear_instance_cache()
