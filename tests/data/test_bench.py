"""`hma bench`: its settings and the form of what it prints. No figure is asserted."""

import json
from types import SimpleNamespace
from typing import Any

import pytest

from hma_data import bench
from hma_data.errors import UsageError

TOY: Any = SimpleNamespace(
    ABOUT="a toy",
    DEFAULTS={"frames": 4, "share": 0.5, "name": "x", "kinds": ["a"]},
    run=lambda settings: [settings],
)


def test_settings_keep_the_type_of_their_default() -> None:
    settings = bench.settings_of(TOY, "toy", ["frames=7", "share=1", "name=two", "kinds=[b, c]"])
    assert settings == {"frames": 7, "share": 1.0, "name": "two", "kinds": ["b", "c"]}
    assert type(settings["share"]) is float


@pytest.mark.parametrize("word", ["frames", "speed=3", "frames=many", "kinds=a", "frames=[", "=3"])
def test_a_word_that_is_no_setting_is_refused(word: str) -> None:
    with pytest.raises(UsageError, match="bench toy"):
        bench.settings_of(TOY, "toy", [word])


def test_a_bench_that_is_not_there_names_those_that_are() -> None:
    with pytest.raises(UsageError, match="known: "):
        bench.load("nothing")


def test_the_report_has_the_promised_form() -> None:
    said = json.loads(json.dumps(bench.report("toy", TOY.DEFAULTS, TOY.run({"frames": 1}))))
    assert list(said) == ["bench", "machine", "settings", "results"]
    assert said["machine"]["cores"] >= 1 and said["results"] == [{"frames": 1}]
