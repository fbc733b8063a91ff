"""`hma bench generate`, `train` and `waiting`: what their results say."""

import json
import os
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from hma_data.errors import HMAError, UsageError
from hma_data.tokenizers.network import NetworkTokenizer
from hma_model.cli import app
from hma_model.generation.packed import has_bfloat16
from recipes.bench import drift, flops, generation, play, speed, waiting

SMALL = {
    "layers": 1, "width": 32, "heads": 4, "window": 3, "device": "cpu", "threads": 1, "diffusion_width": 32
}  # fmt: skip


def _generate(**changes: Any) -> dict[str, Any]:
    return generation.GENERATE.defaults | SMALL | {"frames": 1} | changes


@pytest.mark.slow
def test_a_results_settings_and_figures_are_named() -> None:
    words = [f"{key}={value}" for key, value in SMALL.items()] + ["kind=discrete", "cache=true", "frames=1"]
    done = CliRunner().invoke(app, ["bench", "generate", *words, "--json"])
    report = json.loads(done.stdout)
    assert report["bench"] == "generate" and report["settings"]["window"] == 3
    (result,) = report["results"]
    told = ("kind", "device", "precision", "batch", "unmask_steps", "window", "cache", "decode")
    assert [result[key] for key in told] == ["discrete", "cpu", "fp32", 1, 2, 3, True, False]
    assert result["seconds_per_frame"] * result["frames_per_second"] == pytest.approx(1, rel=0.05)
    assert result["peak_rss_mib"] > 0


