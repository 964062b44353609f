"""Files, written once for all stages: the trajectory file, labelled HDF5, TOML, files that are whole or not there."""
