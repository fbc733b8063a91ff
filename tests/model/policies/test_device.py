"""The options --device, --precision and --compile of the verbs that work inside the world model."""

from pathlib import Path
from typing import Any

import pytest

from hma_model.cli import main
from hma_model.policies import acting, scores
from hma_model.policies.arenas import Scenes
from hma_model.policies.catalog import read_policy
from hma_model.synthetic import augment, labels
from hma_model.worlds.world import World


class Asked(Exception):
    """A world was asked for."""


@pytest.mark.parametrize(
    ("module", "words", "options"),
    [
        (scores, ["policy-eval", "rails_03", "random", "still"], ["--precision", "bf16", "--compile"]),
        (augment, ["augment", "rails_03", "made"], ["--precision", "bf16", "--compile"]),
        (labels, ["label-actions", "film", "--checkpoint", "run", "-e", "rails_03", "--out", "made"], []),
    ],
)
def test_device_and_precision_reach_the_world(module, words, options, monkeypatch, tmp_path) -> None:
    def load(checkpoint: str, robots: list[str], **given: Any) -> World:
        raise Asked(given["device"], given.get("precision"), given.get("compile"))

    monkeypatch.chdir(tmp_path)
    (tmp_path / "film").mkdir()
    (tmp_path / "film" / "a.mp4").touch()  # film is looked for before the world is loaded
    monkeypatch.setattr("hma_model.training.runtime.choose_device", lambda name: f"chosen {name}")
    monkeypatch.setattr(module, "load_world", load)
    with pytest.raises(Asked) as said:
        main(["--debug", *words, *options, "--device", "cuda:1"])
    assert said.value.args == ("chosen cuda:1", *(("bf16", True) if options else (None, None)))


def test_a_device_that_is_not_here_is_refused(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main(["augment", "rails_03", str(tmp_path / "made"), "--device", "warp"]) == 2
    assert "--device" in capsys.readouterr().err and not (tmp_path / "made").exists()


def test_a_model_that_acts_is_on_the_device_of_its_world(world, monkeypatch) -> None:
    asked: list[str] = []

    def load(checkpoint: str, robots: list[str], **given: Any) -> World:
        asked.append(given["device"])
        return world

    monkeypatch.setattr(acting, "load_world", load)
    monkeypatch.setattr(acting, "Acting", lambda *given: given)
    read_policy("hma:run", Scenes.of(world, "rails_03", 1, 0), world)
    assert asked == [str(world.model.device)]
