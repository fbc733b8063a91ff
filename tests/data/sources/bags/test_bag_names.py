"""Messages that name their values: the component's names pick and order them."""

from typing import Any

import numpy as np
import pytest

from hma_data.registry.components import Component
from hma_data.sources.bags.topic_track import Column, parse_key

WANTED = ["pan", "lift", "elbow"]


def joint_state(names: list[str], values: list[float]) -> dict[str, Any]:
    return {"name": names, "position": values}


def trajectory(names: list[str], values: list[float]) -> dict[str, Any]:
    return {"joint_names": names, "points": [{"positions": values}]}


def jog(names: list[str], values: list[float]) -> dict[str, Any]:
    return {"joint_names": names, "displacements": [], "velocities": values}


def controller_state(names: list[str], values: list[float]) -> dict[str, Any]:
    return {"joint_names": names, "desired": {"positions": values}}


@pytest.mark.parametrize(
    ("make", "path"),
    [
        (joint_state, "position"), (trajectory, "points[0].positions"), (jog, "velocities"),
        (controller_state, "desired.positions"),
    ],
)  # fmt: skip
def test_named_values_come_in_the_components_order(make: Any, path: str) -> None:
    key = f"/joints.{path}"
    component = Component(key=key, dims=3, names=WANTED)
    column = Column(component, parse_key(key, ["/joints"], ""), "")
    order = np.random.default_rng(0)
    for row in range(6):
        names = order.permutation(WANTED).tolist()
        values = {"pan": row, "lift": 100 + row, "elbow": 200 + row}
        column.add(make(names, [float(values[name]) for name in names]), row)
    expected = [[row, 100 + row, 200 + row] for row in range(6)]
    np.testing.assert_array_equal(column.values(), expected)
