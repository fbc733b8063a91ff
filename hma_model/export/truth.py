"""Say what the page needs to simulate a robot of the laboratory's family beside the model.

`page/family.js` computes what `hma_data.lab.family` does. The other robots need a physics engine.
"""

import json
from typing import Any

import numpy as np

from hma_data.lab.family.bodies import Body
from hma_data.lab.family.table import BlockTable


def body_values(body: Body) -> dict[str, Any]:
    """Return a body as values of JSON, without its background."""
    about = {
        "mechanism": type(body.mechanism).__name__,
        "hz": body.hz,
        "car": body.car,
        "grip": body.grip,
        "ranges": body.ranges.T,
        "blocks": [block._asdict() for block in body.blocks],
    }
    return _plain(vars(body.mechanism) | about)


def table_values(table: BlockTable) -> dict[str, Any]:
    """Return the state of a simulation as values of JSON."""
    return _plain({name: getattr(table, name) for name in ("pose", "blocks", "held", "grasp")})


def _plain(values: dict[str, Any]) -> dict[str, Any]:
    """Return the same with arrays as lists and axes as dictionaries."""
    return json.loads(json.dumps(values, default=_parts))


def _parts(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else vars(value)
