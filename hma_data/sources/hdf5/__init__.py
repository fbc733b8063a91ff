"""Read HDF5 recordings: robomimic, LIBERO, ALOHA and layouts that a YAML describes."""

from hma_data.sources.base import Recognition

RECOGNITION = Recognition(label="HDF5", endings=(".h5", ".hdf5", ".hdf"), magic=(b"\x89HDF\r\n\x1a\n",))
