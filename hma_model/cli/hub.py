"""Define the verbs of `hma hub`: publish and fetch checkpoints and shard sets; convert released ones."""

import shlex
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Argument, Option

from hma_data.cli.options import Folder, Json
from hma_data.console import CONTINUE, interruptible, print_json, print_table, say
from hma_model.cli.options import Embodiments

if TYPE_CHECKING:
    from hma_model.checkpoint.folder import Checkpoint

Saved = Annotated[Path, Argument(help="A checkpoint, or a run's folder.")]
Revision = Annotated[str | None, Option(help="Branch, tag or commit.")]
Private = Annotated[bool, Option("--private", help="Create new repositories as private.")]
LONGEST = 1000  # letters that are shown of what strangers may have written
hub_app = typer.Typer(no_args_is_help=True, help="Publish and pull checkpoints, one robot at a time.")


@hub_app.command("push")
@interruptible(lambda: CONTINUE)
def push(
    checkpoint: Saved,
    target: Annotated[str, Argument(help="A folder, or org/name on the hub.")],
    embodiment: Embodiments = None,
    sample: Annotated[
        list[Path] | None, Option(help="Shard set to roll out for the card's video; default: the run's.")
    ] = None,
    film: Annotated[
        bool, Option("--film/--no-film", help="Make a video for the card if the run's shards exist.")
    ] = True,
    page: Annotated[
        bool, Option("--page", help="Also publish the page that hma export writes, to drive these robots.")
    ] = False,
    space: Annotated[
        str | None,
        Option(
            metavar="ORG/NAME", help="Also publish that page as a static Hugging Face Space; needs --page."
        ),
    ] = None,
    private: Private = False,
) -> None:
    """Publish a checkpoint, whole or robot by robot.

    Example: hma hub push runs/first ./my-hub/team/model -e my_arm
    """
    from hma_data.errors import UsageError
    from hma_model.checkpoint.folder import Checkpoint, value_of
    from hma_model.cli.export import export_checkpoint
    from hma_model.export.space import Space
    from hma_model.hub import publish as hub

    if space and not page:
        raise UsageError("--space", "needs the page that it shows", "add --page")
    opened, named = Checkpoint.open(checkpoint, embodiment), target.rstrip("/").rsplit("/", 1)[-1]
    static = Space(space, private) if space else None
    if film or sample:
        _add_films(opened, sample, embodiment)
    with tempfile.TemporaryDirectory() as folder:
        exported = None
        if page:
            exported = Path(folder) / "page"
            export_checkpoint(opened.name, [], exported, embodiment, named)
        address = hub.push(opened, target, embodiment, private, exported)
        say(f"published to {address}")
        if static and exported:
            cards = opened.cards(embodiment)
            say(f"the page runs at {static.publish(exported, target, cards.values())}")
    for name, card in opened.cards(embodiment).items():
        judged = card.get("evaluation")
        if value_of(judged, "follows") is False:
            say(f"{name} {value_of(judged, 'verdict')}; the model card starts with this verdict")
    robots = "".join(f" -e {shlex.quote(name)}" for name in embodiment or ())
    say(f"fetch it: hma hub pull {shlex.quote(target)}{robots} --out {shlex.quote(named + '-pulled')}")


def _add_films(checkpoint: "Checkpoint", sample: list[Path] | None, embodiments: list[str] | None) -> None:
    """Add films of the given shards; or those that can be made of the run's own shards."""
    from hma_data.errors import HMAError
    from hma_model.hub.sample import add_samples, at_hand

    if sample:
        add_samples(checkpoint, sample)
        return
    for folder in at_hand(checkpoint, embodiments):
        try:
            add_samples(checkpoint, [folder])
        except HMAError as fault:  # a film is no condition of publishing
            say(f"no video: {fault}", err=True)


@hub_app.command("pull")
@interruptible(lambda: CONTINUE)
def pull(
    source: Annotated[str, Argument(help="A folder, or org/name on the hub.")],
    embodiment: Embodiments = None,
    out: Annotated[Path | None, Option(help="Folder; default: the local cache.")] = None,
    revision: Revision = None,
) -> None:
    """Fetch the trunk and only the chosen robots.

    Example: hma hub pull team/model -e my_arm --out model
    """
    from hma_model.hub import publish as hub

    say(f"pulled to {hub.pull(source, embodiment, out, revision)}")


