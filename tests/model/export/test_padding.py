"""Convolutions of odd channels are padded before a graph is written, and compute the same."""

from itertools import pairwise

import numpy as np
import onnx
import onnxruntime
import pytest
from onnx import TensorProto, helper, numpy_helper

from hma_model.export.files import _pad

DRAW = np.random.default_rng(0)
KERNEL = DRAW.normal(size=(6, 6, 3, 3)).astype(np.float32)
IMAGE = DRAW.normal(size=(1, 6, 8, 8)).astype(np.float32)


def graph(kernel: np.ndarray, group: int = 1, times: int = 2) -> onnx.ModelProto:
    """Convolutions in a row that share a weight."""
    names = ["x", *(f"y{i}" for i in range(times))]
    nodes = [
        helper.make_node("Conv", [one, "w"], [other], pads=[1, 1, 1, 1], group=group)
        for one, other in pairwise(names)
    ]
    x, y = (
        helper.make_tensor_value_info(one, TensorProto.FLOAT, IMAGE.shape) for one in (names[0], names[-1])
    )
    made = helper.make_graph(nodes, "g", [x], [y], [numpy_helper.from_array(kernel, "w")])
    return helper.make_model(made, opset_imports=[helper.make_opsetid("", 18)], ir_version=8)


def run(model: onnx.ModelProto) -> np.ndarray:
    onnx.checker.check_model(model, full_check=True)
    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    return session.run(None, {"x": IMAGE})[0]


def test_convolutions_that_share_a_weight_compute_the_same() -> None:
    model = graph(KERNEL)
    before = run(model)
    _pad(model)
    shapes = [numpy_helper.to_array(one).shape for one in model.graph.initializer if one.data_type == 1]
    assert shapes == [(6, 8, 3, 3)]  # the unpadded weight is gone
    np.testing.assert_allclose(run(model), before, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(
    ("kernel", "group"), [(KERNEL[:, :, :1, :1], 1), (KERNEL[:, :3], 2), (KERNEL[:, :1], 6)]
)
def test_what_is_computed_rightly_stays(kernel: np.ndarray, group: int) -> None:
    model = graph(kernel, group, times=1)
    before = model.SerializeToString()
    _pad(model)
    assert model.SerializeToString() == before
