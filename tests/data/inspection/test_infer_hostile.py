"""Infer on inspections of any content: a YAML that parses and asks, or one line of error."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hma_data.errors import HMAError
from hma_data.inspection.infer import from_inspection
from hma_data.registry.embodiment import problems
from hma_data.sources.common.inspection import Inspection, KeyInfo, TopicInfo
from hma_data.storage.yaml_io import parse_yaml

HOSTILE = [
    "action", "a: b", "'", '"', "x\n---\ny", "#", "- ", "{a}", "[", "&x", "*x", "!!int 3", "null", "1e3",
    "TODO", "~", "é/状态", "\ufeff", "action/" + "long" * 3000, "%", "@",
    "yes", "action/pos", "obs/image", "/cmd_vel.linear", "observation/state", "/cam/image/compressed",
]  # fmt: skip
PRINTED = st.characters(exclude_categories=("Cc", "Cs", "Zl", "Zp"))
NASTY = st.one_of(st.sampled_from(HOSTILE), st.text(PRINTED, max_size=30))
RATES = st.one_of(st.none(), st.floats())
KEYS = st.builds(
    KeyInfo,
    key=NASTY,
    kind=st.sampled_from(["camera", "vector", "text", "other"]),
    shape=st.lists(st.integers(-1, 5000), max_size=4).map(tuple)
    | st.sampled_from([(64, 64, 3), (64, 64, 1), (7,), ()]),
    dtype=st.sampled_from(["float32", "float64", "int64", "bool", "uint8", ""]),
    hz=RATES,
    names=st.none() | st.lists(NASTY, max_size=8).map(tuple),
    codec=st.sampled_from([None, "raw", "jpeg"]),
    count=st.none() | st.integers(0, 100),
    jitter_ms=RATES,
    topic=st.none()
    | st.builds(TopicInfo, NASTY, NASTY, gap_ms=RATES, delay_ms=RATES, goes_back=st.booleans()),
    constant=st.booleans(),
)
FACTS = ["dataset", "simulator", "controller", "layout", "instruction", "timestamps", "rate", "tasks"]


@pytest.mark.slow
@given(
    found=st.builds(
        Inspection,
        format=st.sampled_from(["rlds", "hdf5", "rosbag", "lerobot"]),
        uri=NASTY,
        episodes=st.integers(0, 10),
        keys=st.lists(KEYS, max_size=8).map(tuple),
        hz=RATES,
        robot=st.none() | NASTY,
        facts=st.dictionaries(st.sampled_from([*FACTS, "episode keys"]), NASTY, max_size=4),
    )
)
def test_whatever_is_inspected_gives_a_yaml_with_questions_alone_or_one_line(found: Inspection) -> None:
    try:
        text = from_inspection(found, "mine")
    except HMAError as fault:
        assert "\n" not in str(fault)
        return
    values = parse_yaml(text, "inferred")
    assert [problem for problem in problems(values) if "still TODO" not in problem] == []
    assert {part["key"] for part in values["action"]["components"]} <= {key.key for key in found.keys}
    assert text.encode("utf-8")
