"""Hubs that differ, that are hostile, or that fail in the middle: the client's side of it."""

import gzip
import json
import os
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from huggingface_hub import constants

from hma_data import hub_bounds, remote_lock
from hma_data.errors import HubError
from hma_model import checkpoint, hub, hub_fetch, hub_hf, hub_partial, hub_swap
from hma_model.checkpoint import PARTS
from hma_model.hub_fetch import Wanted
from tests.hub_server import Hub, serve
from tests.hub_state import REPO, sha256
from tests.model.robots import make_model, save

pytest_plugins = ["tests.hub_fixtures"]
TOKEN = "secret-without-a-prefix"


@pytest.fixture
def token() -> str:
    return TOKEN


def kinds(server: Hub) -> list[str]:
    return [commit.message for commit in server.model(REPO).commits][1:]


# -- hubs that do it otherwise


@pytest.mark.parametrize(
    "habits",
    [
        {"lfs": "all", "page": 2, "weak": True}, {"lfs": "none", "tells_oids": False},
        {"redirects": False, "conflict": 409, "ranges": False}, {"siblings": False},
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


@pytest.mark.parametrize("status", [404, 200])
def test_a_hub_without_xet_gets_the_files_by_lfs(server, source, monkeypatch, status):
    monkeypatch.setattr(constants, "HF_HUB_DISABLE_XET", False)
    server.fail("GET .*/xet-write-token", status)
    hub.push(source, REPO)
    assert server.count("GET .*/xet-write-token") == 1 and len(kinds(server)) == 1


def test_a_failed_transfer_by_xet_goes_on_by_lfs(server, source, monkeypatch):
    from huggingface_hub import _commit_api

    def blocked(**asked):
        raise ConnectionError("Network error: blocked by the firewall")

    monkeypatch.setattr(constants, "HF_HUB_DISABLE_XET", False)
    monkeypatch.setattr(_commit_api, "_upload_xet_files", blocked)
    server.fail("GET .*/xet-write-token", 200, body=b'{"accessToken": "x"}')
    hub.push(source, REPO)
    assert len(kinds(server)) == 1
    assert checkpoint.load(hub.pull(REPO))


def test_a_file_that_a_gitignore_leaves_out_stops_the_push_before_its_commit(server, source):
    server.habits.ignored = ("*/stats.json",)
    with pytest.raises(HubError, match=r"leaves out embodiments/arm/stats\.json, by its \.gitignore"):
        hub.push(source, REPO)
    assert kinds(server) == []


@pytest.mark.parametrize("told", [True, False])
def test_a_commit_that_was_made_though_its_answer_was_lost_stays_alone(server, source, told):
    server.habits.tells_oids = told
    hub.push(source, REPO, ["arm"])
    repository = server.model(REPO)
    plain = repository.commit

    def commit(files, message="by hand"):
        plain(files, message)
        repository.commit = plain
        raise ConnectionResetError

    repository.commit = commit
    hub.push(source, REPO, ["hand"])
    assert kinds(server) == ["Add arm", "Add hand"]


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


def test_a_push_cut_at_any_request_is_ended_by_the_same_command(server, source):
    for at in range(200):
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
    assert 5 < at < 199


# -- downloads


def test_a_pull_cut_at_any_request_is_ended_by_the_same_command(published, source, tmp_path, monkeypatch):
    for at in range(200):
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
    assert 10 < at < 199


def test_an_address_that_is_no_longer_good_is_asked_for_again(published):
    published.fail("GET /cdn/.*trunk", after=500)
    published.fail("GET /cdn/.*trunk", 403)
    hub.pull(REPO, ["arm"])
    assert published.count("HEAD .*trunk") == 2


def test_a_file_of_the_cache_that_was_damaged_comes_again(published):
    folder = hub.pull(REPO, ["arm"])
    blob = (folder / "embodiments/arm/stem.safetensors").resolve()
    blob.write_bytes(blob.read_bytes()[:-1] + b"x")
    published.log.clear()
    hub.pull(REPO, ["arm"])
    assert list(published.sent()) == ["embodiments/arm/stem.safetensors"]


def test_a_file_that_grows_beyond_its_size_is_not_kept(published, tmp_path):
    trunk = published.model(REPO).files["trunk.safetensors"]
    published.objects[sha256(trunk)] = trunk + bytes(5_000_000)
    with pytest.raises(HubError, match=rf"more than the {len(trunk):,} bytes that were stated"):
        hub.pull(REPO, ["arm"])
    assert all(path.stat().st_size <= len(trunk) for path in tmp_path.rglob("*") if path.is_file())


def test_a_small_file_that_unpacks_to_a_large_one_is_not_kept(published, tmp_path):
    bomb = gzip.compress(bytes(20_000_000))
    published.fail("GET .*/resolve/.*/config.json", 200, headers={"Content-Encoding": "gzip"}, body=bomb)
    with pytest.raises(HubError, match="bytes that were stated"):
        hub.pull(REPO, ["arm"])
    assert all(path.stat().st_size < 1_000_000 for path in tmp_path.rglob("*") if path.is_file())


def test_what_is_answered_unlike_what_is_listed_is_refused(published):
    other = {"Content-Length": "0", "X-Linked-Size": "7", "X-Linked-ETag": f'"{"0" * 64}"'}
    published.fail("HEAD .*trunk", 200, headers=other)
    with pytest.raises(HubError, match=r"is listed with size \d+, and answered with 7"):
        hub.pull(REPO, ["arm"])


@pytest.mark.parametrize("tag", ['"../../../escaped"', '"/escaped"', 'W/"a/b"', '""'])
def test_a_hubs_tag_does_not_become_a_path(published, tmp_path, tag):
    size = len(published.model(REPO).files["embodiments/arm/stats.json"])
    facts = {"ETag": tag, "X-Linked-Size": str(size)}
    published.fail("HEAD .*stats.json", 200, headers=facts, times=9)
    hub.pull(REPO, ["arm"])
    assert not [path for path in tmp_path.parent.rglob("*escaped*") if tmp_path in path.parents]


@pytest.mark.parametrize("name", ["../x", "/x", "a/../../x", "C:\\x", "a\\..\\x", "a\0b", ""])
def test_a_name_that_leads_out_of_the_cache_is_refused(name):
    with pytest.raises(HubError, match="is not a name that can be stored"):
        hub_fetch.cached(Wanted(REPO, "model", name, "0" * 40))


def test_the_token_is_not_shown_to_another_port_of_the_same_host(published):
    with serve() as other:
        trunk = published.model(REPO).files["trunk.safetensors"]
        other.objects[sha256(trunk)] = trunk
        place = f"{other.url}/cdn/{sha256(trunk)}/trunk.safetensors"
        facts = {"Location": place, "X-Linked-Size": str(len(trunk)), "X-Linked-ETag": sha256(trunk)}
        published.fail("HEAD .*trunk", 302, headers=facts)
        hub.pull(REPO, ["arm"])
        assert other.log and not any(asked.authorized for asked in other.log)


def test_pulls_at_once_fetch_every_byte_once(published, source):
    published.fail("GET /cdn/.*trunk", after=500)
    faults: list[BaseException] = []

    def pull() -> None:
        try:
            hub.pull(REPO, ["arm"])
        except BaseException as fault:
            faults.append(fault)

    threads = [threading.Thread(target=pull, daemon=True) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(30)
    assert not faults and not any(thread.is_alive() for thread in threads)
    assert published.sent("trunk") == {"trunk.safetensors": (source / "trunk.safetensors").stat().st_size}


# -- answers


@pytest.mark.parametrize("sha", ["../../escaped", "..", "a/b", "main", ""])
def test_a_commit_of_a_strange_name_is_refused(published, sha):
    facts = {"id": REPO, "sha": sha, "private": False, "siblings": []}
    published.fail("GET /api/models", 200, body=json.dumps(facts).encode())
    with pytest.raises(HubError, match="names a commit"):
        hub.pull(REPO)


@pytest.mark.parametrize("entries", [0, 1])
def test_a_listing_that_leads_to_itself_ends(published, entries):
    file = {"type": "file", "path": "config.json", "size": 3, "oid": "0" * 40}
    link = {"Link": f'<{published.url}/api/models/{REPO}/tree/main>; rel="next"'}
    published.fail("GET .*/tree/", 200, headers=link, body=json.dumps([file] * entries).encode(), times=10**6)
    with pytest.raises(HubError, match=r"in circles|lists 'config\.json' twice"):
        hub.pull(REPO)
    assert published.count("GET .*/tree/") < 100


def test_a_listing_without_end_ends(published, monkeypatch):
    monkeypatch.setattr(hub_hf, "MOST_FILES", 3)
    with pytest.raises(HubError, match="has too many files"):
        hub.pull(REPO)


@pytest.mark.parametrize("packed", [True, False])
def test_a_long_answer_is_not_read_whole(published, monkeypatch, packed):
    monkeypatch.setattr(hub_bounds, "LONGEST_ANSWER", 100_000)
    body = b"[" + b" " * 1_000_000 + b"]"
    headers = {"Content-Encoding": "gzip"} if packed else {}
    published.fail("GET /api/models", 200, headers=headers, body=gzip.compress(body) if packed else body)
    with pytest.raises(HubError, match="answers with more than 100,000 bytes"):
        hub.pull(REPO)


def test_an_embodiment_that_is_not_whole_is_told_before_anything_is_fetched(published):
    published.model(REPO).commit({"embodiments/arm/head.safetensors": None})
    with pytest.raises(HubError, match=r"lacks head\.safetensors of embodiment 'arm'"):
        hub.pull(REPO)
    assert set(published.sent()) == {"config.json"}
    assert list(checkpoint.load(hub.pull(REPO, ["hand"])).embodiments) == ["hand"]


# -- folders


@pytest.fixture
def folder(tmp_path: Path, source: Path) -> Path:
    hub.push(source, tmp_path / "hub", ["arm"])
    return tmp_path / "hub"


def ended_process() -> int:
    with subprocess.Popen([sys.executable, "-c", ""]) as child:
        child.wait(30)
    return child.pid


def test_what_a_killed_push_staged_is_deleted_by_the_next(folder, source, monkeypatch):
    path = folder / "embodiments/arm/stem.safetensors"
    living, dead = hub_partial.beside(path), ended_process()
    with monkeypatch.context() as patched:
        patched.setattr(os, "getpid", lambda: dead)
        left = hub_partial.beside(path)
    elsewhere = path.with_name(".stem.safetensors.partial-00000000-1-0123456789ab")
    older = path.with_name(".stem.safetensors.partial-0123456789ab")
    strange = path.with_name("notes.partial-of-mine")
    for staged in (living, left, elsewhere, older, strange):
        staged.write_bytes(b"x")
    os.utime(older, (1, 1))
    hub.push(source, folder, ["hand"])
    assert [p.exists() for p in (living, left, elsewhere, older, strange)] == [True, False, True, False, True]


def test_what_a_killed_pull_left_is_deleted_by_the_next(folder, tmp_path, monkeypatch):
    dead, target = ended_process(), tmp_path / "out/trunk.safetensors"
    with monkeypatch.context() as patched:
        patched.setattr(os, "getpid", lambda: dead)
        left = hub_partial.beside(target)
    target.parent.mkdir()
    left.write_bytes(b"x")
    hub.pull(folder, ["arm"], tmp_path / "out")
    assert not left.exists()


def test_pushes_of_one_embodiment_at_once_leave_the_whole_of_one(folder, source, tmp_path):
    others = []
    for seed in range(3):
        model = checkpoint.load(source, [])
        model.add_embodiment(make_model({"arm": 2}, seed).embodiments["arm"])
        save(tmp_path / f"other{seed}", {"arm": 2}, model=model)
        others.append(tmp_path / f"other{seed}")
    with ThreadPoolExecutor(3) as pool:
        pushed = [pool.submit(hub.push, other, folder) for other in others]
        assert [future.result(60) for future in pushed] == [str(folder)] * 3
    assert list(checkpoint.load(folder).embodiments) == ["arm"]


@pytest.mark.parametrize("step", ["link", "exchange", "rmtree"])
def test_an_update_cut_at_any_step_leaves_the_old_or_the_new_embodiment(
    folder, source, tmp_path, monkeypatch, step
):
    (folder / "embodiments/arm/sample.png").write_bytes(b"a picture")
    model = checkpoint.load(source, [])
    model.add_embodiment(make_model({"arm": 2}, 7).embodiments["arm"])
    save(tmp_path / "newer", {"arm": 2}, model=model)
    before = (folder / "embodiments/arm/stem.safetensors").read_bytes()

    class Killed(BaseException):
        pass

    def cut(*arguments: object, **options: object) -> None:
        raise Killed

    with monkeypatch.context() as patched:
        if step != "exchange":
            patched.setattr(hub_swap.os if step == "link" else hub_swap.shutil, step, cut)
        else:
            patched.setattr(hub_swap, step, cut)
        with pytest.raises(Killed):
            hub.push(tmp_path / "newer", folder)
    kept = (folder / "embodiments/arm/stem.safetensors").read_bytes() == before
    assert kept == (step != "rmtree") and list(checkpoint.load(folder).embodiments) == ["arm"]
    hub.push(tmp_path / "newer", folder)
    assert (folder / "embodiments/arm/stem.safetensors").read_bytes() != before
    assert (folder / "embodiments/arm/sample.png").read_bytes() == b"a picture"


def test_an_update_keeps_what_else_is_in_an_embodiments_folder(folder, source):
    (folder / "embodiments/arm/notes").mkdir()
    (folder / "embodiments/arm/notes/mine.txt").write_text("kept")
    hub.push(source, folder)
    assert (folder / "embodiments/arm/notes/mine.txt").read_text() == "kept"


def test_where_folders_cannot_change_places_files_do(folder, source, monkeypatch):
    monkeypatch.setattr(hub_swap, "exchange", lambda first, second: False)
    hub.push(source, folder)
    assert sorted(checkpoint.load(folder).embodiments) == ["arm", "hand"]
    assert not [path for path in folder.rglob("*") if ".partial-" in path.name]


@pytest.mark.parametrize("address", ["s3://", "s3://bucket/hub", "nowhere://a/b"])
def test_a_store_that_refuses_is_one_line(source, address, monkeypatch, tmp_path):
    import s3fs

    monkeypatch.setattr(remote_lock, "SETTLE_S", 0.01)
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY", "AWS_PROFILE"):
        monkeypatch.delenv(name, raising=False)
    for name in ("AWS_CONFIG_FILE", "AWS_SHARED_CREDENTIALS_FILE"):
        monkeypatch.setenv(name, str(tmp_path / "none"))
    monkeypatch.setenv("AWS_EC2_METADATA_DISABLED", "true")
    s3fs.S3FileSystem.clear_instance_cache()
    for act in (lambda: hub.push(source, address), lambda: hub.list_embodiments(address)):
        with pytest.raises(HubError) as found:
            act()
        assert found.value.remedy and "\n" not in str(found.value)
    s3fs.S3FileSystem.clear_instance_cache()
