"""`hma demo`, small and in this process."""

import json
from pathlib import Path

import pytest

from hma_data.errors import OutputError
from hma_data.shards.verify import verify
from hma_model import demo as demos


@pytest.mark.slow
def test_a_demo_that_was_cut_goes_on_by_the_same_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def cut(made: demos.Demo) -> None:
        raise KeyboardInterrupt

    out = tmp_path / "demo"
    monkeypatch.setattr(demos, "usable_cores", lambda: 1)
    monkeypatch.setattr(demos, "WINDOWS", 2)
    monkeypatch.setattr(demos, "LONGEST", 6)
    with monkeypatch.context() as first, pytest.raises(KeyboardInterrupt):
        first.setattr(demos, "publish", cut)
        demos.demo(out, episodes=4, steps=2)
    kept = {path: path.stat().st_mtime_ns for name in ("recordings", "shards") for path in _files(out / name)}
    assert not (out / "report.html").exists()

    page = demos.demo(out, episodes=4, steps=2).read_text()
    assert {path: path.stat().st_mtime_ns for path in kept} == kept
    results = json.loads((out / "results.json").read_text())
    assert results["seconds"] > 0 and set(results["embodiments"]) == set(demos.ROBOTS)
    for robot in demos.ROBOTS:
        assert verify(out / "shards" / robot) == []
        assert (out / "pulled" / robot / "embodiments" / robot / "head.safetensors").is_file()
        assert set(results["embodiments"][robot]) == {"psnr_last", "psnr_last_shuffled", "psnr_last_copy"}
        assert f"{robot}: recorded frames above" in page and f"{robot}: truth, prediction" in page
    for title in ("The robots", "The mixture", "Training", "Sizes and timings", "on your own data"):
        assert title in page


def test_a_folder_that_holds_something_else_is_refused(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("mine")
    with pytest.raises(OutputError, match=r"thesis\.tex"):
        demos.demo(tmp_path)


def _files(folder: Path) -> list[Path]:
    return [path for path in folder.rglob("*") if path.is_file() and not path.name.startswith(".")]
