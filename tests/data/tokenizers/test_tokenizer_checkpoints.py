"""Weights of downloaded tokenizers: where they are found, and what is refused before it can do harm."""

import pickle
from pathlib import Path

import httpx
import huggingface_hub
import pytest
import torch
from huggingface_hub import errors
from safetensors.torch import save_file

from hma_data.errors import TokenizerError
from hma_data.tokenizers.base import get_tokenizer
from hma_data.tokenizers.catalog import CATALOG
from hma_data.tokenizers.checkpoints import digest_of, find_weights, read_tensors, stated_scale
from tests.data.tokenizer_files import frames, magvit2_state, write_magvit2, write_tiny_pair, write_tiny_whole
from tests.hostile import Touch

# -- files that mean harm or are damaged


@pytest.mark.parametrize("zipped", [True, False], ids=["zip", "legacy"])
@pytest.mark.parametrize("name", ["magvit2", "taesd"])
def test_a_hostile_checkpoint_is_refused_and_does_not_run(tmp_path, name, zipped):
    mark, path = tmp_path / "ran", tmp_path / "evil.ckpt"
    state = {"state_dict": magvit2_state(), "hyper_parameters": Touch(mark)}
    torch.save(state, path, _use_new_zipfile_serialization=zipped)
    with pytest.raises(TokenizerError, match=r"evil\.ckpt: .*holds more than tensors"):
        get_tokenizer(name, weights=str(path))
    assert not mark.exists()


def test_a_bare_hostile_pickle_does_not_run(tmp_path):
    mark, path = tmp_path / "ran", tmp_path / "evil.pt"
    path.write_bytes(pickle.dumps(Touch(mark)))
    with pytest.raises(TokenizerError, match=r"evil\.pt"):
        read_tensors(path)
    assert not mark.exists()


@pytest.mark.parametrize("kind", ["safetensors", "zip", "legacy"])
@pytest.mark.parametrize("keep", [0.0, 0.001, 0.5, 0.999])
def test_a_truncated_file_is_refused(tmp_path, kind, keep):
    path = tmp_path / "whole"
    if kind == "safetensors":
        write_magvit2(path)
    else:
        torch.save(magvit2_state(), path, _use_new_zipfile_serialization=kind == "zip")
    content = path.read_bytes()
    cut = tmp_path / "cut.ckpt"
    cut.write_bytes(content[: int(len(content) * keep)])
    with pytest.raises(TokenizerError, match=r"cut\.ckpt"):
        read_tensors(cut)


@pytest.mark.parametrize("content", [b"", b"hello, world", b"\x80\x05junk", b"PK\x03\x04junk", b"\xff" * 64])
def test_a_file_of_something_else_is_refused(tmp_path, content):
    path = tmp_path / "other.pt"
    path.write_bytes(content)
    with pytest.raises(TokenizerError, match=r"other\.pt"):
        read_tensors(path)


@pytest.mark.parametrize("value", [[torch.ones(2)], torch.ones(2), {"epoch": 3}, {}])
def test_a_checkpoint_without_named_weights_is_refused(tmp_path, value):
    torch.save(value, tmp_path / "a.pt")
    with pytest.raises(TokenizerError, match="without weights by name"):
        read_tensors(tmp_path / "a.pt")


@pytest.mark.parametrize(
    "nest", [lambda s: s, lambda s: {"state_dict": s}, lambda s: {"model": s, "step": 1}]
)
@pytest.mark.parametrize("zipped", [True, False], ids=["zip", "legacy"])
def test_checkpoints_of_all_layouts_give_the_same_tensors(tmp_path, nest, zipped):
    state = {"a.weight": torch.arange(6.0).view(2, 3), "b": torch.ones(1, dtype=torch.float16)}
    torch.save(nest(state), tmp_path / "a.pt", _use_new_zipfile_serialization=zipped)
    save_file(state, tmp_path / "a.safetensors")
    for name in ("a.pt", "a.safetensors"):
        read = read_tensors(tmp_path / name)
        assert read.keys() == state.keys()
        assert all(torch.equal(read[key], one) and read[key].dtype == one.dtype for key, one in state.items())


@pytest.mark.parametrize("text", ["", "[1]", "{", '{"scaling_factor": NaN}'])
def test_a_config_that_is_no_object_is_refused(tmp_path, text):
    (tmp_path / "config.json").write_text(text)
    with pytest.raises(TokenizerError, match=r"config\.json"):
        stated_scale(tmp_path, 1.0)


def test_an_empty_folder_is_refused_with_the_names_it_might_hold(tmp_path):
    with pytest.raises(TokenizerError, match=r"holds none of model\.safetensors"):
        get_tokenizer("magvit2", weights=str(tmp_path))


def test_a_folder_of_weights_is_searched_by_the_tokenizers_name(tmp_path, monkeypatch):
    write_tiny_whole(tmp_path / "taesd.safetensors")
    write_magvit2(tmp_path / "magvit2.ckpt")
    monkeypatch.setenv("HMA_WEIGHTS", str(tmp_path))
    assert get_tokenizer("taesd").spec.weights_sha256 == digest_of([tmp_path / "taesd.safetensors"])
    assert get_tokenizer("magvit2").spec.weights_sha256 == digest_of([tmp_path / "magvit2.ckpt"])
    write_tiny_pair(tmp_path, "taef2", channels=32)
    assert get_tokenizer("taef2").spec.channels == 32


