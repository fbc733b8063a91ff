#!/usr/bin/env bash
# Record an arm of another simulator, train a world model of it, measure and film it.
#
#     recipes/world/arm.sh fetch OUT [key=value …]
#     recipes/world/arm.sh panda OUT start=embedded-fetch
#
# Training takes 70 CPU minutes on each of two processes. Everything continues where it was. EPISODES (800) are
# recorded in four parts; `uv` installs the simulator. SCENES are the held-out recordings of the film.
set -euo pipefail
here=$(cd "$(dirname "$0")/../.." && pwd)
if [ ! -e "$here/recipes/lab/${1-}.py" ] || [ -z "${2-}" ]; then
    echo "error: arm.sh ${1-}: wants a recorder of recipes/lab and a folder — aloha_sim, fetch, panda or sawyer, then OUT" >&2
    exit 2
fi
robot=$1
out=$2
shift 2
mkdir -p "$out/recordings" "$out/parts"
for part in 7 8 9 10; do # robosuite keeps the memory of every episode, so each part has a process of its own
    if [ ! -e "$out/recordings/$part" ]; then
        compgen -G "$out/part/$robot*" >/dev/null ||
            uv run "$here/recipes/lab/$robot.py" "$out/part" --episodes $((${EPISODES:-800} / 4)) --seed "$part"
        mv "$out/part" "$out/recordings/$part"
    fi
    hma convert "$out/recordings/$part" -e "$robot" --tokenizer palette-64 --frames strided --out "$out/parts/$part"
done
[ -e "$out/shards" ] || hma shards merge "$out/parts/"* --out "$out/shards"
OMP_NUM_THREADS=1 torchrun --nproc-per-node "${PROCESSES:-2}" --no-python \
    hma train world_arm "data=$out/shards" "$@" --out "$out/run"
hma evaluate "$out/run" "$out/shards" --windows 24 | tee "$out/evaluation.txt"
# shellcheck disable=SC2086  # several numbers
python "$here/recipes/world/film.py" "$robot" --checkpoint "$out/run" --shards "$out/shards" \
    --scenes ${SCENES:-2 5 10} --out "$out/film.webp"
