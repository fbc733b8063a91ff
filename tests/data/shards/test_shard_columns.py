"""Columns as numpy, without a detour: against pyarrow's own conversion."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from hma_data.shards.schema import to_numpy
from recipes.bench.loader import make_set
from tests.data.fresh import run_fresh
from tests.data.loading.test_pools import SMALL

COLUMNS = [
    *(
        pa.array(np.arange(23), kind)
        for kind in (pa.uint8(), pa.uint16(), pa.uint32(), pa.int32(), pa.int64())
    ),
    *(pa.array(np.linspace(-2, 2, 23).astype(kind)) for kind in (np.float16, np.float32, np.float64)),
    pa.array([i % 3 == 0 for i in range(23)]),
    pa.array([f"camera {i}" for i in range(23)]),
    pa.FixedSizeListArray.from_arrays(pa.array(np.arange(46, dtype=np.float32)), 2),
]


@pytest.mark.parametrize("column", COLUMNS, ids=lambda column: str(column.type)[:12])
@pytest.mark.parametrize("part", [slice(None), slice(5, 19), slice(7, 7)], ids=["all", "part", "none"])
def test_a_column_is_as_pyarrow_gives_it(column: pa.Array, part: slice) -> None:
    array = column[part]
    found = to_numpy(pa.chunked_array([array[:3], array[3:]]))
    wanted = np.array(array.to_pylist(), found.dtype)
    assert len(found) == len(array)
    np.testing.assert_array_equal(found, wanted.reshape(found.shape))


@pytest.mark.slow
def test_windows_are_read_without_pandas(tmp_path: Path) -> None:
    make_set(tmp_path / "set", 0, SMALL | {"frames": 300})
    code = (
        "import sys; from hma_data.loading.dataset import MixtureDataset; "
        f"next(iter(MixtureDataset([{str(tmp_path / 'set')!r}], 4, 6))); "
        "assert 'pandas' not in sys.modules"
    )
    run_fresh(code)
