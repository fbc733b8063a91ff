"""Plans; plans, merges, splits and extensions over tables are those of plain loops over objects."""

import hashlib
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hma_data.conversion import extend
from hma_data.conversion.plan import (
    Settings,
    choose_splits,
    idle_workers,
    longest_work,
    make_plan,
    shard_size,
)
from hma_data.conversion.rewrite import _joined, _together
from hma_data.errors import SourceError
from hma_data.registry.embodiment import Embodiment
from hma_data.shards.manifest import digest
from hma_data.shards.schema import EpisodeRow, Refused
from hma_data.sources.base import EpisodeRef
from hma_data.storage.records import Records
from tests.conftest import ARM_YAML, BlockTokenizer

ARM = Embodiment.from_yaml(ARM_YAML)
Cut = list[tuple[str, str, list[tuple[int, EpisodeRef]]]]
GROUPS = st.sampled_from(["", "", "day", "night", "demo_3"])
SPLITS, NONE = st.sampled_from([None, "train", "val"]), st.none()


@st.composite
def recordings(draw: st.DrawFn, splits: st.SearchStrategy = NONE) -> list[EpisodeRef]:
    numbers = draw(st.lists(st.integers(0, 60), min_size=1, max_size=30, unique=True))
    return [
        EpisodeRef(f"demo_{i}", draw(st.integers(0, 300)), draw(splits), f"é{i}", draw(GROUPS))
        for i in numbers
    ]


def splits_by_hand(refs: Sequence[EpisodeRef], fraction: float, seed: int) -> list[str]:
    if any(ref.split for ref in refs):
        return [ref.split or "train" for ref in refs]

    def draw(group: str) -> float:
        return int.from_bytes(hashlib.sha256(f"{seed}/{group}".encode()).digest()[:8], "big") / 2**64

    draws = {ref.group or ref.id: draw(ref.group or ref.id) for ref in refs}
    held = {group for group, value in draws.items() if value < fraction}
    if len(draws) >= 2 and fraction > 0:
        held = held or {min(draws, key=lambda group: draws[group])}
        if len(held) == len(draws):
            held.remove(max(draws, key=lambda group: draws[group]))
    return ["val" if (ref.group or ref.id) in held else "train" for ref in refs]


def cut_by_hand(placed: list[tuple[int, EpisodeRef, str]], target: int, begun: dict[str, int]) -> Cut:
    cut: Cut = []
    for split in ("train", "val"):
        groups: list[list[tuple[int, EpisodeRef]]] = []
        filled = target
        for number, ref, own in placed:
            if own != split:
                continue
            if filled >= target:
                groups.append([])
                filled = 0
            groups[-1].append((number, ref))
            filled += max(ref.frames, 1)
        cut += [(f"{split}/shard-{i:05d}.parquet", split, g) for i, g in enumerate(groups, begun[split])]
    return cut


def numbers(cut: Cut) -> list[tuple[str, list[int]]]:
    return [(name, [i for i, _ in group]) for name, _, group in cut]


def together_by_hand(rows: Sequence[EpisodeRow], by: str) -> list[str]:
    leader: dict[tuple[str, str], tuple[str, str]] = {}

    def find(key: tuple[str, str]) -> tuple[str, str]:
        while leader.setdefault(key, key) != key:
            key = leader[key]
        return key

    for row in rows:
        for kind, value in ((by, getattr(row, by)), ("group", row.group)):
            if value:
                leader[find(("id", row.id))] = find((kind, value))
    return ["/".join(find(("id", row.id))) for row in rows]


@given(
    st.one_of(recordings(), recordings(SPLITS)),
    st.floats(0, 0.99),
    st.integers(0, 3),
    st.none() | st.integers(1, 900),
    st.none() | st.integers(1, 30),
)
def test_a_plan_is_that_of_plain_loops(refs, fraction, seed, size, limit) -> None:
    chosen = Settings(val_fraction=fraction, seed=seed, shard_frames=size, limit=limit)
    plan = make_plan(refs, ARM, BlockTokenizer.spec, chosen, "toy")
    refs = refs[:limit]
    splits = splits_by_hand(refs, fraction, seed)
    target = size or shard_size(sum(ref.frames for ref in refs))
    cut = cut_by_hand(list(zip(range(len(refs)), refs, splits)), target, {"train": 0, "val": 0})
    assert [(unit.name, unit.split, unit.episodes) for unit in plan.units] == cut
    assert plan.facts["recording"] == digest([(ref.id, ref.fingerprint) for ref in refs])
    assert plan.facts["shards"] == digest(numbers(cut))
    assert (plan.episodes, plan.frames) == (len(refs), sum(ref.frames for ref in refs))
    assert make_plan(Records.of(EpisodeRef, refs), ARM, BlockTokenizer.spec, chosen, "toy") == plan


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("base")


