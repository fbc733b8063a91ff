"""HDF5 recordings that are damaged, hostile, or not what the robot's YAML says."""

import shutil
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import pytest

from tests.data.hdf5_files import H, T, W, embodiment, fill, pictures
from tests.hostile import Edit, Row, check_refused, cut, flip, of, untouched

FILE, KEY = "demos.hdf5", "obs/agentview_image"


def changed(change: Callable[[h5py.Group], object]) -> Edit:
    def edit(folder: Path) -> None:
        with h5py.File(folder / FILE, "a") as file:
            change(file["data/demo_0"])

    return edit


def put(key: str, **stored: Any) -> Edit:
    def change(demo: h5py.Group) -> None:
        demo.pop(key, None)
        demo.create_dataset(key, **stored)

    return changed(change)


def linked(key: str, link: Any) -> Edit:
    """Return an edit that puts a link in the place of a key; `/key` is in the file, away/ in another one."""

    def edit(folder: Path) -> None:
        with h5py.File(folder / "secret.bin", "w") as file:
            file["in/image"], file["in/actions"] = pictures(), np.zeros((T, 3))
        with h5py.File(folder / FILE, "a") as file:
            file["away"] = h5py.ExternalLink("secret.bin", "/in")
            del file[f"data/demo_0/{key}"]
            file[f"data/demo_0/{key}"] = link

    return edit


def virtual(demo: h5py.Group) -> None:
    layout = h5py.VirtualLayout((T, 3), "f8")
    layout[:] = h5py.VirtualSource("secret.bin", "in/actions", (T, 3))
    del demo["actions"]
    demo.create_virtual_dataset("actions", layout)


def a_type(demo: h5py.Group) -> None:
    del demo["actions"]
    demo["actions"] = np.dtype("f8")


def packed_in_another_way(demo: h5py.Group) -> None:
    del demo[KEY]
    plan = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    plan.set_chunk((T, H, W, 3))
    plan.set_filter(32_099, h5py.h5z.FLAG_OPTIONAL, ())
    space = h5py.h5s.create_simple((T, H, W, 3))
    stored = h5py.h5d.create(demo["obs"].id, b"agentview_image", h5py.h5t.STD_U8LE, space, plan)
    stored.write_direct_chunk((0, 0, 0, 0), b"x" * 100, 0)


def without_pictures(demo: h5py.Group) -> None:
    del demo["obs"]
    demo["states"], demo.attrs["model_file"] = np.zeros((T, 32)), "<mujoco/>"


def of_another_header(folder: Path) -> None:
    path = folder / FILE
    with h5py.File(path) as file:
        at = h5py.h5o.get_info(file["data/demo_0"].id).addr
    flip(at, 0x10)(path)  # the version of the demo's header


def bomb() -> bytes:
    png = bytearray(cv2.imencode(".png", pictures()[0])[1].tobytes())
    png[16:24] = (60_000).to_bytes(4, "big") * 2
    png[29:33] = zlib.crc32(png[12:29]).to_bytes(4, "big")
    return bytes(png)


def outside(value: float) -> np.ndarray:
    stored = np.zeros((T, H, W, 3), np.float32)
    stored[4, 3, 2, 1] = value
    return stored


def beside(name: str, edit: Edit) -> Edit:
    """Return an edit that puts a spoilt copy of the file beside it."""
    return lambda folder: edit(Path(shutil.copy(folder / FILE, folder / name)))


def sees(key: str) -> dict[str, Any]:
    return {"cameras": [{"name": "front", "key": key}]}


def acts(*parts: dict[str, Any]) -> dict[str, Any]:
    return {"action": {"space": "mixed", "components": list(parts)}}


def laid_out(**layout: str) -> dict[str, Any]:
    return {"source": {"format": "hdf5", "layout": layout}}


