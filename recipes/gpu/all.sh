#!/usr/bin/env bash
# Everything that wants a GPU, within 25 minutes, the most valuable first; each part writes its figures at once.
#
#     recipes/gpu/all.sh OUT        # OUT: what is to be kept, figures and the trained model
#
# A part that fails leaves its log and does not stop the others. A second call with the same OUT/world goes on with
# the training. START names a checkpoint to begin from (the state of an earlier call).
set -uo pipefail
gpu=$(nvidia-smi --query-gpu=name,memory.total --format=csv,noheader) ||
    { echo "error: there is no GPU here — run this where nvidia-smi lists one" >&2 && exit 1; }
mkdir -p "${1:?error: name the folder for the figures: recipes/gpu/all.sh OUT}"
out=$(cd "$1" && pwd) here=$(cd "$(dirname "$0")/../.." && pwd)
cd "$here" || exit 1
if ! command -v hma > /dev/null; then # a bare machine; the installation is not part of the 25 minutes
    pip install -q uv && uv sync -q --group dev || exit 1
    export PATH="$here/.venv/bin:$PATH"
fi
part() { # name, seconds at most, command …
    local name=$1 most=$2 begun=$SECONDS
    shift 2
    timeout "$most" "$@" > "$out/$name.log" 2>&1
    echo "$name: exit $?, $((SECONDS - begun)) s" | tee -a "$out/parts.txt"
    tail -n 12 "$out/$name.log"
}
echo "$gpu" | tee "$out/gpu.txt"
export WORKERS=${WORKERS:-$(nproc)}
part world 840 recipes/world/make.sh "${WORLD:-/tmp/world}" 480 batch_size=256 lr=3e-3 compile=true \
    ${START:+start=$START}
cp -r "${WORLD:-/tmp/world}"/final/checkpoints/*/{config.json,trunk.safetensors,embodiments} "$out/" 2> /dev/null
cp "${WORLD:-/tmp/world}"/holds.* "$out/" 2> /dev/null
for compile in false true; do
    for batch in 1 4 16; do
        part "generate-$compile-$batch" 120 hma bench generate device=cuda compile=$compile batch=$batch precision=bf16
    done
done
part train 180 hma bench train device=cuda precision=bf16
part tests 300 python -m pytest -m gpu -q tests/test_gpu.py