@given(data=st.data(), refs=recordings())
def test_an_extension_is_that_of_plain_loops(base: Path, data: st.DataObject, refs: list[EpisodeRef]) -> None:
    states = data.draw(
        st.lists(st.sampled_from("nkrc"), min_size=len(refs), max_size=len(refs)),
        "new, known, refused, changed",
    )
    ids = {state: [ref.id for ref, own in zip(refs, states) if own == state] for state in "nkrc"}
    marks = {ref.id: "old" if state == "c" else ref.fingerprint for ref, state in zip(refs, states)}
    known = [*ids["k"], *ids["c"], "gone"]
    columns = {"id": known, "fingerprint": [marks.get(name, "") for name in known], "content": known}
    groups = {ref.id: ref.group for ref in refs}
    columns |= {"group": [groups.get(name, "") for name in known], "split": ["val"] * len(known)}
    there = SimpleNamespace(episodes=pa.table(columns), refused=[Refused(name, "E", "") for name in ids["r"]])
    plan = make_plan(refs, ARM, BlockTokenizer.spec, Settings(), "toy")
    manifest = SimpleNamespace(
        plan={**plan.facts, "recording": "r", "shards": "s"},
        shards=[
            SimpleNamespace(path="p", split=split, bytes=9, sha256="") for split in ("train", "train", "val")
        ],
        **dict.fromkeys(("embodiment", "source")),
    )
    asked: list[str] = []

    def content(ref: EpisodeRef) -> str:
        asked.append(ref.id)
        return ref.id

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(extend, "shard_sizes", lambda out: {"p": 9})
        patch.setattr(extend, "derive", lambda *given: there)
        made = extend.extended(base, manifest, plan, 100, content)  # type: ignore[arg-type]
    assert asked == ids["c"]
    splits = {ref.id: unit.split for unit in plan.units for _, ref in unit.episodes}
    parts = {groups[name] for name in known if groups.get(name)}  # of recordings that the set has begun
    splits |= {ref.id: "val" for ref in refs if ref.group in parts}
    new = [replace(ref, split=splits[ref.id]) for ref in refs if ref.id in ids["n"]]
    placed = [(len(known) + len(ids["r"]) + i, ref, splits[ref.id]) for i, ref in enumerate(new)]
    cut = cut_by_hand(placed, 100, {"train": 2, "val": 1})
    assert [(unit.name, unit.split, unit.episodes) for unit in made.units] == cut
    if new:
        assert made.facts["extends"] == [plan.facts["hash"]]
        assert made.facts["recording"] == digest(["r", [(ref.id, ref.fingerprint) for ref in new]])
        assert made.facts["shards"] == digest(["s", numbers(cut)])


def row(name: str, instruction: str, group: str, source: str) -> EpisodeRow:
    return EpisodeRow(0, name, "", "", 0, 1, 1, instruction, None, "", 0, 0, 0, "{}", 0, "", group, source)


ROWS = st.lists(
    st.tuples(
        st.sampled_from("abcdef"),
        st.sampled_from(["", "lift", "push"]),
        GROUPS,
        st.sampled_from(["", "x", "y"]),
    ),
    max_size=8,
    unique_by=lambda values: values[0],
).map(lambda several: [row(*values) for values in several])


@given(ROWS, st.sampled_from(["instruction", "source"]))
def test_linked_episodes_are_those_of_plain_loops(rows: list[EpisodeRow], by: str) -> None:
    found = _together(Records.of(EpisodeRow, rows).table, by)
    assert found.to_pylist() == together_by_hand(rows, by)


@given(st.lists(st.tuples(ROWS, st.lists(st.sampled_from("abgh"), unique=True)), min_size=1, max_size=3))
def test_joined_sets_are_those_of_plain_loops(sets: list[tuple[list[EpisodeRow], list[str]]]) -> None:
    refused = [[Refused(name, "E", "") for name in names] for _, names in sets]
    table, listed = _joined([Records.of(EpisodeRow, rows).table for rows, _ in sets], refused)
    counts = Counter([name for rows, names in sets for name in (*(row.id for row in rows), *names)])

    def unique(number: int, name: str) -> str:
        return f"{number + 1}/{name}" if counts[name] > 1 else name

    expected = [
        (number, replace(row, id=unique(number, row.id), group=group))
        for number, (rows, _) in enumerate(sets)
        for row in rows
        for group in [f"{number + 1}/{row.group}" if row.group and len(sets) > 1 else row.group]
    ]
    assert list(zip(table["set"].to_pylist(), Records.of_table(EpisodeRow, table))) == expected
    assert [item.id for item in listed] == [
        unique(number, name) for number, (_, names) in enumerate(sets) for name in names
    ]


