"""What `hma train` says at its end."""

import pytest

from hma_model.cli.train import _print
from hma_model.training.loop import TrainResult
from tests.model.robots import CONFIG, make_model, save


@pytest.mark.parametrize(("merge", "unit"), [(1, "token"), (2, "square of 2×2 tokens")])
def test_the_held_out_loss_names_what_it_is_of(merge, unit, tmp_path, capsys) -> None:
    config = CONFIG.replace(grid=(2, 4), merge=merge, tokenizer={**CONFIG.tokenizer, "grid": [2, 4]})
    save(tmp_path / "made", {"arm": 2}, model=make_model({"arm": 2}, config=config))
    _print(
        TrainResult(
            tmp_path, tmp_path / "made", 3, [], [], masked_val_loss=2.0, baseline=4.0, interrupted=False,
            skipped=0, seconds=1.0,
        )
    )  # fmt: skip
    assert f"held-out loss 2.0000 nats per {unit}; baseline (token frequencies)" in capsys.readouterr().out
