"""The registry's YAML: what goes in comes out, and everything else is refused by name."""

import copy
import datetime
import math
import os
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hma_data.errors import RegistryError
from hma_data.registry.embodiment import Embodiment, find, schema, todos
from hma_data.registry.folders import registry_files
from hma_data.storage.yaml_io import MAX_BYTES, parse_yaml, read_yaml, write_yaml
from tests.conftest import problems

BASE: dict[str, Any] = {
    "id": "arm",
    "kind": "real",
    "frequency_hz": 5,
    "action": {"space": "eef_delta", "components": [{"key": "action/move", "dims": 3}]},
    "cameras": [{"name": "front", "key": "image"}],
    "source": {"format": "rlds"},
}


def changed(path: str, value: Any) -> dict[str, Any]:
    values = copy.deepcopy(BASE)
    *parents, last = path.split(".")
    holder: Any = values
    for part in parents:
        holder = holder[int(part)] if part.isdigit() else holder.setdefault(part, {})
    holder[int(last) if last.isdigit() else last] = value
    return values


def arm(path: str = "id", value: Any = "arm") -> Embodiment:
    return Embodiment.from_values(changed(path, value), "arm.yaml")


# -- strategies

texts = st.text(st.characters(exclude_categories=["Cc", "Cs", "Zl", "Zp"]), max_size=20)
words = texts.map(str.strip).filter(lambda word: bool(word) and not word.startswith("TODO"))
numbers = st.floats(-1e6, 1e6, allow_subnormal=False)
names = st.from_regex(r"[A-Za-z0-9_.-]{1,12}", fullmatch=True)


@st.composite
def components(draw: st.DrawFn) -> dict[str, Any]:
    dims = draw(st.integers(1, 8))
    found: dict[str, Any] = {"key": draw(words), "dims": dims}
    start = draw(st.integers(0, 5))
    per_value = st.lists(numbers, min_size=dims, max_size=dims)
    choices = {
        "slice": st.just([start, start + dims]),
        "names": st.lists(words, min_size=dims, max_size=dims),
        "unit": words,
        "normalize": st.booleans(),
        "sign": numbers | per_value,
        "offset": numbers | per_value,
        "range": st.just([-1.5, 2]),
        "representation": st.sampled_from(["euler_xyz", "quaternion_xyzw", "rotation_6d"]),
        "gripper": st.sampled_from(["open_is_high", "open_is_low"]),
        "stamp": st.sampled_from(["header", "receive"]),
    }
    for key in draw(st.sets(st.sampled_from(sorted(choices)))):
        found[key] = draw(choices[key])
    return found


@st.composite
def embodiments(draw: st.DrawFn) -> dict[str, Any]:
    cameras = draw(st.lists(names, min_size=1, max_size=3, unique=True))
    found: dict[str, Any] = {
        "id": draw(st.from_regex(r"[a-z0-9][a-z0-9_]{0,20}", fullmatch=True)),
        "kind": draw(st.sampled_from(["real", "simulation", "human"])),
        "frequency_hz": draw(st.just("unknown") | st.floats(0.01, 1000)),
        "action": {
            "space": draw(st.sampled_from(["eef_delta", "hand_2d", "mixed"])),
            "components": draw(st.lists(components(), min_size=1, max_size=4)),
        },
        "cameras": [
            {"name": name, "key": draw(words), "rotate": draw(st.sampled_from([0, 90]))} for name in cameras
        ],
        "source": {"format": draw(st.sampled_from(["rlds", "hdf5", "rosbag", "lerobot", "hands"]))},
    }
    choices = {
        "description": texts,
        "target_hz": st.floats(0.5, 50),
        "stride": st.integers(1, 50),
        "state": st.fixed_dictionaries({"components": st.lists(components(), min_size=1, max_size=2)}),
        "sync": st.fixed_dictionaries({"primary": st.sampled_from(cameras), "max_skew_ms": st.just(20.0)}),
        "provenance": st.dictionaries(words, texts, max_size=3),
        "notes": texts,
    }
    for key in draw(st.sets(st.sampled_from(sorted(choices)))):
        found[key] = draw(choices[key])
    return found


anything = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | texts | st.dates(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(texts | st.integers(), inner, max_size=3),
    max_leaves=10,
)


# -- round trips


