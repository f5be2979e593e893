"""Fuzzing of decoders, settings files and the processing chain: `python -m tools.fuzz`."""