def refs(*frames: int) -> list[EpisodeRef]:
    return [EpisodeRef(f"demo_{i}", n, fingerprint=str(n)) for i, n in enumerate(frames)]


def plan(episodes: list[EpisodeRef], arm: Embodiment, settings: Settings | None = None):
    return make_plan(episodes, arm, BlockTokenizer.spec, settings or Settings(), "toy")


@pytest.mark.parametrize(("episodes", "held_out"), [(1, 0), (2, 1), (8, 2), (20, 5), (28, 5), (60, 5)])
def test_a_small_set_holds_out_five_episodes_or_a_quarter(episodes: int, held_out: int) -> None:
    known = [EpisodeRef(f"demo_{i}", 5) for i in range(episodes)]
    assert max(choose_splits(known, None, seed).count("val") for seed in range(4)) >= held_out
    assert min(choose_splits(known, None, seed).count("val") for seed in range(4)) >= held_out
    assert choose_splits(known, 0.0, 0).count("val") == 0
    if episodes == 28:  # a share that is asked for stays that share
        assert choose_splits(known, 0.01, 0).count("val") == 1


def test_a_large_set_holds_out_a_twentieth() -> None:
    known = [EpisodeRef(f"demo_{i}", 5) for i in range(4_000)]
    assert choose_splits(known, None, 0) == choose_splits(known, 0.05, 0)


def test_the_hash_tells_plans_apart(toy_arm: Embodiment) -> None:
    same = plan(refs(9, 9), toy_arm).facts["hash"]
    assert plan(refs(9, 9), toy_arm).facts["hash"] == same
    assert plan(refs(9, 8), toy_arm).facts["hash"] != same
    assert plan(refs(9, 9), toy_arm, Settings(seed=1)).facts["hash"] != same
    assert plan(refs(9, 9), toy_arm.model_copy(update={"description": "other words"})).facts["hash"] == same


def test_shards_are_many_enough_to_share_and_never_huge() -> None:
    assert shard_size(1_000) == 4_096
    assert shard_size(1_000_000) == 31_250
    assert shard_size(10**9) == 170_000


def test_no_episodes_or_two_with_one_id_are_refused(toy_arm: Embodiment) -> None:
    with pytest.raises(SourceError, match="no episodes"):
        plan([], toy_arm)
    with pytest.raises(SourceError, match="two episodes"):
        plan([EpisodeRef("x", 1), EpisodeRef("x", 1)], toy_arm)


@pytest.mark.parametrize(
    ("frames", "workers", "tasks", "longest"),
    [
        ([100, 100], 1, 1, 200),
        ([100, 100], 64, 1, 100),  # more workers than shards are no faster
        ([190, 10], 2, 1, 190),
        ([50, 50, 50], 2, 1, 100),
        ([50] * 8, 2, 4, 50),
        ([50] * 8, 4, 64, 50),
        ([50] * 8, 0, 1, 400),  # 0 works in this process
        ([], 4, 1, 0),
    ],
)
def test_a_job_takes_as_long_as_its_busiest_worker(frames, workers, tasks, longest) -> None:
    assert longest_work(frames, workers, tasks) == longest


@pytest.mark.parametrize(("workers", "tasks"), [(64, 1), (4, 16), (10, 1), (3, 64)])
def test_workers_without_a_shard_are_told_with_the_size_that_gives_them_one(workers, tasks, toy_arm) -> None:
    episodes = refs(*[50] * 400)
    few = plan(episodes, toy_arm)
    todo = len(few.units[::tasks])
    line = idle_workers(few, todo, workers, tasks)
    assert line.startswith(f"{todo} of {workers} workers have work")
    assert ("in every task" in line) == (tasks > 1)
    size = re.search(r"--shard-frames (\d+)( in every task)? gives more$", line)
    assert size
    many = plan(episodes, toy_arm, Settings(shard_frames=int(size[1])))
    assert idle_workers(many, len(many.units[tasks - 1 :: tasks]), workers, tasks) == ""


def test_a_size_is_only_named_where_it_helps(toy_arm: Embodiment) -> None:
    alone = plan(refs(500, 500), toy_arm, Settings(shard_frames=100))  # a shard holds whole episodes
    assert idle_workers(alone, 2, 8) == "2 of 8 workers have work"
    few = plan(refs(*[50] * 100), toy_arm)
    assert idle_workers(few, 1, 8, begun=True) == "1 of 8 workers have work"
    assert idle_workers(few, 2, 2) == idle_workers(few, 2, 0) == ""
