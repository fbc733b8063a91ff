"""Record a task that a policy can learn, and let a world model make more of it: the paper's Table 6, small.

    python recipes/lab/reaching.py build/reach             # mover_04 goes to the nearest block; and it plays
    for n in 100 500 1000; do hma convert build/reach/reach.hdf5 -e build/reach/mover_04.yaml \\
        --limit $n --tokenizer fsq-lab --frames strided --val-fraction 0.01 \\
        --out build/reach/shards/real_$n; done
    hma convert build/reach/mover_04.hdf5 -e build/reach/mover_04.yaml --tokenizer fsq-lab \\
        --frames strided --out build/reach/shards/play
    hma augment mover_04 build/reach/shards/made --from build/reach/shards/play --episodes 400 \\
        --commands reach --judge reached --keep 1 --frames 20
    hma shards merge build/reach/shards/real_100 build/reach/shards/made --out build/reach/shards/both
    for data in real_100 both real_500 real_1000; do hma finetune --from embedded \\
        --data build/reach/shards/$data "objectives={policy: 1.0}" frames=2 batch_size=32 lr=1e-3 \\
        muon_lr=0.01 steps=100000 cpu_seconds=180 eval_every=0 pictures=0 --out runs/reach/$data; done
    hma policy-eval mover_04 hma:runs/reach/{real_100,both,real_500,real_1000},memory=1 reach still \\
        --judge reached --frames 20 --episodes 64 --out policies

What is made begins at real frames of the robot at play, in as many scenes as there are, and the driver acts
in the model, by what its pictures show. With --lerobot the reaches are written as a LeRobotDataset besides,
on which lerobot trains policies of its own, which are better or worse by the steps that they had:

    python recipes/lab/reaching.py build/reach --lerobot
    uv run --with accelerate lerobot-train --dataset.repo_id=lab/mover_04 --dataset.root=build/reach/lerobot \
        --output_dir=runs/diffusion --policy.type=diffusion --policy.device=cpu --policy.push_to_hub=false \
        --policy.pretrained_backbone_weights=null --policy.use_group_norm=true --policy.crop_shape=null \
        --policy.n_obs_steps=1 --policy.horizon=8 --policy.n_action_steps=2 '--policy.down_dims=[64,128]' \
        --policy.drop_n_last_frames=0 --policy.noise_scheduler_type=DDIM --policy.num_inference_steps=10 \
        --policy.optimizer_lr=5e-4 --policy.scheduler_warmup_steps=50 --batch_size=16 --steps=6000 \
        --save_freq=500 --num_workers=0 --dataset.video_backend=pyav
    hma policy-eval mover_04 lerobot:runs/diffusion/checkpoints/00{05,10,20,30,40}00/pretrained_model \
        reach still --judge reached --frames 20 --episodes 64 --out policies

docs/results.md has the figures.
"""

import argparse
from collections.abc import Iterable, Iterator
from pathlib import Path

import cv2
import numpy as np

from hma_data.console import run_script
from hma_data.lab import family, record
from hma_data.sources.lerobot.writer import LeRobotEpisode, write_lerobot
from hma_data.storage.files import atomic_path

ROBOT, SEED = "mover_04", 51
REACH_S = 2.0  # of an episode
CAMERA, SIDE = "observation.images.top", 64  # px of the pictures for lerobot, so that a CPU can train on them


def record_reaching(part: Path, robot: str, episodes: Iterable[int], seed: int) -> None:
    """Record episodes in which the robot goes to the nearest block, to HDF5: what a policy can learn."""
    body = family.Body.of(robot)
    demos = (family.episode(body, seed, number, family.Reacher(body), REACH_S) for number in episodes)
    family.write_file(part, body, demos)


def reaches(count: int) -> Iterator[LeRobotEpisode]:
    """Yield the recorded reaches as episodes for lerobot."""
    body = family.Body.of(ROBOT)
    for number in range(count):
        demo = family.episode(body, SEED, number, family.Reacher(body), REACH_S)
        pictures = [
            cv2.resize(one, (SIDE, SIDE), interpolation=cv2.INTER_AREA) for one in demo.observations["image"]
        ]
        pose = demo.observations["joint_pos"].astype(np.float32)
        yield LeRobotEpisode({CAMERA: np.stack(pictures)}, demo.actions, pose, "go to the nearest block")


def main() -> None:
    """Record what is not there yet."""
    parser = argparse.ArgumentParser(description="Record reaches for the nearest block, and play")
    parser.add_argument("out", type=Path)
    parser.add_argument("--reaches", type=int, default=1000)
    parser.add_argument("--play", type=int, default=600, help="episodes of random manoeuvres")
    parser.add_argument("--lerobot", action="store_true", help="write the reaches for lerobot, too")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    (given.out / f"{ROBOT}.yaml").write_text(family.embodiment(ROBOT).to_yaml(), encoding="utf-8")
    final = given.out / "reach.hdf5"
    if not final.exists():
        with atomic_path(final) as part:
            record_reaching(part, ROBOT, range(given.reaches), SEED)
    print(f"{final}: {given.reaches} episodes")
    final = given.out / f"{ROBOT}.hdf5"
    if not final.exists():
        record(ROBOT, given.out, given.play, SEED + 10)
    print(f"{final}: {given.play} episodes")
    final = given.out / "lerobot"
    if given.lerobot and not final.exists():
        with atomic_path(final) as part:
            robot = family.embodiment(ROBOT)
            camera = robot.cameras[0].model_copy(update={"size": (SIDE, SIDE)})
            write_lerobot(part, robot.model_copy(update={"cameras": (camera,)}), reaches(given.reaches))
        print(f"{final}: {given.reaches} episodes")


if __name__ == "__main__":
    run_script(main)
