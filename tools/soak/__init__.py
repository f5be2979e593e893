"""Endurance tests of the live service: `python -m tools.soak`."""