@given(values=embodiments())
def test_yaml_gives_the_same_embodiment_back_with_dims_names_and_mask_of_one_width(values) -> None:
    made = Embodiment.from_values(values, "made")
    assert made.action_dim == len(made.action.names()) == len(made.normalize_mask)
    assert made.action_dim == sum(part["dims"] for part in values["action"]["components"])
    again = Embodiment.from_yaml(made.to_yaml())
    assert again == made and again.digest == made.digest and again.to_yaml() == made.to_yaml()


@pytest.mark.parametrize("path", list(registry_files()), ids=lambda path: path.stem)
def test_the_shipped_yaml_is_valid_and_comes_back(path: Path) -> None:
    made = Embodiment.load(path)
    assert made.id == path.stem and Embodiment.from_yaml(made.to_yaml()) == made


def test_the_schema_knows_every_key() -> None:
    found = schema()
    assert {"id", "stride", "action", "source"} <= set(found["properties"])
    assert found["additionalProperties"] is False


# -- derived facts


@pytest.mark.parametrize(
    ("hz", "target", "stride"),
    [(3, 2, 2), (5, 2, 3), (15, 2, 8), (10, 2, 5), (1, 2, 1), (30, 2, 15), (20, 5, 4), (50, 7, 7)],
)
def test_the_stride_rounds_half_up_and_is_at_least_one(hz: float, target: float, stride: int) -> None:
    values = changed("frequency_hz", hz) | {"target_hz": target}
    made = Embodiment.from_values(values, "arm.yaml")
    assert (made.stride, made.chunk_dim, made.effective_hz) == (stride, 3 * stride, hz / stride)


def test_a_stated_stride_wins() -> None:
    assert arm("stride", 7).stride == 7


def test_an_unknown_rate_has_no_stride_and_says_how_to_give_it() -> None:
    with pytest.raises(RegistryError, match="is unknown.*set frequency_hz"):
        _ = arm("frequency_hz", "unknown").stride


TIMED = {"format": "hdf5", "layout": {"timestamps": "clock"}}


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ({"source": {"format": "rlds"}, "stride": 2}, "rlds recordings keep no times"),
        ({"source": {"format": "hdf5"}, "stride": 2}, r"no times.*null with source\.layout\.timestamps"),
        ({"source": TIMED}, "no stride follows.*null with a stride"),
        ({"source": TIMED, "stride": 2}, None),
        ({"source": {"format": "rosbag"}}, r"no stride follows.*a stride or sync\.rate_hz"),
        ({"source": {"format": "rosbag"}, "sync": {"rate_hz": 5}}, None),
    ],
)
def test_a_rate_may_be_null_only_where_times_and_stride_are_known(more: dict, said: str | None) -> None:
    values = BASE | {"frequency_hz": None} | more
    if said is None:
        assert Embodiment.from_values(values, "arm.yaml").frequency_hz is None
        return
    with pytest.raises(RegistryError, match=f"frequency_hz: is null.*{said}"):
        Embodiment.from_values(values, "arm.yaml")


def test_a_rate_that_nobody_stated_can_be_given_and_a_stated_one_not_changed() -> None:
    given = arm("frequency_hz", "unknown").with_rate(15)
    assert (given.frequency_hz, given.stride) == (15, 8)
    assert given.provenance["frequency_hz"] == "given at the conversion"
    assert arm("frequency_hz", 5).with_rate(5).digest == arm("frequency_hz", 5).digest
    with pytest.raises(RegistryError, match="is 5, not 15"):
        arm("frequency_hz", 5).with_rate(15)
    for hz in (-1, 0.0, math.nan, math.inf):
        with pytest.raises(RegistryError, match="frequency_hz: must (lie between 0 and|be a finite)"):
            arm("frequency_hz", "unknown").with_rate(hz)


def test_the_digest_ignores_texts_and_places_but_not_keys() -> None:
    same = [("notes", "n"), ("license", "MIT"), ("source.uri", "gs://x"), ("target_hz", 3), ("stride", 4)]
    other = [("frequency_hz", 6), ("cameras.0.key", "k"), ("action.components.0.sign", -1)]
    assert {arm(*change).digest for change in same} == {arm().digest}
    assert len({arm(*change).digest for change in other} | {arm().digest}) == 4


def test_an_unknown_camera_names_the_known() -> None:
    with pytest.raises(RegistryError, match="no camera 'side'.*front"):
        arm().camera("side")


# -- bad values


