"""Define the verb `hma benchmark`."""

from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from hma_data.cli.options import Json
from hma_data.console import interruptible, print_json, progress, say
from hma_data.errors import UsageError
from hma_model.cli.options import Compile, Device, Precision, Temperature, UnmaskSteps, device_name, kept


def benchmark(
    checkpoint: Annotated[
        str | None, Argument(help="A checkpoint, a run's folder, a hub repo, or embedded.")
    ] = None,
    out: Annotated[Path, Option(help="Folder for benchmark.json, benchmark.md and benchmark.html.")] = Path(
        "hma-benchmark"
    ),
    quick: Annotated[bool, Option("--quick", help="One robot and few episodes; takes minutes.")] = False,
    compare: Annotated[
        tuple[Path, Path] | None, Option(metavar="A B", help="Compare two results instead of measuring.")
    ] = None,
    unmask_steps: UnmaskSteps = 2,
    temperature: Temperature = None,
    precision: Precision = "float32",
    compile: Compile = False,
    seed: Annotated[int, Option(min=0, help="Seed; 0 is the protocol's own.")] = 0,
    device: Device = "auto",
    json: Json = False,
) -> None:
    """Measure a checkpoint on simulated robots by a fixed protocol: images, state, plans, policies.

    Finished parts are kept, and the same command continues.

    Example: hma benchmark embedded --quick --out card
    """
    if (checkpoint is None) == (compare is None):
        raise UsageError("hma benchmark", "needs a checkpoint or --compare", "give one of the two")
    from hma_model.benchmark.report import COLUMNS, compared, read_results, rows, write_report
    from hma_model.benchmark.run import FULL, QUICK
    from hma_model.benchmark.run import benchmark as run

    if checkpoint is None:
        assert compare is not None
        table = compared(*map(read_results, compare))
        if json:
            print_json([dict(zip(table.columns, row, strict=True)) for row in table.rows])
        else:
            table.print()
        return
    protocol = QUICK if quick else FULL
    there = device_name(device)
    with (
        interruptible(lambda: kept("parts", out)),
        progress("benchmark", unit="parts") as update,
    ):
        found = run(
            checkpoint, out, protocol, seed=seed, unmask_steps=unmask_steps, temperature=temperature,
            device=there, precision=precision, compile=compile, on_progress=update,
        )  # fmt: skip
        page = write_report(found, out)
    if json:
        print_json(found)
        return
    from hma_data.tables import Table

    Table(COLUMNS, rows(found)).print()
    say(f"open {page}")
