"""Read LeRobotDataset versions 2.0, 2.1 and 3.0 with pyarrow and PyAV."""

import re
from pathlib import Path

from hma_data.sources.base import Recognition


def _is_of_the_hub(uri: str) -> bool:
    """Check for hf://, or for NAME/DATASET[@REVISION] where nothing of this machine is meant by it."""
    path = Path(uri).expanduser()
    found = re.fullmatch(r"\w[\w.-]*/\w[\w-]*(\.\d[\w.-]*)?(@[\w./-]+)?", uri)
    return uri.startswith("hf://") or (bool(found) and not path.exists() and not path.parent.exists())


_OTHERS = (  # files of a dataset that shows its format where meta/info.json is missing
    "meta/episodes.jsonl",
    "meta/episodes/chunk-000/file-000.parquet",
    "data/chunk-000/episode_000000.parquet",
    "data/chunk-000/file-000.parquet",
)
RECOGNITION = Recognition(
    label="a LeRobotDataset (meta/info.json)", uri=_is_of_the_hub, layout=("meta/info.json", *_OTHERS)
)
