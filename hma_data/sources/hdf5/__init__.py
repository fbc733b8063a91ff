"""Read HDF5 recordings: robomimic, LIBERO, ALOHA and layouts that a YAML describes."""
