"""Repositories of the hub: its real client and a server on loopback. Commits, faults, cache, tokens."""

import errno
import json
import os
import resource
import subprocess
import sys

import pytest
import torch
from huggingface_hub import constants

from hma_data.errors import HubError
from hma_data.hub import errors as hub_errors
from hma_model.checkpoint import io as checkpoint
from hma_model.checkpoint.io import PARTS
from hma_model.hub import publish as hub
from hma_model.hub.listing import list_embodiments, survey
from hma_model.network.model import HMA
from tests.command import ROOT
from tests.conftest import contents
from tests.hub_state import REPO, ROBOTS, TOKEN
from tests.model.robots import edit_card, save

pytest_plugins = ["tests.hub_fixtures"]


def test_one_embodiment_is_one_commit_that_touches_its_folder_and_the_card_only(server, source):
    assert hub.push(source, f"hf://{REPO}", ["arm"]) == f"{server.url}/{REPO}"
    first = server.model(REPO).files
    hub.push(source, REPO, ["hand"])
    commits = server.model(REPO).commits
    assert [commit.message for commit in commits] == ["initial commit", "Add arm", "Add hand"]
    changed = {name for name, content in commits[-1].files.items() if first.get(name) != content}
    assert changed == {"README.md", *(f"embodiments/hand/{part}" for part in PARTS)}
    assert set(first) <= set(commits[-1].files)


def test_two_pushes_at_once_both_land(server, source):
    hub.push(source, REPO, [])
    server.before_commit = [lambda: hub.push(source, REPO, ["hand"])]
    hub.push(source, REPO, ["arm"])
    assert server.count("POST .*/commit/") == 4  # trunk, hand, arm refused, arm again
    page = server.model(REPO).files["README.md"].decode()
    assert "| `arm` |" in page and "| `hand` |" in page
    assert [row["embodiment"] for row in list_embodiments(REPO)] == ["arm", "hand"]


def test_two_first_pushes_of_different_trunks_leave_one(server, source, tmp_path):
    save(tmp_path / "other", ROBOTS, seed=1)
    server.before_commit = [lambda: hub.push(tmp_path / "other", REPO)]
    with pytest.raises(HubError, match=r"has another trunk.*push to another address, or finetune"):
        hub.push(source, REPO)
    there = server.model(REPO).files["trunk.safetensors"]
    assert there == (tmp_path / "other/trunk.safetensors").read_bytes()


def test_endless_conflicts_end(server, source):
    server.create(REPO)
    server.fail("POST .*/commit/", 412, times=99)
    with pytest.raises(HubError, match="others committed first 8 times"):
        hub.push(source, REPO)


@pytest.mark.parametrize("told", [True, False])
def test_pushing_the_same_again_makes_no_commit_though_no_oid_is_told(published, source, told):
    published.habits.tells_oids = told
    before = len(published.model(REPO).commits)
    hub.push(source, REPO)
    assert len(published.model(REPO).commits) == before
    assert published.count("PUT ") == published.count("POST .*/commit/") == 0


def test_a_licence_that_the_hub_refuses_is_told_before_anything_is_sent(server, folder):
    edit_card(folder, "arm", license="cc-by-2.5")  # which this hub does not know
    with pytest.raises(HubError, match=r"refuses the card: .*must be one of.*\"license\" in the card\.json"):
        hub.push(folder, REPO, ["arm"])
    assert server.count("PUT ") == server.count("POST .*/commit/") == 0
    hub.push(folder, REPO, ["hand"])


@pytest.mark.parametrize(
    "fault", [{"status": 503}, {"status": 429, "headers": {"Retry-After": "7"}}, {"after": 10}],
    ids=["503", "429", "cut"],
)  # fmt: skip
def test_a_passing_fault_does_not_stop_a_push(server, source, fault):
    server.create(REPO)
    for request in ("PUT /lfs/upload/", "POST .*/commit/", "GET /api/models", "POST .*preupload"):
        server.fail(request, **fault)
    hub.push(source, REPO, ["arm"])
    assert len(server.model(REPO).commits) == 2 and not any(fault.times for fault in server.faults)
    if fault.get("status") == 429:
        assert max(server.waits) >= 7


