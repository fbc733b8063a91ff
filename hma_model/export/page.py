"""Copy the page, and ONNX Runtime Web for it, into an exported folder."""

import base64
import hashlib
import shutil
from importlib.resources import files
from pathlib import Path
from typing import Any

from hma_data.errors import UsageError
from hma_data.storage.files import read_json, write_atomic

VERSION = "1.30.0"  # of the runtime that the page takes from a CDN
CDN = f"https://cdn.jsdelivr.net/npm/onnxruntime-web@{VERSION}/dist/"
# SHA-384 of its files, computed of the npm package of that version; a browser refuses others.
HASHES = {
    "ort.wasm.min.mjs": "sha384-SfFfy/pvthiOsgaw3KX0bV5TfQ6Iq+oY9KutMe4SxIuHH4cl+DCSD4rTsYOoG1tJ",
    "ort-wasm-simd-threaded.mjs": "sha384-XcXA/MtAf0WpB8e023xQH9CM7RIjiugakT7x99DIwpFf7k56BIFFcAPerIF7FDad",
    "ort-wasm-simd-threaded.wasm": "sha384-vjBJ1z7qrhkTyYsNqKeF6c7N+nOJSU94czEo+tvZcu8G75JparGq9kB+kTnEUNVM",
    "ort.webgpu.min.mjs": "sha384-FPQBMbud8ICuP0Ii+Gr95KWEX9pKHtUC3lacIp0aPI8WYluKvTsEGQ3AE2Ze3QlL",
    "ort-wasm-simd-threaded.asyncify.mjs": "sha384-qViEcCGzsR/m8nlQwIsbYh7afN4thuraqFYDQY6huvmoLVoZq/eYawQ1wrv8nnhA",  # noqa: E501
    "ort-wasm-simd-threaded.asyncify.wasm": "sha384-EPVDLTxuO663dkZO/pcKJF6vOyyfq/5z9FY1oksN0UWFX2ABH4wDDZQHeNoUleWR",  # noqa: E501
}
SHARED = ("controls.js", "page.css")  # with the page of hma play


def write_page(folder: Path, runtime: Path | None) -> dict[str, Any]:
    """Write the page; return where it finds its runtime, and the hashes of the runtime's files.

    Args:
        folder: to write to.
        runtime: the npm package onnxruntime-web as installed; None for a CDN.
    """
    own, shared = files("hma_model.export") / "page", files("hma_model.play")
    for source in (*own.iterdir(), *(shared / name for name in SHARED)):
        write_atomic(folder / source.name, source.read_bytes())
    if runtime is None:
        return {"base": CDN, "version": VERSION, "files": HASHES}
    (folder / "ort").mkdir()
    for name in HASHES:
        shutil.copyfile(runtime / "dist" / name, folder / "ort" / name)
    hashes = {name: integrity((folder / "ort" / name).read_bytes()) for name in HASHES}
    return {"base": "ort/", "version": read_json(runtime / "package.json")["version"], "files": hashes}


def page_names() -> set[str]:
    """Return the names of the page's files, and of the folder of its runtime."""
    return {"ort", *SHARED, *(source.name for source in (files("hma_model.export") / "page").iterdir())}


def require_runtime(runtime: Path) -> None:
    """Raise UsageError unless a folder is the npm package onnxruntime-web with the files of the page."""
    missing = [name for name in HASHES if not (runtime / "dist" / name).is_file()]
    if missing or not (runtime / "package.json").is_file():
        fault = f"has no {f'dist/{missing[0]}' if missing else 'package.json'}"
        remedy = f"npm install onnxruntime-web@{VERSION}, and give node_modules/onnxruntime-web"
        raise UsageError(f"--with-runtime {runtime}", fault, remedy)


def integrity(content: bytes) -> str:
    """Return the hash of a file as browsers compare it."""
    return "sha384-" + base64.b64encode(hashlib.sha384(content).digest()).decode()
