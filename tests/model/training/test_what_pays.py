"""The script that measures what pays in training: its rows are recipes; its table has means and spreads."""

import runpy

import pytest

from hma_data.storage.paths import shipped
from hma_model.training.recipe import load_recipe

SCRIPT = runpy.run_path(str(shipped("recipes") / "lab" / "what_pays.py"))


@pytest.mark.parametrize(
    ("kind", "row"), [(kind, row) for kind, rows in SCRIPT["ROWS"].items() for row in rows]
)
def test_every_row_is_a_recipe_that_differs_from_the_base(kind, row):
    base, own = (load_recipe(SCRIPT["RECIPES"][kind], changes) for changes in ([], SCRIPT["ROWS"][kind][row]))
    assert own.cpu_seconds == base.cpu_seconds
    assert (own.values() == base.values()) == (row == SCRIPT["BASE"])


def test_the_table_has_means_and_deviations_over_the_seeds(tmp_path):
    for seed, loss in enumerate((1.0, 2.0)):
        facts = {"shuffled_loss": loss + 0.5, "psnr_last": 20 + seed, "copy": 19.0, "shuffled": 19.5}
        line = {"row": "base", "seed": seed, "steps": 10 * (1 + seed), "loss": loss, **facts}
        SCRIPT["append"](tmp_path / "pays.csv", line)
    text = SCRIPT["table"](SCRIPT["read"](tmp_path / "pays.csv")).splitlines()[-1]
    cells = ["1.500 ± 0.707", "0.500 ± 0.000", "20.50 ± 0.71", "1.50 ± 0.71", "1.00 ± 0.71"]
    assert text == f"| base | 2 | 15 | {' | '.join(cells)} |"