def test_the_weights_that_were_named_win_over_the_folder(tmp_path, monkeypatch):
    (tmp_path / "home").mkdir()
    write_magvit2(tmp_path / "home" / "magvit2.safetensors", seed=1)
    named = write_magvit2(tmp_path / "named.safetensors", seed=2)
    monkeypatch.setenv("HMA_WEIGHTS", str(tmp_path / "home"))
    assert find_weights("magvit2", str(named)) == named


class Hub:
    """Stands for the hub: gives a file, or fails as told, and remembers what it was asked for."""

    def __init__(self, gives: Path | Exception) -> None:
        self.gives, self.asked, self.cached = gives, {}, None

    def asked_for(self, url):
        if isinstance(self.gives, Exception):
            raise self.gives

    def __call__(self, repo, file, **options):
        self.asked = {"repo": repo, "file": file, **options}
        if isinstance(self.gives, Exception):
            raise self.gives
        return str(self.gives)


@pytest.fixture
def hub(monkeypatch, tmp_path):
    monkeypatch.delenv("HMA_WEIGHTS", raising=False)

    def stand_in(gives):
        made = Hub(gives)
        monkeypatch.setattr(huggingface_hub, "hf_hub_download", made)
        monkeypatch.setattr(huggingface_hub, "get_hf_file_metadata", made.asked_for)
        monkeypatch.setattr(huggingface_hub, "try_to_load_from_cache", lambda *a, **k: made.cached)
        return made

    return stand_in


def test_downloads_are_pinned_to_a_commit(hub, tmp_path):
    made = hub(write_magvit2(tmp_path / "downloaded"))
    tokenizer = get_tokenizer("magvit2")
    assert tokenizer.encode(frames(1)).shape == (1, 16, 16)
    assert made.asked == {
        "repo": "1x-technologies/worldmodel",
        "file": "magvit2.ckpt",
        "revision": CATALOG["magvit2"].revision,
        "repo_type": "dataset",
    }
    pinned = [entry for entry in CATALOG.values() if entry.weights == "download"]
    assert len(pinned) >= 4 and all(len(entry.revision) == 40 for entry in pinned)


@pytest.mark.parametrize("name", ["magvit2", "taesd"])
@pytest.mark.parametrize(
    "failure",
    [errors.LocalEntryNotFoundError("x"), errors.OfflineModeIsEnabled("x"), OSError("no route to host")],
)
def test_out_of_reach_the_error_names_repository_file_and_what_to_do(hub, name, failure):
    hub(failure)
    with pytest.raises(TokenizerError) as caught:
        get_tokenizer(name)
    text, entry = str(caught.value), CATALOG[name]
    assert entry.repo in text and entry.file in text and "weights=PATH" in text and "\n" not in text
    assert entry.bytes is None or " MB" in text


def test_what_was_downloaded_is_used_without_a_network(hub, tmp_path):
    made = hub(OSError("no route to host"))
    made.cached = str(write_magvit2(tmp_path / "cached"))
    assert get_tokenizer("magvit2").spec.weights_sha256 == digest_of([tmp_path / "cached"])


@pytest.mark.parametrize(
    ("failure", "named"),
    [
        (errors.GatedRepoError, "GatedRepoError.*accept its licence"),
        (errors.RepositoryNotFoundError, "could not be downloaded: .*no such thing"),
        (errors.RemoteEntryNotFoundError, "could not be downloaded: .*no such thing"),
    ],
)
def test_what_the_hub_refuses_is_told(hub, failure, named):
    response = httpx.Response(404, request=httpx.Request("HEAD", "https://hub.example"))
    hub(failure("no such thing", response=response))
    with pytest.raises(TokenizerError, match=named):
        get_tokenizer("magvit2")


def test_a_download_with_other_content_than_was_pinned_is_refused(hub, tmp_path):
    hub(write_tiny_whole(tmp_path / "swapped.safetensors"))
    with pytest.raises(TokenizerError, match="is not the file that was pinned for taesd"):
        get_tokenizer("taesd")


def test_another_file_of_the_hub_can_be_named(hub, tmp_path):
    made = hub(write_magvit2(tmp_path / "downloaded"))
    get_tokenizer("magvit2", weights="hf://TencentARC/Open-MAGVIT2@abc123/sub/pretrain256_262144.ckpt")
    assert made.asked == {
        "repo": "TencentARC/Open-MAGVIT2",
        "file": "sub/pretrain256_262144.ckpt",
        "revision": "abc123",
        "repo_type": "model",
    }
    get_tokenizer("magvit2", weights="hf://datasets/some/where/a.ckpt")
    assert made.asked["repo_type"] == "dataset" and made.asked["revision"] == "main"


@pytest.mark.parametrize("uri", ["hf://", "hf://one/two", "hf://a/b/../../c", "hf://a/b@/c d"])
def test_an_address_of_the_hub_that_is_none_is_refused(uri):
    with pytest.raises(TokenizerError, match="is not the address of a file"):
        find_weights("magvit2", uri)
