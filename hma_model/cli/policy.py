"""Define the verbs `hma policy-eval`, `hma augment` and `hma label-actions`."""

from functools import partial
from pathlib import Path
from typing import Annotated, Any

from typer import Argument, Option

from hma_data.cli.options import Json
from hma_data.console import human_count, interruptible, print_json, progress, say
from hma_data.errors import UsageError
from hma_model.cli.options import (
    Compile,
    Device,
    OfCheckpoint,
    Precision,
    Seed,
    Temperature,
    UnmaskSteps,
    device_name,
    embedded_robots,
    kept,
)


def policy_eval(
    embodiment: Annotated[
        str,
        Argument(
            help="A robot of the checkpoint; must be simulated unless --judge is a reward model.",
            autocompletion=embedded_robots,
        ),
    ],
    policies: Annotated[
        list[str],
        Argument(
            metavar="POLICY…",
            help="scripted or reach (both take :noise=SHARE), random, still, hma:CHECKPOINT, plan:cem, "
            "lerobot:FOLDER_OR_REPO, or MODULE:NAME, a Python function or class from image to action.",
        ),
    ],
    checkpoint: OfCheckpoint = "embedded",
    episodes: Annotated[int, Option(min=1, help="Episodes of each policy.")] = 32,
    frames: Annotated[int, Option(min=4, help="Frames of an episode.")] = 40,
    judge: Annotated[
        str,
        Option(
            help="Success criterion: moved, reached or placed; moved=8 sets the limit in px. For robots "
            "without a simulator, a lerobot reward model: a folder or hub repo."
        ),
    ] = "moved",
    source: Annotated[
        Path | None,
        Option(
            "--from",
            help="Shards with success labels, for a reward model; default: those of the training run.",
        ),
    ] = None,
    max_error: Annotated[
        float | None,
        Option(min=0, help="Also report the judge on episodes up to this expected error, in px of 128."),
    ] = None,
    unmask_steps: UnmaskSteps = 2,
    temperature: Temperature = None,
    precision: Precision = "float32",
    compile: Compile = False,
    seed: Seed = 0,
    device: Device = "auto",
    out: Annotated[Path | None, Option(help="Folder for the report and the results.")] = None,
    json: Json = False,
) -> None:
    """Score policies in a robot's simulator and inside the world model, and compare the two.

    With a reward model as --judge, policies are scored in the world model alone.
    With --out, finished policies are kept, and the same command continues.

    Example: hma policy-eval rails_03 scripted scripted:noise=0.5 random still --out policies
    """
    from hma_model.policies import recorded, report
    from hma_model.policies.rewards import names_reward_model
    from hma_model.policies.scores import evaluate_policies

    evaluate: Any = partial(evaluate_policies, max_error=max_error)
    pages: Any = report
    if names_reward_model(judge):
        if max_error is not None:
            raise UsageError("--max-error", "is for simulated robots", "leave it out")
        evaluate = partial(recorded.evaluate_recorded, shards=source)
        pages = recorded
    elif source is not None:
        raise UsageError("--from", "is for a reward model", "add --judge FOLDER_OR_REPO, or leave it out")
    there = device_name(device)
    whole = len(policies) * episodes * frames
    with interruptible(lambda: kept("policies", out)), progress("policies", whole) as update:
        found = evaluate(
            embodiment,
            policies,
            checkpoint=checkpoint,
            episodes=episodes,
            frames=frames,
            judge=judge,
            seed=seed,
            out=out,
            unmask_steps=unmask_steps,
            temperature=temperature,
            device=there,
            precision=precision,
            compile=compile,
            on_progress=update,
        )
        page = report.write_report(found.to_json(), pages.html(found), out) if out else None
    if json:
        print_json(found.to_json())
        return
    pages.show(found)
    if page:
        say(f"open {page}")