@pytest.mark.parametrize("request_", ["POST .*/commit/", "POST /api/repos/create"])
def test_a_hub_that_never_answers_is_given_up(server, source, monkeypatch, request_):
    monkeypatch.setattr("hma_data.hub.repository.SILENCE_S", 0.2)
    server.fail(request_, stall=20.0, times=99)
    with pytest.raises(HubError, match=r"out of reach: ReadTimeout.*check the network"):
        hub.push(source, REPO)
    server.stalled.set()


def test_a_new_repository_can_be_private(server, source):
    hub.push(source, REPO, private=True)
    assert server.model(REPO).private


def test_one_embodiment_brings_config_trunk_and_its_own_files_byte_for_byte(published, source):
    model = HMA.from_pretrained(REPO, embodiments=["arm"])
    assert list(model.embodiments) == ["arm"]
    wanted = ["config.json", "trunk.safetensors", *(f"embodiments/arm/{part}" for part in PARTS)]
    assert published.sent() == {name: (source / name).stat().st_size for name in wanted}


def test_what_is_in_the_cache_is_not_sent_again(published):
    hub.pull(REPO, ["arm"])
    published.log.clear()
    hub.pull(REPO, ["arm"])
    assert published.sent() == {}
    hub.pull(REPO, ["hand"])
    assert set(published.sent()) == {f"embodiments/hand/{part}" for part in PARTS}


def test_a_revision_is_the_one_named(published, source, tmp_path):
    repository = published.model(REPO)
    repository.refs["v1"] = repository.commits[-1].id
    save(tmp_path / "other", {"leg": 4}, seed=3)
    repository.commit(contents(tmp_path / "other"))
    theirs = checkpoint.load(source, ["arm"]).state_dict()
    commit = repository.refs["v1"]
    for address, revision in (
        *((REPO, named) for named in ("v1", commit)),
        *((f"{REPO}@{named}", None) for named in ("v1", commit)),
        (f"hf://{REPO}@v1", None),
    ):
        model = HMA.from_pretrained(address, embodiments=["arm"], revision=revision)
        assert all(torch.equal(value, theirs[name]) for name, value in model.state_dict().items())
        assert len(list_embodiments(address, revision)) == len(ROBOTS)
    assert len(list_embodiments(REPO)) == len(ROBOTS) + 1


def test_pulling_into_a_folder_gives_files_of_its_own(published, tmp_path):
    out = hub.pull(REPO, out=tmp_path / "out", revision="main")
    assert set(checkpoint.load(out).embodiments) == set(ROBOTS)
    assert not [path for path in out.rglob("*") if path.is_symlink()]


def test_the_token_is_not_shown_to_the_host_of_the_files(published):
    hub.pull(REPO, ["arm"])
    asked = [asked for asked in published.log if asked.path.startswith("/cdn/")]
    assert asked and not any(asked.authorized for asked in asked)
    assert all(asked.host.startswith("localhost") for asked in asked)


def test_a_pull_that_was_cut_for_good_brings_only_what_is_missing(published, source):
    published.fail("GET /cdn/.*trunk", after=1000, times=99)
    with pytest.raises(HubError, match=r"connection was cut.*run the same command again"):
        hub.pull(REPO, ["arm"])
    published.faults.clear()
    published.log.clear()
    hub.pull(REPO, ["arm"])
    assert published.sent("config|trunk") == {
        "trunk.safetensors": (source / "trunk.safetensors").stat().st_size
    }


def test_a_download_with_other_content_than_stated_is_thrown_away(published, monkeypatch, tmp_path):
    trunk = published.model(REPO).files["trunk.safetensors"]
    name = next(name for name, content in published.objects.items() if content == trunk)
    published.objects[name] = bytes(len(trunk))
    with pytest.raises(HubError, match="differs from the content that the hub stated"):
        hub.pull(REPO, ["arm"])
    assert not list((tmp_path / "cache").rglob("*incomplete"))