TIMED = laid_out(timestamps="t")
REF, LONG = h5py.ref_dtype, h5py.vlen_dtype(np.float64)
LINK = "data/demo_0: is damaged, or a link to what is not in this file"
FAR, SMALL = "keeps its values in other files", np.zeros((T - 1, 2))
IN, NOWHERE, AWAY = h5py.ExternalLink("secret.bin", "/in"), h5py.SoftLink("/nowhere"), h5py.SoftLink("/away")
ACTIONS, SHORT = {"key": "actions", "dims": 3}, {"key": "short", "dims": 2}
BOMB = {"key": "bomb", "dims": 1, "slice": [0, 1]}
WIDE = {"shape": (T, 1 << 28), "dtype": "f8", "chunks": (1, 1 << 28), "compression": "gzip"}
HUGE = [(10**12, H, W, 3), (T, 10**6, 10**6, 3), (10**9, 1)]
ONE: dict[str, Row] = {  # one demo is refused
    "no actions": (put("actions", data=np.zeros((0, 3))), "holds no rows, one per frame"),
    "one number": (put("actions", data=3.0), "holds no rows, one per frame"),
    "actions of NaN": (put("actions", data=np.full((T, 3), np.nan)), "not finite"),
    "actions of text": (put("actions", data=np.array([b"a"] * T)), "not numbers"),
    "actions of references": (put("actions", shape=(T, 3), dtype=REF), "not numbers"),
    "one image more": (put(KEY, data=pictures(T + 1)), r"actions 9, .*image 10.*\.last_observation: drop"),
    "two more": (put(KEY, data=pictures(T + 2)), "actions 9, .*11", laid_out(last_observation="drop")),
    "images of references": (put(KEY, shape=(T,), dtype=REF), "not colour images"),
    "images of lists": (put(KEY, shape=(T,), dtype=LONG), "not colour images"),
    "images of u2": (put(KEY, data=pictures().astype("u2")), r"not colour images.*layout\.pixels.*0-1"),
    "images of no height": (put(KEY, shape=(T, 0, W, 3), dtype="u1"), "not colour images"),
    "actions that are a type": (changed(a_type), "'actions' is a group or a type"),
    "states of a simulator": (changed(without_pictures), "states and no images.*dataset_states_to_obs"),
    "an external link": (linked("actions", h5py.ExternalLink("secret.bin", "/in/actions")), FAR),
    "a link through another file": (linked(KEY, h5py.SoftLink("/away/image")), FAR),
    "an external file": (put("actions", shape=(T, 3), dtype="f8", external=[("x", 0, T * 24)]), FAR),
    "a virtual dataset": (changed(virtual), FAR),
    "a demo that is elsewhere": (linked("", IN), LINK),
    "a demo that is nowhere": (linked("", NOWHERE), LINK),
    "a demo by way of elsewhere": (linked("", AWAY), LINK),
    "a demo of another header": (of_another_header, LINK),
    "a bomb of a picture": (put(KEY, data=np.array([bomb()] * T)), "cannot be decoded"),
    "an unknown compression": (changed(packed_in_another_way), "in a way that HDF5 alone does not know"),
    "another file cut short": (beside("cut.hdf5", cut(5000)), r"cut\.hdf5: cannot be read as HDF5"),
}
ONE |= {
    f"images with {value}": (put(KEY, data=outside(value)), "pixels says 0-1", laid_out(pixels="0-1"))
    for value in (200.0, np.nan)
}
ALL: dict[str, Row] = {  # no demo can be used
    "no such key": (untouched, f"has no 'obs/agentview'.*did you mean '{KEY}'", sees("obs/agentview")),
    "a group": (untouched, f"'obs' is a group.*{KEY}", sees("obs")),
    "a link to itself": (linked("dones", h5py.SoftLink("/data/demo_0/dones")), "'dones'", sees("dones")),
    "another width": (untouched, "actions has 3 values, the embodiment says 7", acts(ACTIONS | {"dims": 7})),
    "few actions": (put("short", data=SMALL), "differ in length: actions 9, short 8", acts(ACTIONS, SHORT)),
    "few states": (put("short", data=SMALL), "differ in length", {"state": {"components": [SHORT]}}),
    "depth": (put("d", data=np.zeros((T, H, W, 1), "f4")), "float32, not colour images", sees("d")),
    "other axes": (untouched, r"images \(12, 16, 3\), source\.layout\.axes says TCHW", laid_out(axes="TCHW")),
    "times of no unit": (put("t", data=np.arange(T) * 50), "'t' steps by 50, .* not known", TIMED),
    "a bomb of a chunk": (put("bomb", **WIDE), "too large to read", acts(BOMB)),
    "a file cut short": (of(FILE, cut(5000)), r"demos\.hdf5: cannot be read as HDF5"),
    "an empty file": (of(FILE, cut(0)), r"demos\.hdf5: is empty"),
    "two files of one name": (beside("demos.h5", untouched), r"differs from demos\.h5 in its suffix"),
    "no demos": (changed(lambda demo: demo.parent.clear()), "holds no episodes"),
}
for size in HUGE:
    huge = put("bomb", shape=size, dtype="u1", chunks=(1,) * len(size))
    ALL |= {f"images of {size}": (huge, "bomb", sees("bomb"))}
    ALL |= {f"actions of {size}": (huge, "too large", acts({"key": "bomb", "dims": 1}))}


@pytest.mark.parametrize("case", [*ONE, *ALL])
def test_a_hostile_recording_is_one_line(case: str, tmp_path: Path) -> None:
    folder = tmp_path / "set"
    folder.mkdir()
    with h5py.File(folder / FILE, "w") as file:
        for i in range(3):
            fill(file.create_group(f"data/demo_{i}"), T, i)
    row = (ONE | ALL)[case]
    inspected = row[1] if case.startswith(("a demo", "another file")) else ""
    robot = embodiment(**dict(*row[2:]))
    check_refused(row, folder, robot, tmp_path / "out", one=case in ONE, inspected=inspected)