@pytest.mark.parametrize(
    ("path", "value", "said"),
    [
        ("stride", -1, r"stride: .*greater than or equal to 1 \(is -1\)"),
        ("strides", 2, r"strides: unknown key, did you mean 'stride'\?"),
        ("camera", [], r"camera: unknown key, did you mean 'cameras'\?"),
        ("segments", {"gap_s": 1}, r"segments: unknown key, did you mean 'source.segments'\?"),
        ("max_skew_ms", 20, r"max_skew_ms: unknown key, did you mean 'sync.max_skew_ms'\?"),
        ("frequency_hz", -2, r"frequency_hz: must lie between 0 and 100000 Hz \(is -2\)"),
        ("frequency_hz", True, "frequency_hz: must be a number, not true or false"),
        ("frequency_hz", math.nan, "frequency_hz: "),
        ("target_hz", math.inf, "target_hz: "),
        ("target_hz", 1e-310, "target_hz: .*0.001"),
        ("id", "a/b", r"id: must be 1 to 100 of .* \(is 'a/b'\)"),
        ("id", "a..b", "id: must be 1 to"),
        ("id", "a\n", "id: must be 1 to"),
        ("id", "x" * 101, "id: must be 1 to"),
        ("id", datetime.date(2020, 1, 1), "id: .*string"),
        ("kind", "fake", "kind: .*'real', 'simulation' or 'human'"),
        ("action.space", "joints", "action.space: .*'joints'.*allowed: 'joint_position'"),
        ("action.components", [], "action.components: .*at least 1"),
        ("action.components.0.dims", -3, r"action\.components\[0\]\.dims: .*\(is -3\)"),
        ("action.components.0.dims", 10**9, r"action\.components\[0\]\.dims: "),
        ("action.components.0.slice", [3, 0], r"components\[0\]\.slice: has -3 values, but dims is 3"),
        ("action.components.0.slice", [0], r"components\[0\]\.slice\[1\]: is missing"),
        ("action.components.0.names", ["x"], r"components\[0\]\.names: has 1 values, but dims is 3"),
        ("action.components.0.offset", math.nan, r"components\[0\]\.offset: "),
        ("action.components.0.range", [1, -1], r"components\[0\]\.range: must be \[low, high\]"),
        ("cameras", BASE["cameras"] * 2, "same name: front, front"),
        ("cameras.0.rotate", 45, r"cameras\[0\]\.rotate: .*0, 90, 180 or 270"),
        ("cameras.0.crop", [0, 0, 0, 4], r"cameras\[0\]\.crop\[2\]: .*greater than or equal to 1"),
        ("cameras.0.levels", [9, 9], r"levels \[9.0, 9.0\] must be \[black, white\]"),
        ("sync.tolerance_ms", 0, r"sync\.tolerance_ms: .*greater than 0"),
        ("cameras.0.name", "a/b", r"cameras\[0\]\.name: "),
        ("sync.primary", "side", "sync: primary 'side' is not one of: front"),
        ("sync.max_skew_ms", -1, r"sync\.max_skew_ms: "),
        ("source.format", "zarr", r"source\.format: .*'zarr'.*allowed: 'rlds'"),
        ("source.layout", {"axes": "THWC"}, r"layout\.axes: unknown key of format rlds; allowed: none"),
        ("provenance.float", 3, r"provenance\.float: .*string"),
    ],
)
def test_a_bad_value_is_named_by_its_path(path: str, value: Any, said: str) -> None:
    with pytest.raises(RegistryError, match=said) as found:
        Embodiment.from_values(changed(path, value), "arm.yaml")
    assert len(problems(changed(path, value))) <= 2
    assert str(found.value).startswith("arm.yaml: ")


def test_all_problems_are_told_at_once() -> None:
    values = changed("kind", "fake") | {"stride": 0, "wheels": 4}
    del values["action"]
    said = problems(values)
    assert len(said) == 4
    assert {line.split(":")[0] for line in said} == {"kind", "stride", "wheels", "action"}


