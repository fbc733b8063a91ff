"""Records give back the objects they were made of."""

import copy
import pickle

import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hma_data.sources.base import EpisodeRef
from hma_data.storage.records import Records

REFS = st.lists(
    st.builds(
        EpisodeRef,
        st.text(max_size=5),
        st.integers(0, 9),
        st.none() | st.text(max_size=2),
        st.text(max_size=3),
    ),
    max_size=9,
)


@settings(max_examples=25, deadline=None)
@given(REFS, st.integers(-10, 10), st.integers(-10, 10), st.sampled_from([None, 1, 2, -1]))
def test_a_sequence_of_records_is_the_list_it_was_made_of(items, start, stop, step) -> None:
    records = Records.of(EpisodeRef, items)
    assert list(records) == items and len(records) == len(items)
    assert list(records[start:stop:step]) == items[start:stop:step]
    assert [records[i] for i in range(-len(items), len(items))] == items + items
    assert copy.deepcopy(records[start:stop]) == records[start:stop]  # as a worker process gets it


def test_a_part_is_sent_without_the_rest() -> None:
    records = Records.of(EpisodeRef, [EpisodeRef(str(i), i) for i in range(5_000)])
    assert len(pickle.dumps(records[7:9])) < 1_000


def test_missing_fields_have_their_default_and_needed_ones_must_be_there() -> None:
    expected = [EpisodeRef("a", 3)]
    assert list(Records.of_json(EpisodeRef, [{"id": "a", "frames": 3}])) == expected
    assert list(Records.of_table(EpisodeRef, pa.table({"frames": [3], "id": ["a"]}))) == expected
    with pytest.raises(KeyError, match="frames"):
        Records.of_json(EpisodeRef, [{"id": "a"}])
    with pytest.raises((TypeError, ValueError)):
        Records.of_json(EpisodeRef, [{"id": "a", "frames": "many"}])
