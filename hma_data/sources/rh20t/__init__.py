"""Read RH20T's scenes as its authors publish them: a film a camera, and numbers in .npy files beside them."""

import re

from hma_data.sources.base import Recognition

SCENE = re.compile(r"task_\d+_user_\d+_scene_\d+_cfg_\d+")  # the name of a folder


def _is_named_so(uri: str) -> bool:
    """Check for the names of its folders: their calibration alone may have more files than are looked at."""
    last = uri.rstrip("/").rsplit("/", 1)[-1]
    return "://" not in uri and bool(SCENE.fullmatch(last) or re.fullmatch(r"RH20T_cfg\d+", last))


RECOGNITION = Recognition(
    label="RH20T's scenes (transformed/tcp_base.npy)",
    uri=_is_named_so,
    layout=("transformed/tcp_base.npy",),
    names=("tcp_base.npy",),
)