def test_a_problem_of_one_part_hides_none_of_another() -> None:
    values = changed("action.components.0.names", ["x"]) | {"sync": {"primary": "side"}}
    values["action"]["components"][0] |= {"range": [1, -1], "slice": [0, 2]}
    values["source"] = {"format": "hdf5", "layout": {"episode": "data/*", "axes": "x", "pixels": 3}, "of": 1}
    part, layout = "action.components[0]", "source.layout"
    places = {f"{part}.{key}" for key in ("names", "range", "slice")} | {"sync", "source.of"}
    said = dict(line.split(": ", 1) for line in problems(values))
    assert said.keys() == places | {f"{layout}.{key}" for key in ("episode", "axes", "pixels")}
    assert said[f"{layout}.episode"].startswith("unknown key of format hdf5, did you mean 'episodes'?")


@pytest.mark.parametrize("name", ["rlds", "hdf5", "lerobot", "rosbag", "hands"])
def test_a_fixed_grid_is_refused_where_frames_are_not_resampled(name: str) -> None:
    values = changed("source.format", name) | {"sync": {"rate_hz": 2}}
    if name in ("rosbag", "hands"):
        assert Embodiment.from_values(values, "arm.yaml").rate_hz == 2
        return
    with pytest.raises(RegistryError, match=r"sync\.rate_hz.*remove it: frequency_hz states.*target_hz what"):
        Embodiment.from_values(values, "arm.yaml")


LAYOUT_VALUES = [
    ("hdf5", {"axes": "TCHW", "pixels": "0-1", "episodes": "/"}, True),
    ("hdf5", {"last_observation": "keep"}, False),
    ("hdf5", {"pairing": "index"}, False),
    ("lerobot", {"pairing": "index"}, True),
    ("lerobot", {"pairing": "order"}, False),
    ("hands", {"labels": "landmarks", "max_hold": 3, "mirrored": True, "label_size": "64x48"}, True),
    ("hands", {"min_frames": "12", "models": "m.task"}, True),
    ("hands", {"camera": "cam02", "colour": "red"}, False),
    ("rosbag", {}, True),
    ("rosbag", {"episodes": "x"}, False),
]


@pytest.mark.parametrize(("name", "layout", "valid"), LAYOUT_VALUES)
def test_the_schema_and_the_registry_judge_a_layout_alike(name, layout, valid) -> None:
    values = BASE | {"source": {"format": name, "layout": layout}}
    told = pytest.importorskip("jsonschema").Draft202012Validator(schema()).is_valid(values)
    assert (not problems(values), told) == (valid, valid)


def test_values_of_a_layout_are_kept_as_text() -> None:
    layout = {"max_hold": 3, "mirrored": True, "min_score": 0.25}
    made = Embodiment.from_values(BASE | {"source": {"format": "hands", "layout": layout}}, "arm.yaml")
    assert made.source.layout == {"max_hold": "3", "mirrored": "true", "min_score": "0.25"}


def test_open_questions_are_the_problem_not_what_pydantic_says_of_them() -> None:
    values = changed("frequency_hz", "TODO: how many commands a second?")
    assert problems(values) == ["frequency_hz: still TODO: how many commands a second?"]
    assert todos({"a": [{"b": "TODO: c?"}]}) == [("a[0].b", "c?")]
    with pytest.raises(RegistryError) as fault:
        Embodiment.from_values(values, "arm.yaml")
    said = "arm.yaml: still to be answered: frequency_hz — write answers in place of the TODOs in the file"
    assert str(fault.value) == said


@given(value=anything, path=st.sampled_from(["id", "action", "cameras", "sync", "source", "cameras.0", "x"]))
def test_any_value_anywhere_is_valid_or_has_problems_of_one_line(value: Any, path: str) -> None:
    values = changed(path, value)
    found = problems(values)
    if found:
        with pytest.raises(RegistryError):
            Embodiment.from_values(values, "arm.yaml")
        assert all(line.strip(": ") and "\n" not in line for line in found)
    else:
        Embodiment.from_values(values, "arm.yaml")


@pytest.mark.parametrize("value", [None, [], "text", 3])
def test_a_yaml_that_is_no_mapping_says_so(value: Any) -> None:
    assert "must be a mapping" in problems(value)[0]