def test_each_kind_is_measured_with_the_cache_and_without(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(generation, "in_fresh_process", lambda task, settings: settings)
    cases = [(case["kind"], case["cache"]) for case in generation.generate(_generate(kind="both"))]
    assert cases == [(kind, cache) for kind in ("discrete", "continuous") for cache in (True, False)]
    (one,) = generation.generate(_generate(kind="discrete", cache=False))
    assert (one["batch"], one["decode"]) == (1, False)


def test_without_a_kind_the_rows_of_the_table_are_measured_and_settings_choose_among_them() -> None:
    rows = generation.cases(_generate())
    told = [(row["kind"], row["batch"], row["decode"]) for row in rows if row["cache"]]
    pairs = [(batch, decode) for batch in (1, 16) for decode in (False, True)]
    discrete, latents = [("discrete", *pair) for pair in pairs], [("continuous", 1, False)] * 2
    assert told == [("embedded", 1, True), *discrete, *latents]
    assert [row["row"] for row in generation.cases(_generate(batch=16, decode=True))] == [
        "discrete-16-pictures"
    ]
    (chosen,) = generation.cases(_generate(rows="continuous-4"))
    assert (chosen["row"], chosen["ddim_steps"]) == ("continuous-4", 4)


def test_the_embedded_model_is_measured_to_pictures() -> None:
    (case,) = generation.cases(_generate(kind="embedded", cache=True))
    result = generation.measure_frames(_generate() | case)
    assert result["decode"] and result["window"] == 8
    assert 0 < result["share_of_limit"] < 2 and 0.5 < result["gflop_per_frame"] < 1.5


def test_the_work_of_a_frame_is_that_of_its_products() -> None:
    linear, x = torch.nn.Linear(32, 48), torch.randn(2, 5, 32)
    products = flops.products_of(lambda: lambda: (linear(x), torch.bmm(x, x.mT)))
    assert products == {("product", 10, 32, 48): 2 * 10 * 32 * 48, ("other", 0, 0, 0): 2 * 2 * 5 * 5 * 32}
    assert flops.rate_of(products, torch.device("cpu")) > 0


def test_products_are_counted_where_operators_arrive_whole() -> None:
    # as on a GPU, and on a processor without the kernels of hma_model.generation.packed
    linear, x = torch.nn.Linear(8, 4), torch.randn(16, 8)
    with torch.inference_mode():
        products = flops.products_of(lambda: lambda: (linear(x), x @ x.mT))
    assert products == {("product", 16, 8, 4): 2 * 16 * 8 * 4, ("product", 16, 8, 16): 2 * 16 * 8 * 16}


@pytest.mark.slow
@pytest.mark.skipif(not has_bfloat16(), reason="this platform does not support bf16")
@pytest.mark.parametrize("cache", [True, False])
def test_latents_are_measured_in_either_precision(cache: bool) -> None:
    case = {"kind": "continuous", "cache": cache, "batch": 1, "decode": False, "ddim_steps": 2}
    result = generation.measure_frames(_generate(precision="bf16") | case)
    assert (result["ddim_steps"], result["precision"], result["cache"]) == (2, "bf16", cache)


def test_frames_are_decoded_where_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    decoded = []
    decode = NetworkTokenizer.decode

    def seen(self: NetworkTokenizer, tokens: Any) -> Any:
        pictures = decode(self, tokens)
        decoded.append(pictures.shape)
        return pictures

    monkeypatch.setattr(NetworkTokenizer, "decode", seen)
    generation.measure_frames(_generate(decode=True, batch=2, kind="discrete", cache=True))
    assert decoded == [(2, 256, 256, 3)] * (generation.WARMUP + 1)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"precision": "fp8"}, "precision=fp8 is not allowed — give one of fp32, bf16, int8"),
        ({"kind": "video"}, "kind=video is not allowed"),
        ({"cache": 3}, "cache=3 is not allowed — give one of True, False"),
        ({"rows": "base"}, "the table has no row 'base' — rows: embedded, discrete,"),
        ({"batch": "many"}, "batch=many is not allowed — give a number"),
        ({"frames": 0}, "frames=0 is not allowed — give at least 1"),
        ({"window": 1}, "a window of 1 has no prompt"),
    ],
)
def test_a_wrong_setting_is_named(change: dict[str, Any], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        generation.generate(_generate(**change))


def test_measuring_ends_after_the_seconds_given_with_a_frame_at_least() -> None:
    case = {"kind": "discrete", "cache": True, "batch": 1, "decode": False}
    made = generation.Frames(speed.make_model(_generate()).eval(), _generate(frames=9, seconds=0.0) | case)
    assert len(made.seconds()) == 1


@pytest.mark.slow
def test_viewers_of_the_page_get_frames_under_their_commands() -> None:
    (result,) = play.play(play.BENCH.defaults | {"viewers": 2, "seconds": 3.0})
    assert result["viewers"] == 2 and result["frames_per_second"] > 0.5
    assert 0 < result["latency_p50_ms"] <= result["latency_p95_ms"]


@pytest.mark.parametrize(
    ("kind", "changes"),
    [("discrete", {}), ("continuous", {"checkpointing": True, "optimizer": False, "precision": "bf16"})],
)
def test_a_training_step_is_measured(kind: str, changes: dict[str, Any]) -> None:
    (result,) = speed.measure_steps(speed.TRAIN.defaults | SMALL | {"steps": 1} | changes, kind)
    assert result["windows_per_second"] == pytest.approx(2 / result["seconds_per_step"], rel=0.05)
    assert result["kind"] == kind


def test_steps_of_both_precisions_and_of_a_unet_are_measured() -> None:
    small = SMALL | {"steps": 1, "trunk": "unet", "levels": [8, 16], "precision": "both"}
    results = speed.measure_steps(speed.TRAIN.defaults | small, "continuous")
    assert [(one["trunk"], one["precision"]) for one in results] == [("unet", "fp32"), ("unet", "bf16")]
    assert all(one["cpu_seconds_per_step"] > 0 for one in results)


def test_ways_of_waiting_are_measured_each_in_its_own_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_WAIT_POLICY", "PASSIVE")
    seen = []

    def fake(task: Any, settings: dict[str, Any]) -> dict[str, float]:
        seen.append({key: os.environ[key] for key in waiting.OPENMP if key in os.environ})
        return {"steps_per_second": float(len(seen))}

    monkeypatch.setattr(waiting, "in_fresh_process", fake)
    results = waiting.waiting(waiting.WAITING.defaults | {"beside": 0, "rounds": 3})
    alone = [{"OMP_WAIT_POLICY": "PASSIVE", "OMP_NUM_THREADS": "1"}]
    both = [values | {"OMP_NUM_THREADS": "2"} for values in waiting.WAITS.values()]
    assert seen == (alone + both) * 3
    assert [result["wait"] for result in results] == ["", *waiting.WAITS]
    told = {"busy_beside": 0, "threads": 1, "wait": "", "steps_per_second": 1 + len(results)}
    assert results[0] == told
    assert os.environ["OMP_WAIT_POLICY"] == "PASSIVE"


def test_numbers_that_are_none_are_named() -> None:
    with pytest.raises(UsageError, match="beside=few is no list of numbers — write 0,1,2"):
        waiting.waiting(waiting.WAITING.defaults | {"beside": "few"})


# -- drift


BATCH, FRAMES = 3, 50
FRAME_NUMBERS = drift.looked_at(FRAMES, False)[1]


class Reader:
    own, loose = np.array([0]), np.array([], int)
    spread, error = np.array([40.0]), np.array([1.0])

    def read(self, pictures):
        return pictures[..., 0, :1, :2].astype(float)

    def areas(self, pictures):
        return np.where(pictures[..., 1, 1, :1] == 0, 100.0, 0.0)


def found(*errors, whole=True):
    """A robot that goes round, and rollouts of it that are so many px away at each frame (W,)."""
    angle = np.array(FRAME_NUMBERS) * 0.7 + np.arange(BATCH)[:, None]
    parts = 64 + 30 * np.stack([np.cos(angle), np.sin(angle)], -1)[:, :, None].round()
    blank = np.zeros((BATCH, len(FRAME_NUMBERS), 4, 4, 3), np.uint8)

    def pictures(shift):
        made = blank.copy()
        made[:, :, 0, 0, :2] = parts[:, :, 0] + np.stack([shift, np.zeros_like(shift)], -1)
        return made

    true = pictures(np.zeros(len(FRAME_NUMBERS)))
    cases = [drift.Case(f"way {i}", pictures(shift), judged=True) for i, shift in enumerate(errors)]
    if not whole:
        cases = [
            replace(case, pictures=case.pictures + np.uint8(1) * (np.arange(4) > 0)[:, None, None])
            for case in cases
        ]
    copy = drift.Case("copy", np.repeat(true[:, :1], true.shape[1], axis=1))
    return drift.Found("toy", Reader(), FRAME_NUMBERS, true, parts, (*cases, copy))


def late(error):
    return np.where(np.array(FRAME_NUMBERS) > 10, error, 4.0)


def test_errors_are_distances_at_the_marks_and_as_shares_of_the_spread():
    table = drift.rows(found(late(6.0)), seed=0)
    assert [row["frame"] for row in table] == [5, 10, 25, 50] * 2
    _, first, _, last = table[:4]
    assert (first["error_px"], last["error_px"], last["median_px"]) == (4.0, 6.0, 6.0)
    assert (last["low_px"], last["high_px"], last["share"]) == (6.0, 6.0, 0.15)
    assert last["motion"] == 1.0 and first["psnr_db"] > last["psnr_db"]
    copy = table[-1]
    assert copy["motion"] is None and copy["error_px"] > 20 and "verdict" not in copy


@pytest.mark.parametrize(
    ("error", "whole", "said"),
    [
        (late(7.0), True, "holds, error ×1.8; whole"),
        (late(9.0), True, "drifts, error ×2.2; whole"),
        (late(4.0), False, "holds, error ×1.0; dissolved"),
        (np.full(len(FRAME_NUMBERS), 25.0), True, "lost by frame 10, error ×1.0"),
    ],
)
def test_the_verdict_compares_the_end_with_frame_ten(error, whole, said):
    assert drift.rows(found(error, whole=whole), seed=0)[3]["verdict"].startswith(said)


def test_a_robot_that_the_probe_cannot_read_gets_no_verdict():
    unread = found(late(4.0))
    unread.probe.own = np.array([], int)
    last = drift.rows(unread, seed=0)[3]
    assert last["verdict"] == "none: no part of the robot can be read" and "error_px" not in last


def test_motion_of_other_commands_does_not_correlate():
    own = found(late(4.0))
    other = replace(own, cases=(replace(own.cases[0], pictures=own.truth[::-1]), *own.cases[1:]))
    assert drift.rows(other, seed=0)[0]["motion"] < 0.9


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"robots": "bridge"}, "bridge: has no simulator in the toolkit"),
        ({"frames": 5}, "frames=5 is not allowed — give at least 10"),
        ({"rollouts": 1}, "rollouts=1 is not allowed — give at least 2"),
        ({"sampling": "unmask_steps=2/speed=3"}, "'speed=3' is no option of a rollout — .*unmask_steps, "),
    ],
)
def test_a_wrong_setting_of_drift_is_named(change, message):
    with pytest.raises(UsageError, match=message):
        drift.run(drift.BENCH.defaults | change)


