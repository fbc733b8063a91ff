"""Read RLDS / Open X-Embodiment: TFDS folders of TFRecord files, without TensorFlow."""

from hma_data.sources.base import Recognition

RECOGNITION = Recognition(
    label="RLDS (features.json, *.tfrecord*)", names=("features.json", "*.tfrecord*", "*.array_record*")
)