@hub_app.command("list")
def listing(
    source: Annotated[str, Argument(help="A folder with one checkpoint or many, or org/name.")],
    revision: Revision = None,
    json: Json = False,
) -> None:
    """List checkpoints and their robots, and whether this machine can use them.

    Example: hma hub list ./my-hub
    """
    from hma_model.hub.listing import FIGURES, survey

    found = survey(source, revision)
    if json:
        print_json(found[0] if len(found) == 1 else {"checkpoints": found})
        return
    columns = ["embodiment", "robot", "action_dim", "chunk_dim", "hz", *FIGURES, "licence"]
    for facts in found:
        rows = [
            [*(_cell(row[key]) for key in columns), _megabytes(row["bytes"]), _state(row)]
            for row in facts["embodiments"]
        ]
        say(_summary(facts)[:LONGEST])
        shown = [i for i in range(len(columns) + 2) if i == 0 or any(row[i] is not None for row in rows)]
        if rows:
            names = [*columns, "MB", "state"]
            print_table([names[i] for i in shown], [[row[i] for i in shown] for row in rows])


@hub_app.command("push-data")
@interruptible(lambda: CONTINUE)
def push_data(
    folder: Folder,
    target: Annotated[str, Argument(help="org/name of a dataset on the hub, or a folder.")],
    private: Private = False,
) -> None:
    """Publish a shard set as a dataset; run it again to continue after an interruption.

    Example: hma hub push-data shards/my_arm team/my_arm
    """
    from hma_model.hub.datasets import push_data as run

    say(f"published to {run(folder, target, private=private)}")


@hub_app.command("pull-data")
@interruptible(lambda: CONTINUE)
def pull_data(
    source: Annotated[str, Argument(help="org/name of a dataset on the hub, or a folder.")],
    out: Annotated[Path, Option(help="Folder of the shard set.")],
    revision: Revision = None,
) -> None:
    """Fetch a published shard set; run it again to continue after an interruption.

    Example: hma hub pull-data team/my_arm --out shards/my_arm
    """
    from hma_model.hub.datasets import pull_data as run

    say(f"pulled to {run(source, out, revision=revision)}")


@hub_app.command("import")
def import_released(
    source: Annotated[str, Argument(help="A released checkpoint: a folder, or org/name on the hub.")],
    out: Annotated[Path, Option(help="Folder of the new checkpoint.")],
    embodiment: Embodiments = None,
    grid: Annotated[
        tuple[int, int] | None, Option(help="Height and width of the grid, if not square.")
    ] = None,
    tokenizer: Annotated[str | None, Option(help="Tokenizer; default: the paper's.")] = None,
    revision: Revision = None,
    json: Json = False,
) -> None:
    """Convert a checkpoint of the paper's release to our layout.

    Example: hma hub import liruiw/hma-base-disc --out hma-base-disc
    """
    from hma_model import hub

    made = hub.import_released(
        source, out, embodiments=embodiment, grid=grid, tokenizer=tokenizer, revision=revision
    )
    if json:
        print_json({"out": str(made.folder), "embodiments": list(made.embodiments)})
    else:
        say(f"imported to {made.folder}: {len(made.embodiments)} embodiments")


@hub_app.command("export")
def export_released(
    checkpoint: Saved,
    out: Annotated[Path, Option(help="A new folder: config.json, model.safetensors.")],
    embodiment: Embodiments = None,
) -> None:
    """Write a checkpoint in the layout of the paper's release.

    Example: hma hub export runs/first --out released
    """
    from hma_model import hub

    say(f"exported to {hub.export_released(checkpoint, out, embodiments=embodiment)}")


def _summary(facts: dict[str, Any]) -> str:
    model, tokenizer = (facts[key] if isinstance(facts[key], dict) else {} for key in ("model", "tokenizer"))
    parts = [facts["format"]]
    if facts["origin"]:
        parts.append(facts["origin"])
    if model:
        parts.append(f"{model.get('layers')} layers, width {model.get('width')}")
    if tokenizer:
        parts.append(f"tokenizer {tokenizer.get('name')}")
    sha256, size = facts["trunk_sha256"], _megabytes(facts["trunk_bytes"])
    trunk = f"trunk {sha256[:12]}" if isinstance(sha256, str) else "weights"
    parts.append(f"{trunk}, {size} MB")
    return f"{facts['checkpoint']}: {'; '.join(parts)}; {_state(facts)}"


def _megabytes(size: int) -> float:
    return round(size / 1e6, 2)


def _state(facts: dict[str, Any]) -> str:
    return "; ".join(facts["problems"])[:LONGEST] or "usable here"


def _cell(value: Any) -> Any:
    """Return an untrusted value as it is shown: a number, or text that is not too long."""
    return value if value is None or isinstance(value, int | float) else str(value)[:80]
