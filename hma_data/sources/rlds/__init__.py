"""Read RLDS / Open X-Embodiment: TFDS folders of TFRecord or ArrayRecord files, without TensorFlow."""