@pytest.mark.parametrize("fault", [{"status": 503}, {"status": 429, "headers": {"Retry-After": "3"}}])
def test_a_passing_fault_does_not_stop_a_pull(published, fault):
    for request in ("GET /api/models", "GET /cdn/", "GET .*/resolve/", "HEAD .*/resolve/", "GET .*/tree/"):
        published.fail(request, **fault)
    assert list(HMA.from_pretrained(REPO, embodiments=["arm"]).embodiments) == ["arm"]


def test_what_was_pulled_is_there_offline(published, monkeypatch):
    hub.pull(REPO, ["arm"])
    published.log.clear()
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    assert list(HMA.from_pretrained(REPO, embodiments=["arm"]).embodiments) == ["arm"]
    assert published.log == []


def test_what_was_never_pulled_is_not_there_offline(published, monkeypatch):
    hub.pull(REPO, ["arm"])
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    with pytest.raises(HubError, match="no embodiment 'hand'"):
        hub.pull(REPO, ["hand"])
    with pytest.raises(HubError, match=r"out of reach, and not in the cache.*go online"):
        hub.pull("team/other")


def test_what_was_only_listed_is_not_there_offline(published, monkeypatch):
    list_embodiments(REPO)
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    said = r"is out of reach, and trunk\.safetensors is not in the cache — go online and pull again"
    for act in (hub.pull, HMA.from_pretrained):
        with pytest.raises(HubError, match=said):
            act(REPO, ["arm"])
    with pytest.raises(HubError, match="is out of reach — go online and list again"):
        survey(REPO)


def test_a_full_disk_says_so_and_the_pull_goes_on_later(published, tmp_path, monkeypatch):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2000, hard))
    try:
        with pytest.raises(HubError, match=rf"{os.strerror(errno.EFBIG)}.*free space"):
            hub.pull(REPO, ["arm"])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert checkpoint.load(hub.pull(REPO, ["arm"]), ["arm"])


def test_without_a_token_nothing_is_pushed(server, source, monkeypatch):
    monkeypatch.delenv("HF_TOKEN")
    with pytest.raises(HubError, match=r"needs a token.*hf auth login|HF_TOKEN"):
        hub.push(source, REPO)
    assert server.log == []


REFUSALS = {  # what the hub answers, or which address is asked for, and what the error says
    "a wrong token": ({"status": 401}, REPO, r"answered 401|token is not valid.*hf auth login"),
    "no repository": ({}, "team/none", r"^team/none: is not a local folder; .* no such repository.*check"),
    "no revision": ({}, f"{REPO}@v9", r"no such revision.*branch, tag or commit"),
    "a gated one": (
        {"status": 403, "headers": {"X-Error-Code": "GatedRepo"}}, REPO, r"is gated.*ask for access on",
    ),
    "a wait of a day": (
        {"status": 429, "headers": {"Retry-After": "86400"}}, REPO, r"answered 429.*too many requests",
    ),
    "no hub": ({"status": 200}, REPO, r"does not answer like a hub|has no config"),
}  # fmt: skip


@pytest.mark.parametrize("refusal", REFUSALS)
def test_a_hub_that_refuses_to_be_read_says_why(published, refusal):
    fault, address, said = REFUSALS[refusal]
    if fault:
        published.fail("GET /api/models", times=99, **fault)
    with pytest.raises(HubError, match=said):
        hub.pull(address)
    assert max(published.waits, default=0) < 300


def test_a_private_repository_and_a_wrong_token_are_called_so(published, source, monkeypatch):
    published.model(REPO).private = True
    monkeypatch.delenv("HF_TOKEN")
    with pytest.raises(HubError, match=r"no such repository.*log in"):
        hub.pull(REPO)
    monkeypatch.setenv("HF_TOKEN", "hf_wrong")
    for act in (lambda: hub.push(source, REPO), lambda: hub.pull(REPO)):
        with pytest.raises(HubError, match=r"token is not valid.*hf auth login"):
            act()


