"""`hma bench loader` on small sets: what it measures, with units. No figure is asserted."""

from pathlib import Path
from typing import Any

import pytest

from hma_data.shards.reader import ShardSet
from hma_data.shards.verify import verify
from recipes.bench import loader, peers
from tests.data.loading.test_pools import SMALL


@pytest.mark.slow
def test_every_case_reports_speed_opening_and_memory() -> None:
    settings = SMALL | {"embodiments": 2, "windows": 64, "runs": 1}
    results = loader.run(settings)
    assert [one["case"] for one in results] == ["mixture", "random"]
    figures = (
        "windows_per_second",
        "windows_per_cpu_second",
        "open_seconds",
        "first_batch_seconds",
        "peak_rss_mib",
    )
    assert all(one[figure] > 0 for one in results for figure in figures)
    assert results[0]["frames"] == 12_000


def test_a_generated_set_of_one_shard_is_sound(tmp_path: Path) -> None:
    folder = loader.make_set(tmp_path / "set", 0, SMALL | {"frames": 1_500})
    assert verify(folder) == []
    assert ShardSet(folder).manifest.splits["train"] == {
        "episodes": 25,
        "frames": 1_500,
        "rows": 1_500,
        "shards": 1,
    }


@pytest.mark.parametrize(("frames", "shards"), [(6_000, 4), (6_060, 5)])
def test_a_generated_set_has_as_many_frames_as_asked(tmp_path: Path, frames: int, shards: int) -> None:
    splits = ShardSet(loader.make_set(tmp_path / "set", 0, SMALL | {"frames": frames})).manifest.splits
    assert splits["train"]["shards"] == shards
    assert splits["train"]["frames"] >= frames


def test_a_peer_must_give_our_windows_and_a_missing_one_is_named(tmp_path, monkeypatch) -> None:
    settings = SMALL | {"frames": 1_500, "peer_windows": 8}
    folder = loader.make_set(tmp_path / "set", 0, settings)

    def missing(store: Path, rows: Any) -> Any:
        raise ImportError("no", name="lance")

    (tmp_path / "set-whole").mkdir()
    right = {"whole": lambda store, rows: lambda numbers: (rows[0][numbers], rows[1][numbers])}
    wrong = {"shifted": lambda store, rows: lambda numbers: (rows[0][numbers - 1], rows[1][numbers])}
    monkeypatch.setattr(peers, "PEERS", {**right, **wrong, "lance": missing})
    assert peers.run_peer("whole", folder, settings)["windows_per_second"] > 0
    assert (
        peers.run_peer("lance", folder, settings)["left_out"] == "lance is not installed: pip install pylance"
    )
    with pytest.raises(RuntimeError, match="shifted gives other windows"):
        peers.run_peer("shifted", folder, settings)
