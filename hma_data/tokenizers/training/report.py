"""Write the report of `hma tokenizer eval`: a table, JSON, and a picture of the worst frames."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from hma_data.episodes.sheets import grid, write_png
from hma_data.storage.files import write_atomic
from hma_data.storage.paths import StrPath, as_path

Results = dict[str, dict[str, Any]]


def _percent(shares: list[float]) -> str:
    return ", ".join(f"{100 * share:.0f} %" for share in shares)


# column -> (key in a result, function that formats its value)
COLUMNS: dict[str, tuple[str, Callable[[Any], str]]] = {
    "frames": ("frames", str),
    "PSNR dB": ("psnr_db", "{:.2f}".format),
    "lowest dB": ("psnr_db_min", "{:.2f}".format),
    "SSIM": ("ssim", "{:.3f}".format),
    "LPIPS": ("lpips", "{:.3f}".format),
    "digits used": ("digit_use", _percent),
    "entropy bits/token": ("entropy_bits_per_token", "{:.2f}".format),
    "latents' std × scale": ("latent_std_scaled", "{:.2f}".format),
    "bits/frame": ("bits_per_frame", "{:.0f}".format),
    "encode frames/s": ("encode_frames_per_second", "{:.0f}".format),
    "decode frames/s": ("decode_frames_per_second", "{:.0f}".format),
}


def to_markdown(results: Results) -> str:
    """Return a table with one row per set of frames; leave out columns that no result has.

    Args:
        results: name -> what `evaluate` returned.
    """
    columns = {
        name: column for name, column in COLUMNS.items() if any(column[0] in r for r in results.values())
    }
    lines = ["| of | " + " | ".join(columns) + " |", "|" + " --- |" * (len(columns) + 1)]
    for name, result in results.items():
        cells = [show(result[key]) if key in result else "–" for key, show in columns.values()]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def write_report(folder: StrPath, title: str, results: Results, notes: list[str]) -> list[Path]:
    """Write `eval.md`, `eval.json` and, where results hold worst frames, `worst.png` to a folder.

    Args:
            folder: str or path of the folder.
            results: as for `to_markdown`; their `worst_frames` go into the picture.
            notes: lines to print below the table.
    """
    folder = as_path(folder)
    plain = {name: without_frames(result) for name, result in results.items()}
    text = f"# {title}\n\n{to_markdown(plain)}"
    text += "".join(f"\n{note}\n" for note in notes)
    paths = [folder / "eval.json", folder / "eval.md"]
    rows, labels = [], []
    for name, result in results.items():
        if worst := result.get("worst_frames"):
            rows += [[true for _, _, true, _ in worst], [made for _, _, _, made in worst]]
            levels = ", ".join(f"{value:.1f}" for value, _, _, _ in worst)
            labels += [f"{name}: the frames of lowest PSNR", f"decoded: {levels} dB"]
    if rows:
        paths.append(folder / "worst.png")
        write_png(paths[-1], grid([[np.asarray(picture) for picture in row] for row in rows], labels))
        text += "\n![Frames of lowest PSNR, original above decoded](worst.png)\n"
    write_atomic(paths[0], json.dumps(plain, indent=1, ensure_ascii=False) + "\n")
    write_atomic(paths[1], text)
    return paths


def without_frames(result: dict[str, Any]) -> dict[str, Any]:
    """Return the result without its `worst_frames`, so that it holds plain values only."""
    return {key: value for key, value in result.items() if key != "worst_frames"}