def test_a_token_without_write_access_is_called_so(published, source):
    published.tokens[TOKEN] = "read"
    published.model(REPO).commit({"embodiments/arm/card.json": None})
    for repository in (REPO, "team/another"):
        with pytest.raises(HubError, match="may not write here"):
            hub.push(source, repository, ["arm"])


@pytest.mark.parametrize(
    ("files", "message"),
    [
        ({}, r"has no config\.json"),
        ({"config.json": b'{"model_type": "bert"}'}, "is not of hma-toolkit"),
        ({"config.json": b"[1]"}, "must hold a JSON object"),
        ({"config.json": b"<html>"}, "is not valid JSON"),
        ({"config.json": b" " * 16_000_001}, r"config\.json: is larger than 16,000,000 bytes"),
    ],
)
def test_a_repository_of_another_library_is_called_so(server, source, files, message):
    server.create(REPO).commit(files)
    before = server.model(REPO).files
    with pytest.raises(HubError, match=message):
        hub.pull(REPO)
    with pytest.raises(HubError, match=r"has no config\.json of a checkpoint"):
        list_embodiments(REPO)
    if files:
        with pytest.raises(HubError, match=message):
            hub.push(source, REPO)
        assert server.model(REPO).files == before


@pytest.mark.parametrize(
    "name",
    [
        "embodiments/../../escaped/card.json",
        "embodiments/arm/../../../x",
        "/etc/hma",
        "embodiments/..evil/card.json",
    ],
)
def test_names_that_lead_elsewhere_are_left_there(published, tmp_path, name):
    published.model(REPO).commit({name: b"{}", "embodiments/arm/weights.pkl": b"cos\nsystem\n(S'true'\ntR."})
    hub.pull(REPO, out=tmp_path / "out")
    assert [row["embodiment"] for row in list_embodiments(REPO)] == ["arm", "hand"]
    assert all(path.name != "x" and "escaped" not in str(path) for path in tmp_path.rglob("*"))
    assert not list(tmp_path.rglob("*.pkl"))


@pytest.mark.slow
def test_the_command_never_shows_or_stores_the_token(server, source, tmp_path):
    environment = {
        "HF_ENDPOINT": server.url, "HF_TOKEN": TOKEN, "HF_HOME": str(tmp_path / "home"),
        "HF_HUB_DISABLE_XET": "1",
    }  # fmt: skip
    out = ["--out", str(tmp_path / "pulled")]
    calls = [
        ["push", str(source), REPO], ["list", REPO, "--json"], ["pull", REPO, "-e", "arm", *out],
        ["--debug", "pull", REPO, "-e", "hand"],
    ]  # fmt: skip
    shown = []
    for call in calls:
        if "--debug" in call:
            server.tokens.clear()
        done = subprocess.run(
            [sys.executable, "-m", "hma_model.cli", "hub", *call], env={**os.environ, **environment},
            capture_output=True, text=True, cwd=ROOT, check=False,
        )  # fmt: skip
        shown.append(done.stdout + done.stderr)
        assert TOKEN not in shown[-1]
        assert done.returncode == (0 if len(shown) <= 3 else 1), shown[-1]
    assert [row["embodiment"] for row in json.loads(shown[1])["embodiments"]] == ["arm", "hand"]
    assert "token is not valid" in shown[3] and "Traceback" in shown[3]
    stored = [path for path in tmp_path.rglob("*") if path.is_file() and TOKEN.encode() in path.read_bytes()]
    assert stored == [] and all(TOKEN.encode() not in c for c in server.model(REPO).files.values())


def test_what_the_transfer_library_says_is_shown_without_a_token():
    said = RuntimeError(f"denied for {TOKEN}\nAuthorization: Bearer {TOKEN}")
    with pytest.raises(HubError, match="the transfer failed: .*denied") as found, hub_errors.explained(REPO):
        raise said
    assert TOKEN not in str(found.value) and "\n" not in str(found.value)
