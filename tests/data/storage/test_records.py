"""Records give back the objects they were made of."""

import pickle

import pyarrow as pa
import pytest

from hma_data.sources.base import EpisodeRef
from hma_data.storage.records import Records


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