def augment(
    embodiment: Annotated[str, Argument(help="A robot of the checkpoint.", autocompletion=embedded_robots)],
    out: Annotated[Path, Argument(help="Folder for the shard set.")],
    checkpoint: OfCheckpoint = "embedded",
    source: Annotated[
        Path | None,
        Option("--from", help="Shard set that provides first frames and actions; default: the simulator."),
    ] = None,
    episodes: Annotated[int, Option(min=1, help="Episodes to generate.")] = 64,
    frames: Annotated[
        int, Option(min=4, help="Frames to generate per episode; the last has no action and is not stored.")
    ] = 40,
    commands: Annotated[
        str, Option(help="Actions: replay, perturb=SIGMA (noise, in std), or a policy of hma policy-eval.")
    ] = "replay",
    keep: Annotated[float, Option(help="Share of episodes to keep, lowest uncertainty first.")] = 0.5,
    max_error: Annotated[
        float | None,
        Option(min=0, help="Drop episodes with a larger expected state error at the end, in px of 128."),
    ] = None,
    judge: Annotated[
        str, Option(help="Keep only successes by a judge: moved, moved=PX, reached, placed, reward model.")
    ] = "",
    lerobot: Annotated[Path | None, Option(help="Also write a LeRobotDataset v3.0 to this folder.")] = None,
    unmask_steps: UnmaskSteps = 2,
    temperature: Temperature = None,
    precision: Precision = "float32",
    compile: Compile = False,
    seed: Seed = 0,
    device: Device = "auto",
    json: Json = False,
) -> None:
    """Generate synthetic episodes with the world model, as shards and, with --lerobot, as a LeRobotDataset.

    Example: hma augment rails_03 synthetic/rails_03 --episodes 64 --commands perturb=0.3
    """
    from hma_data.registry.embodiment import Embodiment
    from hma_data.shards.manifest import MANIFEST
    from hma_data.shards.reader import ShardSet
    from hma_data.sources.lerobot.writer import ORIGIN
    from hma_model.synthetic.augment import Augmentation
    from hma_model.synthetic.augment import augment as run

    there, name = device_name(device), source.resolve().name if source else ""
    settings = Augmentation(
        embodiment, name, episodes, frames, commands, keep, max_error, judge, seed, unmask_steps, temperature,
        precision,
    )  # fmt: skip
    finished = (out / MANIFEST).is_file() and (lerobot is None or (lerobot / ORIGIN).is_file())
    whole = episodes * frames
    with interruptible(lambda: kept("batches", out)), progress("episodes", whole) as update:
        made = run(
            out,
            settings,
            checkpoint=checkpoint,
            shards=source,
            lerobot=lerobot,
            device=there,
            compile=compile,
            on_progress=update,
        )
    count = made.episodes
    if json:
        print_json({"out": str(out), "made": episodes, "kept": count, "plan": made.plan})
        return
    before = "finished already: " if finished else ""
    stored = ShardSet(out).episodes
    begun = len(set(stored["group"].to_pylist()))
    said = f"kept {human_count(count, 'episode')} of {episodes} in {out}"
    say(f"{before}{said}, from {human_count(begun, 'recorded episode')}; synthetic: true in every file")
    if keep < 1 and not any("milli" in flags for flags in stored["flags"].to_pylist()):
        say(f"  --keep {keep:g} was not applied: a model with video_loss: regression has no uncertainty")
    if lerobot:
        say(f"also written as a LeRobotDataset: {lerobot}")
        state = Embodiment.load(lerobot / "embodiment.yaml").provenance.get("state")
        few = "none: the shards have no state, or too few episodes to learn it; lerobot's policies need it"
        say(f"  observation.state: {state or few}")


def label_actions(
    film: Annotated[str, Argument(help="A shard set, or a folder of video files.")],
    checkpoint: Annotated[str, Option(help="A run with the objective `inverse`.")],
    embodiment: Annotated[
        str, Option("-e", "--embodiment", help="Robot of the checkpoint whose actions are inferred.")
    ],
    out: Annotated[Path, Option(help="Folder for the labelled shards.")],
    check: Annotated[
        str | None, Option(help="Shards to measure the error on; default: the run's held-out episodes.")
    ] = None,
    device: Device = "auto",
    json: Json = False,
) -> None:
    """Label action-free video with inferred actions; print the error on recorded actions.

    Example: hma label-actions videos --checkpoint runs/inverse -e mover_04 --out labelled/mover_04
    """
    from hma_data.shards.manifest import MANIFEST, QUARANTINE
    from hma_model.synthetic.labels import label_actions as run

    there, before = device_name(device), "finished already: " if (out / MANIFEST).is_file() else ""
    with interruptible(lambda: kept("episodes", out)), progress("film", unit="episodes") as update:
        made = run(
            film, out, embodiment, checkpoint=checkpoint, check=check, device=there, on_progress=update
        )
    error, splits = made.error, made.manifest.splits.values()
    if json:
        print_json({"out": str(out), "splits": made.manifest.splits, "plan": made.manifest.plan})
        return
    seen = ", which the model may have learned from" if error.split == "train" else ""
    say(f"error on {error.commands:,} actions of {error.source} ({error.split}){seen}:")
    columns = error.names, error.rmse, error.explained, error.explained_95
    for name, rmse, share, ends in zip(*columns, strict=True):
        said = "does not vary there"
        if share is not None:
            bounds = f"95 % CI {ends[0]:.0%} to {ends[1]:.0%}" if ends else "one recording, no CI"
            said = f"{share:.0%} of the variance explained ({bounds})"
            if share <= 0:
                said += "; no better than the mean: do not use it"
            elif not ends or ends[0] <= 0:
                said += "; perhaps no better than the mean"
        say(f"  {name}: RMSE {rmse:.3g}, {said}")
    made_of = human_count(sum(split["episodes"] for split in splits), "episode")
    say(f"{before}{made_of} in {out}; inferred_actions: true in every file")
    if made.manifest.quarantined:
        say(f"{made.manifest.quarantined} in quarantine; {out / QUARANTINE} has the reasons")