def test_ways_of_sampling_are_told_apart_by_the_words_that_differ() -> None:
    ways = drift._samplings("unmask_steps=2,temperature=0.5/unmask_steps=2, temperature=0.5, sample_steps=4")
    assert list(ways) == ["unmask_steps=2,temperature=0.5", "sample_steps=4"]
    assert ways["sample_steps=4"] == {"unmask_steps": 2, "temperature": 0.5, "sample_steps": 4}


@pytest.mark.slow
def test_rollouts_are_measured_and_drawn_and_repeat_themselves(tmp_path) -> None:
    from hma_model.checkpoint.folder import Checkpoint

    robot = next(iter(Checkpoint.open("embedded").embodiments))
    changes = {"robots": robot, "frames": 12, "rollouts": 2, "sampling": "unmask_steps=1/temperature=1.0"}
    settings = drift.BENCH.defaults | changes | {"sheet": str(tmp_path / "sheet.png")}
    table = drift.run(settings)
    names = ["unmask_steps=1", "unmask_steps=1, shuffled", "temperature=1.0", "copy"]
    assert [(row["rollout"], row["frame"]) for row in table] == [(n, f) for n in names for f in (5, 10, 12)]
    assert all(0 < row["probe_px"] < 3 and row["error_px"] > 0 for row in table)
    assert [row["rollout"] for row in table if row.get("verdict")] == [names[0], names[2]]
    assert cv2.imread(str(tmp_path / "sheet.png")).shape[0] > 6 * 64
    assert drift.run(settings) == table


@pytest.mark.slow
def test_a_robot_that_the_checkpoint_lacks_is_named() -> None:
    with pytest.raises(HMAError, match="mover_52"):
        drift.run(drift.BENCH.defaults | {"robots": "mover_52"})
