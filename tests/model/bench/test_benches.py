"""`hma bench generate` and `hma bench train`: what their results say."""

import json
import os
from typing import Any

import pytest
from typer.testing import CliRunner

from hma_data.errors import UsageError
from hma_data.tokenizers.network import NetworkTokenizer
from hma_model.bench import speed
from hma_model.cli import app

SMALL = {
    "layers": 1, "width": 32, "heads": 4, "window": 3, "device": "cpu", "threads": 1, "diffusion_width": 32
}  # fmt: skip


def _generate(**changes: Any) -> dict[str, Any]:
    return speed.GENERATE.defaults | SMALL | {"frames": 1, "ddim_steps": 2} | changes


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
    monkeypatch.setattr(speed, "in_fresh_process", lambda task, settings, *case: {"case": case})
    cases = [result["case"] for result in speed.generate(_generate())]
    assert cases == [(kind, cache) for kind in ("discrete", "continuous") for cache in (True, False)]
    assert len(speed.generate(_generate(kind="discrete", cache=False))) == 1


@pytest.mark.parametrize("cache", [True, False])
def test_latents_are_measured_in_either_precision(cache: bool) -> None:
    result = speed.measure_frames(_generate(precision="bf16"), "continuous", cache)
    assert (result["ddim_steps"], result["precision"], result["cache"]) == (2, "bf16", cache)


def test_frames_are_decoded_where_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    decoded = []
    decode = NetworkTokenizer.decode

    def seen(self: NetworkTokenizer, tokens: Any) -> Any:
        decoded.append(decode(self, tokens).shape)

    monkeypatch.setattr(NetworkTokenizer, "decode", seen)
    speed.measure_frames(_generate(decode=True, batch=2), "discrete", True)
    assert decoded == [(2, 256, 256, 3)] * (speed.WARMUP + 1)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"precision": "fp8"}, "precision=fp8 is not allowed — give one of fp32, bf16"),
        ({"kind": "video"}, "kind=video is not allowed"),
        ({"cache": 3}, "cache=3 is not allowed — give one of True, False"),
        ({"frames": 0}, "frames=0 is not allowed — give at least 1"),
        ({"window": 1}, "a window of 1 has no prompt"),
    ],
)
def test_a_wrong_setting_is_named(change: dict[str, Any], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        speed.generate(_generate(**change))


@pytest.mark.parametrize("kind", ["discrete", "continuous"])
@pytest.mark.parametrize("changes", [{}, {"checkpointing": True, "optimizer": False, "precision": "bf16"}])
def test_a_training_step_is_measured(kind: str, changes: dict[str, Any]) -> None:
    result = speed.measure_steps(speed.TRAIN.defaults | SMALL | {"steps": 1} | changes, kind)
    assert result["windows_per_second"] == pytest.approx(2 / result["seconds_per_step"], rel=0.05)
    assert result["kind"] == kind


def test_ways_of_waiting_are_measured_each_in_its_own_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_WAIT_POLICY", "PASSIVE")
    seen = []

    def fake(task: Any, settings: dict[str, Any]) -> dict[str, float]:
        seen.append({key: os.environ[key] for key in speed.OPENMP if key in os.environ})
        return {"steps_per_second": float(len(seen))}

    monkeypatch.setattr(speed, "in_fresh_process", fake)
    results = speed.waiting(speed.WAITING.defaults | {"beside": "nothing", "rounds": 3})
    assert seen == list(speed.WAITS.values()) * 3
    assert [result["wait"] for result in results] == list(speed.WAITS)
    assert results[0] == {"wait": "PASSIVE", "beside": "nothing", "steps_per_second": 1 + len(results)}
    assert os.environ["OMP_WAIT_POLICY"] == "PASSIVE"