# -- bad YAML


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a: &x [1]\nb: *x", "line 1, column 4: anchors and aliases"),
        ("a: &a [x, x]\nb: &b [*a, *a]\nc: [*b, *b]", "anchors and aliases"),
        ("<<: {a: 1}\nb: 2", "line 1, column 1: merge keys"),
        ("a: 1\nb: 2\na: 3", "line 3, column 1: key 'a' is given twice"),
        ("a:\n  b: 1\n  b: 2", "key 'b' is given twice"),
        ("a:\n\tb: 1", "line 2, column 1: .*a tab: indent with spaces"),
        ("a: !!python/object/apply:os.system ['true']", "tags are not accepted"),
        ("a: !!python/name:os.system", "tags are not accepted"),
        ("a: !!binary aGk=", "tags are not accepted"),
        ("a: !mine 1", "tags are not accepted"),
        ("!!set {a, b}", "tags are not accepted"),
        ("a: 1\n---\nb: 2", "another document"),
        ("[" * 100_000, "nested deeper"),
        ("- " * 100_000, "nested deeper"),
        ("? [a]\n: 1", "a key must be a word"),
        ("a: 'x", "line 1"),
        ("a: \x00", "not valid YAML"),
        ("a: " + "9" * 5000, "not valid YAML"),
    ],
)
def test_what_is_not_plain_yaml_is_refused_with_its_place(text: str, said: str) -> None:
    with pytest.raises(RegistryError, match=said) as found:
        parse_yaml(text, "arm.yaml")
    assert str(found.value).startswith("arm.yaml: not valid YAML") and "\n" not in str(found.value)


@given(text=st.text(max_size=60) | st.text("a:-[]{}&*!?|>'\"# \n\t1", max_size=40))
def test_any_text_is_parsed_or_refused_by_our_error(text: str) -> None:
    try:
        parse_yaml(text, "arm.yaml")
    except RegistryError as fault:
        assert "\n" not in str(fault)


@given(
    values=st.dictionaries(words, st.recursive(words | st.integers() | st.booleans(), st.lists), max_size=4)
)
def test_plain_values_come_back_from_their_yaml(values: dict[str, Any]) -> None:
    assert parse_yaml(write_yaml(values), "x") == values


def test_a_file_of_megabytes_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "big.yaml"
    path.write_bytes(b"#" * (MAX_BYTES + 1))
    with pytest.raises(RegistryError, match=r"big\.yaml: is larger than 1,000,000 bytes"):
        read_yaml(path)


def test_what_is_no_text_or_no_file_is_refused(tmp_path: Path) -> None:
    folder, binary, pipe = tmp_path / "folder.yaml", tmp_path / "binary.yaml", tmp_path / "pipe.yaml"
    folder.mkdir()
    binary.write_bytes(b"\xff\xfe\x00a")
    os.mkfifo(pipe)
    for path, said in [(folder, "is not a file"), (binary, "is not UTF-8 text"), (pipe, "is not a file")]:
        with pytest.raises(RegistryError, match=rf"{path.name}: {said}"):
            read_yaml(path)


# -- finding


@pytest.fixture
def registry(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder that $HMA_REGISTRY names, with one embodiment."""
    monkeypatch.setenv("HMA_REGISTRY", str(tmp_path))
    (tmp_path / "made").mkdir()
    (tmp_path / "made" / "my_arm.yaml").write_text(arm("id", "my_arm").to_yaml())
    return tmp_path


def test_an_id_is_found_on_the_path_and_a_file_by_its_path(registry: Path) -> None:
    assert find("my_arm").id == "my_arm"
    assert find(str(registry / "made" / "my_arm.yaml")).id == "my_arm"


def test_an_unknown_id_names_the_nearest(registry: Path) -> None:
    with pytest.raises(RegistryError, match=r"'my_arn'.*did you mean 'my_arm'"):
        find("my_arn")


def test_a_file_named_other_than_its_id_is_refused(registry: Path) -> None:
    (registry / "made" / "other.yaml").write_text(arm("id", "my_arm").to_yaml())
    with pytest.raises(RegistryError, match=r"other\.yaml: has id 'my_arm'"):
        find("other")


def test_two_files_of_one_id_in_a_registry_are_refused(registry: Path) -> None:
    (registry / "again").mkdir()
    (registry / "again" / "my_arm.yaml").write_text(arm("id", "my_arm").to_yaml())
    with pytest.raises(RegistryError, match=r"my_arm\.yaml: has the id of .*my_arm\.yaml"):
        find("my_arm")


def test_a_checkpoints_embodiment_is_found_by_its_folder(tmp_path: Path) -> None:
    folder = tmp_path / "embodiments" / "kept"
    folder.mkdir(parents=True)
    (folder / "embodiment.yaml").write_text(arm("id", "kept").to_yaml())
    assert find("kept", beside=tmp_path).id == "kept"
